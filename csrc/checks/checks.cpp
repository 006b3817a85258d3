// Robustness checks of the kernels for all inputs: no data race, no out-of-bounds access, no deadlock, no memory leak, and results that
// don't depend on the number of threads. scripts/sanitize.sh builds and runs this with sanitizers.
//
//   checks short|long CHECK…
//
// prints for each check how many renders, forward and backward, or calls were checked. Ends with exit code 3 if the instruction set that
// GLOBALSPLAT_SIMD names isn't available. Arrays have their exact sizes, so that out-of-bounds reads are detected.
#include "checks.h"

#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <map>
#include <stdexcept>
#include <thread>
#include <type_traits>

#include "../kernels/attention_types.h"
#include "../kernels/kernels.h"
#include "../kernels/multi_head_attention.h"
#include "../kernels/parallel.h"

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
int64_t check_scene(const Scene<double>& scene, const std::vector<int>& thread_counts) {
  const std::string name = scene.name + ", " + std::to_string(sizeof(T)) + " bytes, " + std::to_string(scene.bases) + " bases";
  return check_same_bits(name, thread_counts, [scene = as<T>(scene)](int num_threads) { return rendered(scene, num_threads); });
}

template <class T>
int64_t check_losses_of_cpu(const std::vector<int>& thread_counts) {
  return check_losses<T>(
      thread_counts,
      [](int num_threads, const raster::LossJob<T>& job, double l1_weight, double ssim_weight, T* gradient) {
        return raster::photometric<T>(job, l1_weight, ssim_weight, gradient, num_threads);
      },
      [](int num_threads, const raster::LossJob<T>& job, T* gradient) {
        return raster::depth_smoothness<T>(job, 0.3, gradient, num_threads);
      });
}

template <class T>
int64_t check_adam(const std::vector<int>& thread_counts) {
  return check_same_bits("a step of Adam", thread_counts, [&](int num_threads) {
    Random random(11);
    const size_t size = 40'000;
    const std::vector<T> gradient = converted<T>(random.uniform(size, 0, 1));
    Results<T> state(3, converted<T>(random.uniform(size, 0, 1)));
    raster::adam<T>({0.1, 0.5, 0.01, 0.9, 0.999, 1e-8}, {state[0].data(), gradient.data(), state[1].data(), state[2].data()},
                    int64_t(size), num_threads);
    return state;
  });
}

// Steps of Muon on matrices of all shapes, with exactly the scratch memory that they request.
int64_t check_muon(const std::vector<int>& thread_counts) {
  return check_same_bits("steps of Muon", thread_counts, [](int num_threads) {
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

// Attention, forward and backward, of random heads and a random gradient of the output.
template <class Number>
int64_t check_attention(const raster::AttentionShape& shape, const std::vector<int>& thread_counts) {
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
  const raster::AttentionInputs<Number> inputs{{q.data(), in, row}, {k.data(), seen, row}, {v.data(), seen, row}};
  const raster::Bf16Gemm gemm = {multiply_bf16, [] {}};
  const std::string name = "attention of " + std::to_string(shape.queries) + " to " + std::to_string(shape.keys);
  return check_same_bits(name, thread_counts, [&](int num_threads) {
    const auto unwritten = [&](const std::vector<Number>& like) { return std::vector<Number>(like.size(), Number(num_threads)); };
    Results<Number> all{unwritten(q), unwritten(q), unwritten(k), unwritten(v)};
    std::vector<float> log_sums(size_t(shape.scenes * shape.heads * shape.queries), float(num_threads));
    raster::multi_head_attention<Number>(shape, inputs, {all[0].data(), in, row}, log_sums.data(), gemm, num_threads);
    raster::multi_head_attention_backward<Number>(shape, inputs, {all[0].data(), in, row}, log_sums.data(), {grad_out.data(), in, row},
                                                  {{all[1].data(), in, row}, {all[2].data(), seen, row}, {all[3].data(), seen, row}}, gemm,
                                                  num_threads);
    return all;
  });
}

// Every scene's images and gradients, and all other results, are the same for any number of threads.
int64_t check_bits(bool is_short) {
  std::vector<int> thread_counts = {1, 2, 3, 16};
  if (!is_short)
    for (int num_threads = 4; num_threads < 16; ++num_threads) thread_counts.push_back(num_threads);
  int64_t count = check_losses_of_cpu<float>(thread_counts) + check_losses_of_cpu<double>(thread_counts);
  count += check_adam<float>(thread_counts) + check_adam<double>(thread_counts) + check_muon(thread_counts);
  for (const raster::AttentionShape& shape : {raster::AttentionShape{1, 1, 1, 1, 8},
                                              {2, 3, 7, 65, 8},
                                              {1, 2, 103, 385, 24},
                                              {1, 1, 1100, 300, 32},
                                              {1, 2, 50, 800, 64},
                                              {1, 1, 9, 20, raster::kAttentionWidth}})
    count += check_attention<float>(shape, thread_counts) + check_attention<raster::Bf16>(shape, thread_counts);
  const auto check = [](const Scene<double>& scene, const std::vector<int>& thread_counts) {
    return check_scene<float>(scene, thread_counts) + check_scene<double>(scene, thread_counts);
  };
  count += for_all_scenes(is_short, [&](const Scene<double>& scene) { return check(scene, thread_counts); });
  return count + check(many_gaussians(1), {1, 16});
}

// Several threads render at the same time, each on several threads if available. The backward passes run in any order, on other threads
// than the forward passes, or not at all.
template <class T>
int64_t check_callers(const std::vector<Scene<T>>& scenes, int rounds) {
  std::vector<Results<T>> one;
  begin("one thread");
  for (const Scene<T>& scene : scenes) one.push_back(rendered(scene, 1));
  const size_t count = scenes.size();
  for (int round = 0; round < rounds; ++round) {
    std::vector<Render<T>> renders;
    for (const Scene<T>& scene : scenes) renders.emplace_back(scene, 2 + round % 3);
    // Calls act(i) for all renders at once. Afterwards, `finish` calls what remains to be done.
    const auto check = [&](const char* name, const auto& act, const std::function<void()>& finish) {
      begin(name);
      std::vector<std::thread> callers;
      for (size_t i = 0; i < count; ++i) callers.emplace_back([&, i] { act(renders[i], i); });
      for (std::thread& caller : callers) caller.join();
      finish();
      for (size_t i = 0; i < count; ++i) expect_same(renders[i].results, one[i]);
    };
    check("several callers", [](Render<T>& render, size_t) { render.draw(), render.backward(); }, [] {});
    check("frames out of order", [](Render<T>& render, size_t) { render.draw(); }, [&] {
      for (size_t i = 0; i < count; ++i) std::thread([&] { renders[(i + 1 + size_t(round)) % count].backward(); }).join();
    });
    check("frames dropped while others are drawn", [](Render<T>& render, size_t i) {
      if (i % 2 == 0) render.backward();
      render.frame.reset();
      render.draw();
      if (i % 2 == 1) render.backward();
    }, [] {});
  }
  return rounds * 3 * int64_t(count);
}

int64_t check_callers(bool is_short) {
  std::vector<Scene<float>> singles;
  std::vector<Scene<double>> doubles;
  for (const Scene<double>& scene : all_scenes(4))
    for (const char* name : {"two scenes, two views", "17x3", "several tasks", "opaque stack", "no Gaussian"})
      if (scene.name == name) {
        singles.push_back(as<float>(scene));
        doubles.push_back(scene);
      }
  const int rounds = is_short ? 3 : 12;
  return check_callers(singles, rounds) + check_callers(doubles, rounds);
}

// Calls from tasks, and tasks that fail.
int64_t check_threads(bool is_short) {
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
int64_t check_children(bool is_short) {
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

void expect(bool holds, const char* what) {
  if (holds) return;
  std::fprintf(stderr, "FOUND: %s: %s\n", now.c_str(), what);
  std::_Exit(1);
}

}  // namespace globalsplat::checks

int main(int count, char** arguments) {
  using namespace globalsplat;
  const std::map<std::string, int64_t (*)(bool is_short)> known = {{"bits", checks::check_bits},
                                                                   {"callers", checks::check_callers},
                                                                   {"threads", checks::check_threads},
                                                                   {"orders", checks::check_orders},
                                                                   {"children", checks::check_children}};
  signal(SIGALRM, checks::on_timeout);
  try {
    raster::kernels();
  } catch (const std::invalid_argument&) {
    return 3;
  }
  for (int k = 2; k < count; ++k) {
    const bool is_short = std::strcmp(arguments[1], "short") == 0;
    std::printf("%s: %lld\n", arguments[k], static_cast<long long>(known.at(arguments[k])(is_short)));
  }
}
