// Robustness checks of the kernels for all inputs: no data race, no out-of-bounds access, no deadlock, no memory leak, and results that
// don't depend on the number of threads. scripts/sanitize.sh builds and runs this with sanitizers.
//
//   checks CHECK short|long     prints how many renders, forward and backward, or calls were checked
//   checks simd                 prints the instruction set
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <stdexcept>
#include <string>
#include <thread>
#include <type_traits>

#include "../kernels/attention_types.h"
#include "../kernels/jobs.h"
#include "../kernels/kernels.h"
#include "../kernels/multi_head_attention.h"
#include "../kernels/parallel.h"
#include "render.h"

namespace globalsplat::checks {
namespace {

using raster::parallel_for;

constexpr unsigned kTimeoutSeconds = 120;  // much longer than any check takes

std::string now;  // name of the running check

void on_timeout(int) {
  const auto say = [](const char* text, size_t length) { return write(2, text, length) == ssize_t(length); };
  const char end[] = ": never ends\n";
  _exit(say("FOUND: ", 7) && say(now.data(), now.size()) && say(end, sizeof end - 1) ? 1 : 2);
}

template <class T>
void expect_same(const Results<T>& found, const Results<T>& one) {
  const bool is_render = one.size() == std::size(kResults);
  for (size_t k = 0; k < one.size(); ++k)
    if (!have_same_bits(found[k], one[k])) fail(std::string(is_render ? kResults[k] : "results") + " differ from one thread's");
}

// Checks that run(num_threads) returns the same bits for each number of threads as for one thread. Returns the number of runs.
template <class Run>
int64_t same_bits(const std::string& name, const std::vector<int>& thread_counts, const Run& run) {
  begin(name);
  const auto one = run(1);
  for (const int num_threads : thread_counts) {
    begin(name + ", " + std::to_string(num_threads) + " threads");
    expect_same(run(num_threads), one);
  }
  return 1 + int64_t(thread_counts.size());
}

template <class T>
std::string type_name() {
  return sizeof(T) == sizeof(float) ? "float32" : "float64";
}

template <class T>
int64_t check_scene(const Scene<T>& scene, const std::vector<int>& thread_counts) {
  return same_bits(scene.name + ", " + type_name<T>() + ", " + std::to_string(scene.bases) + " bases", thread_counts,
                   [&](int num_threads) { return rendered(scene, num_threads); });
}

// Losses and their gradients, and a step of Adam. Arrays have their exact sizes, so that out-of-bounds reads are detected.
template <class T>
int64_t check_losses(const std::vector<int>& thread_counts) {
  Random random(11);
  const auto numbers = [&](size_t count) { return converted<T>(random.uniform(count, 0, 1)); };
  int64_t count = 0;
  // evaluate(gradient, num_threads) returns a loss, and writes the gradient's `all` values unless it is null.
  const auto check = [&](const std::string& what, size_t all, const auto& evaluate) {
    count += same_bits(what + ", " + type_name<T>(), thread_counts, [&](int num_threads) {
      std::vector<T> gradient(all, T(num_threads));
      const double value = evaluate(gradient.data(), num_threads);
      expect(evaluate(nullptr, num_threads) == value, "the gradient changes the value");
      return Results<double>{{value}, {gradient.begin(), gradient.end()}};
    });
  };
  for (const auto& [planes, height, width] : {std::array<int, 3>{1, 11, 11}, {3, 12, 37}, {6, 43, 48}}) {
    const size_t all = size_t(planes * height * width);
    const std::vector<T> pictures = numbers(all), photos = numbers(all);
    const raster::LossJob<T> job{pictures.data(), photos.data(), planes, width, height};
    for (const double ssim_weight : {0.0, -0.2})
      check("the photometric loss", all, [&](T* gradient, int num_threads) {
        return raster::photometric<T>(job, 0.8, ssim_weight, gradient, num_threads);
      });
  }
  for (const auto& [views, height, width] : {std::array<int, 3>{1, 1, 1}, {3, 12, 37}, {2, 43, 48}}) {
    const size_t all = size_t(views * height * width);
    const std::vector<T> depths = numbers(all), photos = numbers(3 * all);
    const raster::LossJob<T> job{depths.data(), photos.data(), views, width, height};
    check("smoothness", all, [&](T* gradient, int num_threads) {
      return raster::depth_smoothness<T>(job, 0.3, gradient, num_threads);
    });
  }
  const size_t many = 40'000;
  const std::vector<T> gradient = numbers(many), start = numbers(many);
  return count + same_bits("a step of Adam, " + type_name<T>(), thread_counts, [&](int num_threads) {
    Results<T> state(3, start);
    raster::adam<T>({0.1, 0.5, 0.01, 0.9, 0.999, 1e-8}, {state[0].data(), gradient.data(), state[1].data(), state[2].data()},
                    int64_t(many), num_threads);
    return state;
  });
}

// Steps of Muon on matrices of all shapes, with exactly the scratch memory that they request. parity/ compares their values.
int64_t check_muon(const std::vector<int>& thread_counts) {
  return same_bits("steps of Muon", thread_counts, [](int num_threads) {
    Random random(12);
    Results<float> numbers;
    std::vector<raster::MuonMatrix> all;
    for (const auto& [rows, columns] : {std::array<int64_t, 2>{1, 1}, {1, 7}, {7, 1}, {20, 33}, {21, 23}, {128, 128}, {200, 65}}) {
      for (int of = 0; of < 3; ++of) numbers.push_back(converted<float>(random.uniform(size_t(rows * columns), -1, 1)));
      const size_t last = numbers.size() - 1;
      all.push_back({numbers[last - 2].data(), numbers[last].data(), numbers[last - 1].data(), rows, columns});
    }
    raster::muon({0.1, 0.01, 0.95}, all, num_threads);
    return numbers;
  });
}

// Reference for raster::Bf16Gemm in scalar code.
void multiply_bf16(int64_t m, int64_t n, int64_t k, int64_t a_row, int64_t b_row, int64_t c_row, bool adds, const raster::Bf16* a,
                   const raster::Bf16* b, float* c) {
  for (int64_t i = 0; i < m; ++i)
    for (int64_t j = 0; j < n; ++j) {
      float sum = adds ? c[i * c_row + j] : 0;
      for (int64_t at = 0; at < k; ++at) sum += raster::to_float(a[i * a_row + at]) * raster::to_float(b[(at / 2 * b_row + j) * 2 + at % 2]);
      c[i * c_row + j] = sum;
    }
}

float as_float(float number) { return number; }
float as_float(raster::Bf16 number) { return raster::to_float(number); }

// Computes attention, forward and backward, of random heads and a random gradient of the output. Returns all outputs. Arrays have their
// exact sizes here, too.
template <class Number>
Results<Number> attended(const raster::AttentionShape& shape, int num_threads) {
  Random random(12);
  const int64_t row = shape.heads * shape.width, in = shape.queries * row, seen = shape.keys * row;
  const auto numbers = [&](int64_t count) {
    std::vector<Number> drawn;
    for (const double number : random.normal(size_t(shape.scenes * count), 1)) {
      if constexpr (std::is_same_v<Number, float>)
        drawn.push_back(float(number));
      else
        drawn.push_back(raster::to_bf16(float(number)));
    }
    return drawn;
  };
  const std::vector<Number> q = numbers(in), k = numbers(seen), v = numbers(seen), grad_out = numbers(in);
  const auto unwritten = [&](const std::vector<Number>& like) { return std::vector<Number>(like.size(), Number(num_threads)); };
  Results<Number> all{unwritten(q), unwritten(q), unwritten(k), unwritten(v)};
  std::vector<float> log_sums(size_t(shape.scenes * shape.heads * shape.queries), float(num_threads));
  const raster::AttentionInputs<Number> inputs{{q.data(), in, row}, {k.data(), seen, row}, {v.data(), seen, row}};
  const raster::Bf16Gemm gemm = {multiply_bf16, [] {}};
  raster::multi_head_attention<Number>(shape, inputs, {all[0].data(), in, row}, log_sums.data(), gemm, num_threads);
  raster::multi_head_attention_backward<Number>(shape, inputs, {all[0].data(), in, row}, log_sums.data(), {grad_out.data(), in, row},
                                                {{all[1].data(), in, row}, {all[2].data(), seen, row}, {all[3].data(), seen, row}}, gemm,
                                                num_threads);
  return all;
}

template <class Number>
int64_t check_attention(const std::vector<int>& thread_counts) {
  int64_t count = 0;
  for (const raster::AttentionShape& shape : {raster::AttentionShape{1, 1, 1, 1, 8},
                                              {2, 3, 7, 65, 8},
                                              {1, 2, 103, 385, 24},
                                              {1, 1, 1100, 300, 32},
                                              {1, 2, 50, 800, 64},
                                              {1, 1, 9, 20, raster::kAttentionWidth}})
    count += same_bits("attention of " + std::to_string(shape.queries) + " to " + std::to_string(shape.keys), thread_counts,
                       [&](int num_threads) {
                         const Results<Number> all = attended<Number>(shape, num_threads);
                         for (const auto& numbers : all)
                           for (const Number number : numbers) expect(std::isfinite(as_float(number)), "attention isn't finite");
                         return all;
                       });
  return count;
}

// Every scene's images and gradients are the same for any number of threads.
int64_t bits(bool is_short) {
  std::vector<int> thread_counts = {2, 3, 16};
  if (!is_short)
    for (int num_threads = 4; num_threads < 16; ++num_threads) thread_counts.push_back(num_threads);
  int64_t count = check_losses<float>(thread_counts) + check_losses<double>(thread_counts) + check_muon(thread_counts);
  count += check_attention<float>(thread_counts) + check_attention<raster::Bf16>(thread_counts);
  size_t turn = 0;  // the short form covers all degrees, but one per scene
  for (const int bases : {1, 4, 9, 16}) {
    const std::vector<Scene<double>> scenes = all_scenes(bases);
    for (size_t i = 0; i < scenes.size(); ++i)
      if (!is_short || i % 4 == turn)
        count += check_scene(as<float>(scenes[i]), thread_counts) + check_scene(scenes[i], thread_counts);
    ++turn;
  }
  const Scene<double> many = many_gaussians(1);
  return count + check_scene(as<float>(many), {16}) + check_scene(many, {16});
}

// Several threads render at the same time, each on several threads if available. The backward passes run in any order, on other threads
// than the forward passes, or not at all.
template <class T>
int64_t callers_of(const std::vector<Scene<double>>& all, int rounds) {
  std::vector<Scene<T>> scenes;
  std::vector<Results<T>> one;
  begin("one thread");
  for (const Scene<double>& scene : all) scenes.push_back(as<T>(scene));
  for (const Scene<T>& scene : scenes) one.push_back(rendered(scene, 1));
  const size_t count = scenes.size();
  int64_t checked = 0;
  for (int round = 0; round < rounds; ++round) {
    begin("several callers, " + type_name<T>());
    std::vector<Render<T>> renders;
    for (const Scene<T>& scene : scenes) renders.emplace_back(scene, 2 + round % 3);
    const auto at_once = [&](const auto& act) {
      std::vector<std::thread> callers;
      for (size_t i = 0; i < count; ++i) callers.emplace_back([&, i] { act(i); });
      for (std::thread& caller : callers) caller.join();
    };
    at_once([&](size_t i) {
      renders[i].draw();
      renders[i].backward();
    });
    for (size_t i = 0; i < count; ++i) expect_same(renders[i].results(), one[i]);

    begin("frames out of order, " + type_name<T>());
    at_once([&](size_t i) { renders[i].draw(); });
    for (size_t i = 0; i < count; ++i) std::thread([&] { renders[(i + 1 + size_t(round)) % count].backward(); }).join();
    for (size_t i = 0; i < count; ++i) expect_same(renders[i].results(), one[i]);

    begin("frames dropped while others are drawn, " + type_name<T>());
    at_once([&](size_t i) {
      if (i % 2 == 0) renders[i].backward();
      renders[i].drop();
      renders[i].draw();
      if (i % 2 == 1) renders[i].backward();
    });
    for (size_t i = 0; i < count; ++i) expect_same(renders[i].results(), one[i]);
    checked += 3 * int64_t(count);
  }
  return checked;
}

int64_t callers(bool is_short) {
  std::vector<Scene<double>> scenes;
  for (const Scene<double>& scene : all_scenes(4))
    for (const char* name : {"two scenes, two views", "17x3", "several tasks", "opaque stack", "no Gaussian"})
      if (scene.name == name) scenes.push_back(scene);
  const int rounds = is_short ? 3 : 12;
  return callers_of<float>(scenes, rounds) + callers_of<double>(scenes, rounds);
}

// Calls from tasks, and tasks that fail.
int64_t threads(bool is_short) {
  std::atomic<int64_t> sum{0};
  const std::function<void(int64_t)> add = [&](int64_t i) { sum += i; };
  const int rounds = is_short ? 20 : 1000;
  for (int round = 0; round < rounds; ++round) {
    begin("a call from a task");
    sum = 0;
    parallel_for(4, 10, [&](int64_t) { parallel_for(4, 100, add); });
    expect(sum == 49500, "tasks were lost");

    begin("a task that fails");
    bool caught = false;
    try {
      parallel_for(4, 100, [&](int64_t i) {
        if (i % 10 == round % 10) throw std::runtime_error("task");
      });
    } catch (const std::runtime_error&) {
      caught = true;
    }
    expect(caught, "the exception doesn't reach the caller");
    sum = 0;
    parallel_for(4, 100, add);
    expect(sum == 4950, "the next call doesn't do its work");
  }
  return 3 * rounds;
}

// A child process renders correctly; it has a copy of everything but the threads.
int64_t children(bool is_short) {
  Random random(10);
  const Scene<float> scene = as<float>(random_scene(random, "small", 20, 20, 2, 2, 40, 4));
  const Results<float> one = rendered(scene, 1);
  const auto render_as = [&](const char* what) {
    begin(what);
    expect_same(rendered(scene, 4), one);
  };
  const int count = is_short ? 3 : 30;
  for (int i = 0; i < count; ++i) {
    render_as("parent");
    const pid_t child = fork();
    if (child == 0) {
      render_as("child");
      _exit(0);
    }
    int status = 0;
    expect(child > 0 && waitpid(child, &status, 0) == child && status == 0, "the child fails");
  }
  return count;
}

}  // namespace

void begin(std::string what) {
  now = std::move(what);
  alarm(kTimeoutSeconds);
}

void fail(const std::string& what) {
  std::fprintf(stderr, "FOUND: %s: %s\n", now.c_str(), what.c_str());
  std::_Exit(1);
}

}  // namespace globalsplat::checks

int main(int count, char** arguments) {
  using namespace globalsplat;
  const struct {
    const char* name;
    int64_t (*run)(bool is_short);
  } known[] = {{"bits", checks::bits},
               {"callers", checks::callers},
               {"threads", checks::threads},
               {"orders", checks::orders},
               {"children", checks::children}};
  signal(SIGALRM, checks::on_timeout);
  const std::string check = count > 1 ? arguments[1] : "";
  if (check == "simd") {
    try {
      std::puts(raster::kernels().name);
      return 0;
    } catch (const std::invalid_argument&) {
      return 1;  // GLOBALSPLAT_SIMD names a set that isn't available
    }
  }
  for (const auto& one : known)
    if (check == one.name && count == 3) {
      std::printf("%lld\n", static_cast<long long>(one.run(std::strcmp(arguments[2], "short") == 0)));
      return 0;
    }
  std::fprintf(stderr, "checks simd, or bits, callers, threads, orders or children, and short or long\n");
  return 2;
}
