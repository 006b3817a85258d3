#include "raster.h"

#include <algorithm>
#include <chrono>
#include <limits>
#include <stdexcept>
#include <utility>

#include "bins.h"
#include "kernels.h"
#include "parallel.h"
#include "project.h"

namespace globalsplat::raster {

namespace {

constexpr int64_t kBlock = 1024;  // Gaussians a task projects
constexpr uint32_t kUnseen = std::numeric_limits<uint32_t>::max();

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

int64_t blocks(int64_t count) { return (count + kBlock - 1) / kBlock; }

template <class T>
const BlendKernels<T>& blend_kernels() {
  if constexpr (sizeof(T) == 4)
    return kernels().blend32;
  else
    return kernels().blend64;
}

}  // namespace

template <class T>
struct Frame<T>::PerView {
  View<T> view;
  std::vector<Splat<T>> splats;        // visible, front to back
  std::vector<uint32_t> rank;          // [N] of a Gaussian in `splats`, or kUnseen
  std::vector<uint32_t> first_record;  // [visible + 1]: a splat's records are first_record[i] … first_record[i + 1]
  std::vector<TileEntry> entries;      // all tiles' lists, one after the other
  std::vector<int64_t> tile_start;     // [tiles + 1] into entries

  // From projected splats in Gaussian order (z = 0 where not seen) to the sorted tile lists.
  void bin(std::vector<Splat<T>> projected, int tiles_x, int tiles_y, const Settings& settings) {
    const size_t n = projected.size();
    std::vector<uint32_t> seen;
    std::vector<T> depths;
    for (size_t i = 0; i < n; ++i) {
      if (!(projected[i].z > 0)) continue;
      seen.push_back(uint32_t(i));
      depths.push_back(projected[i].z);
    }
    const std::vector<uint32_t> order = order_by_depth(depths);
    splats.resize(order.size());
    rank.assign(n, kUnseen);
    for (size_t i = 0; i < order.size(); ++i) {
      const uint32_t gaussian = seen[order[i]];
      splats[i] = projected[gaussian];
      rank[gaussian] = uint32_t(i);
    }

    // Count, sum, fill: going through the splats front to back keeps every tile's list sorted.
    const auto visit_tiles = [&](const Splat<T>& s, auto visit) {
      for_each_tile_row(s, tiles_x, tiles_y, settings.width, settings.height, visit);
    };
    tile_start.assign(size_t(tiles_x) * tiles_y + 1, 0);
    first_record.assign(splats.size() + 1, 0);
    int64_t records = 0;
    for (size_t i = 0; i < splats.size(); ++i) {
      first_record[i] = uint32_t(records);
      visit_tiles(splats[i], [&](int row, int begin, int end) {
        for (int column = begin; column < end; ++column) ++tile_start[size_t(row) * tiles_x + column + 1];
        records += end - begin;
      });
      if (records >= int64_t(kUnseen)) throw std::length_error("more than 4 billion (Gaussian, tile) pairs in a view");
    }
    first_record[splats.size()] = uint32_t(records);
    for (size_t tile = 1; tile < tile_start.size(); ++tile) tile_start[tile] += tile_start[tile - 1];
    entries.resize(size_t(records));
    std::vector<int64_t> next(tile_start.begin(), tile_start.end() - 1);
    uint32_t record = 0;
    for (size_t i = 0; i < splats.size(); ++i)
      visit_tiles(splats[i], [&](int row, int begin, int end) {
        for (int column = begin; column < end; ++column)
          entries[size_t(next[size_t(row) * tiles_x + column]++)] = {uint32_t(i), record++};
      });
  }
};

template <class T>
Frame<T>::Frame(const std::vector<View<T>>& views, const Settings& settings)
    : settings_(settings),
      tiles_x_((settings.width + kTile - 1) / kTile),
      tiles_y_((settings.height + kTile - 1) / kTile),
      views_(views.size()) {
  for (size_t k = 0; k < views.size(); ++k) views_[k].view = views[k];
}

template <class T>
Frame<T>::~Frame() = default;

template <class T>
TileJob<T> Frame<T>::job(const PerView& view, int tile) const {
  const int64_t begin = view.tile_start[size_t(tile)], end = view.tile_start[size_t(tile) + 1];
  return {view.splats.data(),        view.entries.data() + begin,  end - begin,    tile % tiles_x_ * kTile,
          tile / tiles_x_ * kTile, settings_.width, settings_.height};
}

template <class T>
std::unique_ptr<Frame<T>> Frame<T>::draw(const std::vector<Gaussians<T>>& scenes, const std::vector<View<T>>& views,
                                         const Settings& settings, const std::vector<Pictures<T>>& out,
                                         StageTimes& times) {
  Stopwatch watch;
  std::unique_ptr<Frame> frame(new Frame(views, settings));
  const BlendKernels<T>& blend = blend_kernels<T>();
  const int64_t count = scenes.empty() ? 0 : scenes[0].count;
  const int64_t views_count = int64_t(views.size()), tiles = int64_t(frame->tiles_x_) * frame->tiles_y_;

  std::vector<std::vector<Splat<T>>> projected(views.size(), std::vector<Splat<T>>(size_t(count)));
  parallel_for(settings.threads, views_count * blocks(count), [&](int64_t task) {
    const size_t view = size_t(task / blocks(count));
    const int64_t begin = task % blocks(count) * kBlock, end = std::min(begin + kBlock, count);
    const Lens<T> lens(views[view].camera, settings.width, settings.height, T(settings.eps2d));
    Projection<T> unused;
    for (int64_t i = begin; i < end; ++i) {
      Splat<T>& s = projected[view][size_t(i)];
      if (!project(scenes[size_t(views[view].scene)], i, lens, unused, s)) s.z = 0;
    }
  });
  times.project = watch.lap();
  parallel_for(settings.threads, views_count, [&](int64_t view) {
    frame->views_[size_t(view)].bin(std::move(projected[size_t(view)]), frame->tiles_x_, frame->tiles_y_, settings);
  });
  times.bin = watch.lap();
  parallel_for(settings.threads, views_count * tiles, [&](int64_t task) {
    const size_t view = size_t(task / tiles);
    blend.forward(frame->job(frame->views_[view], int(task % tiles)), out[view]);
  });
  times.blend = watch.lap();
  return frame;
}

template <class T>
void Frame<T>::backward(const std::vector<Gaussians<T>>& scenes, const std::vector<Pictures<const T>>& pictures,
                        const std::vector<Pictures<const T>>& gradients,
                        const std::vector<GaussianGradients<T>>& out, StageTimes& times) const {
  const BlendKernels<T>& blend = blend_kernels<T>();
  const int64_t count = scenes.empty() ? 0 : scenes[0].count, bases = scenes.empty() ? 0 : scenes[0].bases;
  const int64_t tiles = int64_t(tiles_x_) * tiles_y_;

  Stopwatch watch;
  std::vector<std::vector<SplatGradient<T>>> records(views_.size());
  for (size_t k = 0; k < views_.size(); ++k) records[k].resize(views_[k].entries.size());
  parallel_for(settings_.threads, int64_t(views_.size()) * tiles, [&](int64_t task) {
    const size_t k = size_t(task / tiles);
    blend.backward(job(views_[k], int(task % tiles)), pictures[k], gradients[k], records[k].data());
  });

  times.blend_backward = watch.lap();
  parallel_for(settings_.threads, int64_t(scenes.size()) * blocks(count), [&](int64_t task) {
    const size_t scene = size_t(task / blocks(count));
    const int64_t begin = task % blocks(count) * kBlock, end = std::min(begin + kBlock, count);
    std::vector<GaussianGradient<T>> sums(size_t(end - begin));
    for (size_t k = 0; k < views_.size(); ++k) {
      const PerView& seen = views_[k];
      if (size_t(seen.view.scene) != scene) continue;
      const Lens<T> lens(seen.view.camera, settings_.width, settings_.height, T(settings_.eps2d));
      for (int64_t i = begin; i < end; ++i) {
        const uint32_t rank = seen.rank[size_t(i)];
        if (rank == kUnseen || seen.first_record[rank] == seen.first_record[rank + 1]) continue;
        SplatGradient<T> d{};
        for (uint32_t r = seen.first_record[rank]; r < seen.first_record[rank + 1]; ++r) d += records[k][r];
        Projection<T> projection;
        Splat<T> splat;
        project(scenes[scene], i, lens, projection, splat);
        project_backward(scenes[scene], i, lens, projection, splat, d, sums[size_t(i - begin)]);
      }
    }
    const GaussianGradients<T>& to = out[scene];
    for (int64_t i = begin; i < end; ++i) {
      const GaussianGradient<T>& sum = sums[size_t(i - begin)];
      std::copy_n(sum.mean, 3, to.means + 3 * i);
      std::copy_n(sum.scale, 3, to.scales + 3 * i);
      std::copy_n(sum.quaternion, 4, to.quaternions + 4 * i);
      to.opacities[i] = sum.opacity;
      std::copy_n(sum.sh, 3 * bases, to.sh + 3 * bases * i);
    }
  });
  times.project_backward = watch.lap();
}

template class Frame<float>;
template class Frame<double>;

}  // namespace globalsplat::raster
