#include "raster.h"

#include <algorithm>
#include <chrono>
#include <limits>
#include <stdexcept>
#include <utility>

#include "bins.h"
#include "kernels.h"
#include "parallel.h"

namespace globalsplat::raster {

namespace {

constexpr int64_t kTask = kCoverTask;  // Gaussians that a task projects or covers
constexpr int64_t kChunk = 64 * 1024;  // Gaussians of a view that are sorted and binned side by side

// Tells the seconds since it was last asked.
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

int64_t parts(int64_t count, int64_t size) { return (count + size - 1) / size; }

}  // namespace

template <class T>
Lens<T> lens_of(const Camera<T>& camera, int width, int height, double eps2d) {
  Lens<T> lens{camera, width, height, T(eps2d), {}, 0, 0, 0, 0};
  const T *r = camera.rotation, *t = camera.translation;
  for (int k = 0; k < 3; ++k) lens.centre[k] = -(r[k] * t[0] + r[3 + k] * t[1] + r[6 + k] * t[2]);
  const T margin_x = T(kJacobianMargin) * width / camera.fx, margin_y = T(kJacobianMargin) * height / camera.fy;
  lens.x_low = -camera.cx / camera.fx - margin_x;
  lens.x_high = (width - camera.cx) / camera.fx + margin_x;
  lens.y_low = -camera.cy / camera.fy - margin_y;
  lens.y_high = (height - camera.cy) / camera.fy + margin_y;
  return lens;
}

template <class T>
struct Frame<T>::PerView {
  Buffer<Splat<T>> splats;        // [N]
  Buffer<uint32_t> first_record;  // [N + 1]: Gaussian i's records are first_record[i] … first_record[i + 1] − 1
  Buffer<TileEntry> entries;      // all tiles' lists, one after the other
  Buffer<uint32_t> tile_start;    // [tiles + 1] into entries
};

template <class T>
Frame<T>::Frame(const std::vector<View<T>>& views, size_t scenes, const Settings& settings)
    : settings_(settings),
      grid_{settings.width, settings.height, int(parts(settings.width, kTile)), int(parts(settings.height, kTile))},
      views_(views.size()),
      first_view_(scenes + 1, 0) {
  for (const View<T>& view : views) {
    lenses_.push_back(lens_of(view.camera, settings.width, settings.height, settings.eps2d));
    ++first_view_[size_t(view.scene) + 1];
  }
  for (size_t scene = 0; scene < scenes; ++scene) first_view_[scene + 1] += first_view_[scene];
}

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
          settings_.width,
          settings_.height};
}

// From splats to the tiles' lists, front to back.
template <class T>
void Frame<T>::bin(StageTimes& times) {
  Stopwatch watch;
  const int64_t views = int64_t(views_.size()), count = views == 0 ? 0 : int64_t(views_[0].splats.size);
  const int64_t tasks = parts(count, kTask), chunks = std::max<int64_t>(1, parts(count, kChunk));

  // Every task lists the tiles of its splats in a buffer of its own. Places in it become places among the view's records
  // when all the lists' lengths are known.
  struct Part {
    Buffer<TilePair> pairs;
    int64_t used = 0;
    uint32_t seen = 0;          // splats that reach any tile
    uint32_t base = 0, rank = 0;  // records, and splats that reach any tile, of the parts before it
  };
  std::vector<Part> lists(size_t(views * tasks));
  for (PerView& view : views_) view.first_record = Buffer<uint32_t>(size_t(count) + 1);
  parallel_for(settings_.threads, views * tasks, [&](int64_t task) {
    PerView& view = views_[size_t(task / tasks)];
    Part& part = lists[size_t(task)];
    const int64_t begin = task % tasks * kTask, end = std::min(begin + kTask, count);
    uint32_t* first = view.first_record.data.get();
    part.pairs = Buffer<TilePair>(size_t(4 * kTask));
    for (int64_t i = begin;;) {
      i = kernels().of<T>().cover(view.splats.data.get(), i, end, grid_, part.pairs.data.get(), int64_t(part.pairs.size),
                                  part.used, first + i);
      if (i == end) break;
      Buffer<TilePair> larger(2 * part.pairs.size + size_t(grid_.tiles()) + 4);
      std::copy_n(part.pairs.data.get(), part.used, larger.data.get());
      part.pairs = std::move(larger);
    }
    for (int64_t i = begin; i < end; ++i) {
      const int64_t next = i + 1 < end ? int64_t(first[i + 1]) : part.used;
      part.seen += next > int64_t(first[i]);
    }
  });
  times.cover = watch.lap();

  std::vector<Buffer<DepthItem<T>>> order(views_.size());
  for (size_t k = 0; k < views_.size(); ++k) {
    int64_t records = 0;
    uint32_t seen = 0;
    for (size_t i = 0; i < size_t(tasks); ++i) {
      Part& part = lists[k * size_t(tasks) + i];
      part.base = uint32_t(records);
      part.rank = seen;
      records += part.used;
      seen += part.seen;
    }
    if (records >= int64_t(std::numeric_limits<uint32_t>::max()))
      throw std::length_error("more than 4 billion (Gaussian, tile) pairs in a view");
    views_[k].first_record[size_t(count)] = uint32_t(records);
    views_[k].entries = Buffer<TileEntry>(size_t(records));
    order[k] = Buffer<DepthItem<T>>(seen);
  }
  parallel_for(settings_.threads, views * tasks, [&](int64_t task) {
    PerView& view = views_[size_t(task / tasks)];
    const Part& part = lists[size_t(task)];
    const int64_t begin = task % tasks * kTask, end = std::min(begin + kTask, count);
    DepthItem<T>* item = order[size_t(task / tasks)].data.get() + part.rank;
    for (int64_t i = begin; i < end; ++i) {
      uint32_t& first = view.first_record[size_t(i)];
      const int64_t next = i + 1 < end ? int64_t(view.first_record[size_t(i) + 1]) : part.used;
      if (next > int64_t(first)) {
        std::memcpy(&item->key, &view.splats[size_t(i)].z, sizeof(T));
        item++->splat = uint32_t(i);
      }
      first += part.base;
    }
  });
  sort_by_depth<T>(settings_.threads, order, chunks);
  times.sort = watch.lap();

  std::vector<Buffer<uint32_t>> starts = distribute(
      settings_.threads, views, chunks, grid_.tiles(),
      [&](int64_t k, int64_t chunk, const auto& visit) {
        const Buffer<DepthItem<T>>& items = order[size_t(k)];
        const PerView& view = views_[size_t(k)];
        const size_t begin = items.size * size_t(chunk) / size_t(chunks);
        const size_t end = items.size * size_t(chunk + 1) / size_t(chunks);
        for (size_t i = begin; i < end; ++i) {
          const uint32_t splat = items[i].splat;
          const Part& part = lists[size_t(k * tasks + splat / kTask)];
          for (uint32_t record = view.first_record[splat]; record < view.first_record[splat + 1]; ++record) {
            const TilePair& pair = part.pairs[record - part.base];
            visit(int64_t(pair.tile), TileEntry{splat, record, pair.blocks});
          }
        }
      },
      [&](int64_t k, uint32_t at, const TileEntry& entry) { views_[size_t(k)].entries[at] = entry; });
  for (size_t k = 0; k < views_.size(); ++k) views_[k].tile_start = std::move(starts[k]);
  times.bin = watch.lap();
}

template <class T>
std::unique_ptr<Frame<T>> Frame<T>::draw(const std::vector<Gaussians<T>>& scenes, const std::vector<View<T>>& views,
                                         const Settings& settings, const std::vector<Pictures<T>>& out,
                                         StageTimes& times) {
  Stopwatch watch;
  std::unique_ptr<Frame> frame(new Frame(views, scenes.size(), settings));
  const int64_t count = scenes.empty() ? 0 : scenes[0].count, tasks = parts(count, kTask);
  std::vector<Splat<T>*> splats;
  for (PerView& view : frame->views_) {
    view.splats = Buffer<Splat<T>>(size_t(count));
    splats.push_back(view.splats.data.get());
  }
  parallel_for(settings.threads, int64_t(scenes.size()) * tasks, [&](int64_t task) {
    const size_t scene = size_t(task / tasks), first = frame->first_view_[scene];
    const int64_t begin = task % tasks * kTask, end = std::min(begin + kTask, count);
    kernels().of<T>().project(scenes[scene], begin, end, frame->lenses_.data() + first,
                              int64_t(frame->first_view_[scene + 1] - first), splats.data() + first);
  });
  times.project = watch.lap();
  frame->bin(times);
  watch.lap();
  const int64_t tiles = frame->grid_.tiles();
  parallel_for(settings.threads, int64_t(views.size()) * tiles, [&](int64_t task) {
    kernels().of<T>().blend(frame->job(frame->views_[size_t(task / tiles)], int(task % tiles)), out[size_t(task / tiles)]);
  });
  times.blend = watch.lap();
  return frame;
}

template <class T>
void Frame<T>::backward(const std::vector<Gaussians<T>>& scenes, const std::vector<Pictures<const T>>& pictures,
                        const std::vector<Pictures<const T>>& gradients,
                        const std::vector<GaussianGradients<T>>& out, StageTimes& times) const {
  Stopwatch watch;
  const int64_t tiles = grid_.tiles();
  std::vector<Buffer<SplatGradient<T>>> gathered;
  std::vector<SplatRecords<T>> records;
  for (const PerView& view : views_) {
    gathered.emplace_back(view.entries.size);
    records.push_back({gathered.back().data.get(), view.first_record.data.get()});
  }
  parallel_for(settings_.threads, int64_t(views_.size()) * tiles, [&](int64_t task) {
    const size_t k = size_t(task / tiles);
    kernels().of<T>().blend_backward(job(views_[k], int(task % tiles)), pictures[k], gradients[k], gathered[k].data.get());
  });
  times.blend_backward = watch.lap();

  const int64_t count = scenes.empty() ? 0 : scenes[0].count, tasks = parts(count, kTask);
  parallel_for(settings_.threads, int64_t(scenes.size()) * tasks, [&](int64_t task) {
    const size_t scene = size_t(task / tasks), first = first_view_[scene];
    const int64_t begin = task % tasks * kTask, end = std::min(begin + kTask, count);
    kernels().of<T>().project_backward(scenes[scene], begin, end, lenses_.data() + first,
                                       int64_t(first_view_[scene + 1] - first), records.data() + first, out[scene]);
  });
  times.project_backward = watch.lap();
}

template <class T>
PairCounts Frame<T>::count() const {
  PairCounts sum;
  for (const PerView& view : views_)
    for (int tile = 0; tile < grid_.tiles(); ++tile) {
      const PairCounts counts = kernels().of<T>().count(job(view, tile));
      sum.tile_entries += counts.tile_entries;
      sum.evaluated += counts.evaluated;
      sum.contributing += counts.contributing;
    }
  return sum;
}

double multiply_add_peak(int threads, double seconds) {
  std::vector<double> rates(size_t(threads), 0.);
  parallel_for(threads, threads, [&](int64_t i) {
    const auto start = std::chrono::steady_clock::now();
    float out = 1;
    int64_t operations = 0;
    double elapsed = 0;
    while (elapsed < seconds) {
      operations += kernels().multiply_adds(1 << 16, &out);
      elapsed = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    }
    rates[size_t(i)] = double(operations) / elapsed;
  });
  double sum = 0;
  for (const double rate : rates) sum += rate;
  return sum;
}

template Lens<float> lens_of(const Camera<float>&, int, int, double);
template Lens<double> lens_of(const Camera<double>&, int, int, double);
template class Frame<float>;
template class Frame<double>;

}  // namespace globalsplat::raster
