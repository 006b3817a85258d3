#include "raster.h"

#include <algorithm>
#include <chrono>
#include <limits>
#include <stdexcept>
#include <utility>

#include "kernels.h"
#include "parallel.h"
#include "projection_params.h"

namespace globalsplat::raster {

namespace {

constexpr int64_t kTask = kSplatsPerTask;  // Gaussians per task of projection and of listing tiles
constexpr int64_t kChunk = 64 * 1024;  // Gaussians of a view per chunk of sorting and binning

// Returns the seconds since its previous lap.
class Stopwatch {
 public:
  double lap() {
    const Clock::time_point now = Clock::now();
    return std::chrono::duration<double>(now - std::exchange(start_, now)).count();
  }

 private:
  using Clock = std::chrono::steady_clock;
  Clock::time_point start_ = Clock::now();
};

int64_t ceil_div(int64_t count, int64_t size) { return (count + size - 1) / size; }

}  // namespace

template <class T>
struct Frame<T>::PerView {
  Buffer<Splat<T>> splats;        // [N]
  Buffer<uint32_t> first_record;  // [N + 1]: Gaussian i's records are first_record[i] … first_record[i + 1] − 1
  Buffer<TileEntry> entries;      // all tiles' lists, one after the other
  Buffer<uint32_t> tile_start;    // [tiles + 1] into entries
};

// Result of a task for one view: the tiles that its Gaussians touch, and the depths of the Gaussians that touch any.
template <class T>
struct Frame<T>::TaskOutput {
  Buffer<TilePair> pairs;
  int64_t pair_count = 0;
  Buffer<DepthItem<T>> depths;
  int64_t depth_count = 0;
  uint32_t pairs_before = 0, depths_before = 0;  // in the view's previous parts
};

template <class T>
Frame<T>::~Frame() = default;

template <class T>
TileJob<T> Frame<T>::job(const PerView& view, int tile) const {
  const uint32_t begin = view.tile_start[size_t(tile)], end = view.tile_start[size_t(tile) + 1];
  return {view.splats.data.get(),
          view.entries.data.get() + begin,
          int64_t(end) - int64_t(begin),
          tile % grid_.columns * kTile,
          tile / grid_.columns * kTile,
          grid_.width,
          grid_.height};
}

// Lists the tiles of one task's splats, while they are in the cache. first_record is relative to the part's own first pair.
template <class T>
void Frame<T>::list_touched_tiles(PerView& view, int64_t begin, int64_t end, TaskOutput& part) const {
  part.pairs = Buffer<TilePair>(size_t(4 * kTask));
  part.depths = Buffer<DepthItem<T>>(size_t(end - begin));
  uint32_t* first = view.first_record.data.get();
  for (int64_t i = begin;;) {
    i = kernels().of<T>().list_touched_tiles(view.splats.data.get(), i, end, grid_, part.pairs.data.get(), int64_t(part.pairs.size),
                                             part.pair_count, first + i);
    if (i == end) break;
    Buffer<TilePair> larger(2 * part.pairs.size + size_t(grid_.tiles()) + 4);
    std::copy_n(part.pairs.data.get(), part.pair_count, larger.data.get());
    part.pairs = std::move(larger);
  }
  for (int64_t i = begin; i < end; ++i) {
    const int64_t next = i + 1 < end ? int64_t(first[i + 1]) : part.pair_count;
    DepthItem<T>& item = part.depths[size_t(part.depth_count)];
    item.splat = uint32_t(i);
    std::memcpy(&item.key, &view.splats[size_t(i)].z, sizeof(T));
    part.depth_count += next > int64_t(first[i]);
  }
}

// Projects all Gaussians to splats, and lists the tiles that these touch: one part for every task of every view.
template <class T>
std::vector<typename Frame<T>::TaskOutput> Frame<T>::project(const Arguments<T>& in) {
  std::vector<TaskOutput> task_outputs(views_.size() * size_t(tasks_));
  std::vector<Splat<T>*> splats;
  for (PerView& view : views_) {
    view.splats = Buffer<Splat<T>>(size_t(count_));
    view.first_record = Buffer<uint32_t>(size_t(count_) + 1);
    splats.push_back(view.splats.data.get());
  }
  parallel_for(num_threads_, in.scenes * tasks_, [&](int64_t task) {
    const int64_t scene = task / tasks_, begin = task % tasks_ * kTask, end = std::min(begin + kTask, count_);
    const size_t first = size_t(scene * in.cameras), last = first + size_t(in.cameras);
    kernels().of<T>().project(in.gaussians.of_scene(scene), begin, end, projection_params_.data() + first, in.cameras,
                              splats.data() + first);
    for (size_t k = first; k < last; ++k)
      list_touched_tiles(views_[k], begin, end, task_outputs[k * size_t(tasks_) + size_t(task % tasks_)]);
  });
  for (size_t k = 0; k < views_.size(); ++k) {
    int64_t pairs = 0, depths = 0;
    for (size_t i = 0; i < size_t(tasks_); ++i) {
      TaskOutput& part = task_outputs[k * size_t(tasks_) + i];
      part.pairs_before = uint32_t(pairs);
      part.depths_before = uint32_t(depths);
      pairs += part.pair_count;
      depths += part.depth_count;
    }
    if (pairs >= int64_t(std::numeric_limits<uint32_t>::max()))
      throw std::length_error("more than 4 billion (Gaussian, tile) pairs in a view");
    views_[k].first_record[size_t(count_)] = uint32_t(pairs);
  }
  return task_outputs;
}

// Sorts each view's splats that touch any tile front to back. Also makes first_record relative to all of the view's pairs.
template <class T>
std::vector<Buffer<DepthItem<T>>> Frame<T>::sort(const std::vector<TaskOutput>& task_outputs) {
  std::vector<Buffer<DepthItem<T>>> order;
  for (size_t k = 0; k < views_.size(); ++k) {
    const TaskOutput* last = tasks_ == 0 ? nullptr : &task_outputs[(k + 1) * size_t(tasks_) - 1];
    order.emplace_back(last == nullptr ? 0 : last->depths_before + size_t(last->depth_count));
  }
  parallel_for(num_threads_, int64_t(task_outputs.size()), [&](int64_t task) {
    const TaskOutput& part = task_outputs[size_t(task)];
    const size_t k = size_t(task / tasks_);
    std::copy_n(part.depths.data.get(), part.depth_count, order[k].data.get() + part.depths_before);
    const int64_t begin = task % tasks_ * kTask, end = std::min(begin + kTask, count_);
    for (int64_t i = begin; i < end; ++i) views_[k].first_record[size_t(i)] += part.pairs_before;
  });
  sort_by_depth<T>(num_threads_, order, chunks());
  return order;
}

// Builds the tiles' lists.
template <class T>
void Frame<T>::bin(const std::vector<TaskOutput>& task_outputs, const std::vector<Buffer<DepthItem<T>>>& order) {
  for (PerView& view : views_) view.entries = Buffer<TileEntry>(view.first_record[size_t(count_)]);
  const auto each = [&](int64_t k, int64_t chunk, const auto& visit) {
    const Buffer<DepthItem<T>>& items = order[size_t(k)];
    const PerView& view = views_[size_t(k)];
    const size_t begin = items.size * size_t(chunk) / size_t(chunks());
    const size_t end = items.size * size_t(chunk + 1) / size_t(chunks());
    const auto first_pair = [&](uint32_t splat) {
      const TaskOutput& part = task_outputs[size_t(k * tasks_) + splat / kTask];
      return part.pairs.data.get() + (view.first_record[splat] - part.pairs_before);
    };
    for (size_t i = begin; i < end; ++i) {
      // Splats in the order of depth are scattered in memory.
      if (i + 16 < end) __builtin_prefetch(&view.first_record[items[i + 16].splat]);
      if (i + 8 < end) __builtin_prefetch(first_pair(items[i + 8].splat));
      const uint32_t splat = items[i].splat;
      const TilePair* pair = first_pair(splat);
      for (uint32_t record = view.first_record[splat]; record < view.first_record[splat + 1]; ++record, ++pair)
        visit(int64_t(pair->tile), TileEntry{splat, record, pair->blocks});
    }
  };
  std::vector<Buffer<uint32_t>> starts = counting_sort(
      num_threads_, int64_t(views_.size()), chunks(), grid_.tiles(),
      [&](int64_t k, int64_t chunk, const auto& visit) {
        if (chunks() > 1) return each(k, chunk, [&](int64_t tile, const TileEntry&) { visit(tile); });
        // With a single chunk, all of a view's pairs are counted in memory order.
        for (int64_t i = 0; i < tasks_; ++i) {
          const TaskOutput& part = task_outputs[size_t(k * tasks_ + i)];
          for (int64_t pair = 0; pair < part.pair_count; ++pair) visit(int64_t(part.pairs[size_t(pair)].tile));
        }
      },
      each,
      [&](int64_t k, uint32_t at, const TileEntry& entry) { views_[size_t(k)].entries[at] = entry; });
  for (size_t k = 0; k < views_.size(); ++k) views_[k].tile_start = std::move(starts[k]);
}

template <class T>
int64_t Frame<T>::chunks() const {
  return std::max<int64_t>(1, ceil_div(count_, kChunk));
}

template <class T>
Frame<T>::Frame(const Arguments<T>& in, int num_threads, const RenderOutput<T>& out, StageTimes& times)
    : num_threads_(num_threads),
      grid_{in.width, in.height, int(ceil_div(in.width, kTile)), int(ceil_div(in.height, kTile))},
      count_(in.gaussians.count),
      tasks_(ceil_div(count_, kTask)),
      views_(size_t(in.scenes * in.cameras)) {
  Stopwatch watch;
  for (size_t k = 0; k < views_.size(); ++k)
    projection_params_.push_back(make_projection_params(camera_of(in.w2c + 16 * k, in.intrinsics + 9 * k), in.width, in.height, in.projection));
  {
    const std::vector<TaskOutput> task_outputs = project(in);
    times.project = watch.lap();
    const std::vector<Buffer<DepthItem<T>>> order = sort(task_outputs);
    times.sort = watch.lap();
    bin(task_outputs, order);
  }
  times.bin = watch.lap();
  const int64_t tiles = grid_.tiles(), pixels = int64_t(in.width) * in.height;
  parallel_for(num_threads_, int64_t(views_.size()) * tiles, [&](int64_t task) {
    const int64_t k = task / tiles;
    kernels().of<T>().blend(job(views_[size_t(k)], int(task % tiles)), out.of_view(k, pixels));
  });
  times.blend = watch.lap();
}

template <class T>
void Frame<T>::backward(const Arguments<T>& in, const RenderOutput<const T>& pictures, const RenderOutput<const T>& gradients,
                        const GaussianGradients<T>& out, T* w2c, StageTimes& times) const {
  Stopwatch watch;
  const int64_t tiles = grid_.tiles(), pixels = int64_t(in.width) * in.height;
  std::vector<Buffer<SplatGradient<T>>> gathered;
  std::vector<SplatRecords<T>> records;
  for (const PerView& view : views_) {
    gathered.emplace_back(view.entries.size);
    records.push_back({gathered.back().data.get(), view.first_record.data.get()});
  }
  parallel_for(num_threads_, int64_t(views_.size()) * tiles, [&](int64_t task) {
    const int64_t k = task / tiles;
    kernels().of<T>().blend_backward(job(views_[size_t(k)], int(task % tiles)), pictures.of_view(k, pixels), gradients.of_view(k, pixels),
                                     gathered[size_t(k)].data.get());
  });
  times.blend_backward = watch.lap();

  // Gradients of the cameras of a scene from each task's Gaussians: [tasks][views].
  std::vector<CameraGradient<T>> camera_gradients(w2c == nullptr ? 0 : size_t(tasks_) * views_.size());
  parallel_for(num_threads_, in.scenes * tasks_, [&](int64_t task) {
    const int64_t scene = task / tasks_, part = task % tasks_, begin = part * kTask, end = std::min(begin + kTask, count_);
    const size_t first = size_t(scene * in.cameras);
    GaussianGradients<T> of_scene = out.of_scene(in.gaussians, scene);
    if (out.means2d != nullptr) of_scene.means2d = out.means2d + 2 * scene * in.cameras * count_;
    kernels().of<T>().project_backward(in.gaussians.of_scene(scene), begin, end, projection_params_.data() + first, in.cameras,
                                       records.data() + first, of_scene,
                                       w2c == nullptr ? nullptr : &camera_gradients[size_t(part) * views_.size() + first]);
  });
  for (size_t k = 0; w2c != nullptr && k < views_.size(); ++k)
    for (int row = 0; row < 4; ++row)
      for (int column = 0; column < 4; ++column) {
        double sum = 0;
        for (size_t part = 0; row < 3 && part < size_t(tasks_); ++part)
          sum += double(camera_gradients[part * views_.size() + k].numbers[column < 3 ? 3 * row + column : 9 + row]);
        w2c[16 * k + size_t(4 * row + column)] = T(sum);
      }
  times.project_backward = watch.lap();
}

template <class T>
PairCounts Frame<T>::count_pairs() const {
  PairCounts counts;
  for (const PerView& view : views_)
    for (int tile = 0; tile < grid_.tiles(); ++tile) kernels().of<T>().count_pairs(job(view, tile), counts);
  return counts;
}

template class Frame<float>;
template class Frame<double>;

}  // namespace globalsplat::raster
