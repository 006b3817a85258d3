#include "jobs.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "counting_sort.h"
#include "kernels.h"
#include "parallel.h"

namespace globalsplat::raster {
namespace {

constexpr int kRows = 16;       // rows of a task
constexpr double kSigma = 1.5;  // standard deviation of SSIM's Gaussian window, in pixels

// Splits each plane into blocks of rows, calls body(plane, begin, end, scratch) for every block in parallel, and returns the sum of the
// results. The sum is in the order of the blocks, so that it doesn't depend on the number of threads.
template <class T, class Body>
double sum_over_rows(int num_threads, int64_t planes, int rows, int width, const Body& body) {
  const int64_t blocks = (rows + kRows - 1) / kRows;
  std::vector<double> sums(size_t(planes * blocks));
  parallel_for(num_threads, planes * blocks, [&](int64_t task) {
    const int begin = int(task % blocks) * kRows;
    thread_local std::vector<T> scratch;
    scratch.resize(std::max(scratch.size(), size_t(loss_scratch_size(width))));
    sums[size_t(task)] = body(task / blocks, begin, std::min(begin + kRows, rows), scratch.data());
  });
  double total = 0;
  for (const double sum : sums) total += sum;
  return total;
}

}  // namespace

template <class T>
const T* ssim_window() {
  static const std::vector<T> weights = [] {
    std::vector<double> exact(kWindow);
    double sum = 0;
    for (int k = 0; k < kWindow; ++k) {
      const double offset = k - (kWindow - 1) / 2;
      sum += exact[size_t(k)] = std::exp(-offset * offset / (2 * kSigma * kSigma));
    }
    std::vector<T> rounded;
    for (const double weight : exact) rounded.push_back(T(weight / sum));
    return rounded;
  }();
  return weights.data();
}

template <class T>
double photometric(const LossJob<T>& job, double l1_weight, double ssim_weight, T* gradient, int num_threads) {
  const int64_t pixels = int64_t(job.width) * job.height;
  const int64_t windows = int64_t(job.width - kWindow + 1) * (job.height - kWindow + 1);
  const Buffer<T> slopes(ssim_weight != 0 && gradient != nullptr ? size_t(3 * windows * job.count) : 0);
  const auto plane_of = [&](int64_t plane) {
    return PhotometricPlane<T>{job.images + plane * pixels,
                               job.photos + plane * pixels,
                               slopes.size > 0 ? slopes.data.get() + 3 * windows * plane : nullptr,
                               gradient != nullptr ? gradient + plane * pixels : nullptr,
                               ssim_window<T>(),
                               job.width,
                               job.height};
  };
  const double each_pixel = 1 / double(pixels * job.count), each_window = 1 / double(windows * job.count);
  double value = 0;
  if (ssim_weight != 0)
    value += ssim_weight * each_window *
             sum_over_rows<T>(num_threads, job.count, job.height - kWindow + 1, job.width,
                              [&](int64_t plane, int begin, int end, T* scratch) {
                                return kernels().of<T>().ssim(plane_of(plane), begin, end, scratch);
                              });
  if (l1_weight != 0 || gradient != nullptr)
    value += l1_weight * each_pixel *
             sum_over_rows<T>(num_threads, job.count, job.height, job.width, [&](int64_t plane, int begin, int end, T* scratch) {
               return kernels().of<T>().photometric_gradient(plane_of(plane), T(l1_weight * each_pixel),
                                                             T(slopes.size > 0 ? ssim_weight * each_window : 0), begin, end, scratch);
             });
  return value;
}

template <class T>
double depth_smoothness(const LossJob<T>& job, double factor, T* gradient, int num_threads) {
  const int64_t width = job.width, height = job.height, pixels = width * height;
  const int64_t pairs = job.count * ((width - 1) * height + width * (height - 1));
  const double each = pairs > 0 ? factor / double(pairs) : 0;
  return each * sum_over_rows<T>(num_threads, job.count, job.height, job.width, [&](int64_t view, int begin, int end, T* scratch) {
           const SmoothnessPlane<T> plane{job.images + view * pixels, job.photos + 3 * view * pixels,
                                          gradient != nullptr ? gradient + view * pixels : nullptr, job.width, job.height};
           return kernels().of<T>().unevenness(plane, T(each), begin, end, scratch);
         });
}

template const float* ssim_window();
template const double* ssim_window();
template double photometric(const LossJob<float>&, double, double, float*, int);
template double photometric(const LossJob<double>&, double, double, double*, int);
template double depth_smoothness(const LossJob<float>&, double, float*, int);
template double depth_smoothness(const LossJob<double>&, double, double*, int);

}  // namespace globalsplat::raster
