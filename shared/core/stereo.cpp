#include "bindings/arguments.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

namespace fleetmap {
namespace {

constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();
constexpr int kCoarseHalf = 4;  // of the windows at half size
constexpr int kMostSide = 2 * kMostStereoHalf + 1;
constexpr int kMostIterations = 12;
constexpr double kSettledPx = 0.005;

struct Disparity {
  double px = kUnknown, sigma_px = kUnknown;
};

struct Peak {
  ptrdiff_t disparity = -1;
  double correlation = -1.0, rival = -1.0;  // that of the best disparity, and of the best that is not its neighbour
};

// rho of one window on the left with many on the right. Sums are whole numbers below 2^24, which floats add without rounding in any
// order: all columns of a row at once.
class Correlation {
 public:
  Correlation(ptrdiff_t most_columns, StereoMatcher::Columns& columns) : room_(most_columns + 2 * kMostStereoHalf + 8), of_(columns) {
    of_.rows.resize(kMostSide * room_);
    for (auto* each : {&of_.sums, &of_.squares, &of_.window_sums, &of_.window_squares, &of_.products}) each->resize(room_);
    of_.correlations.resize(room_);
  }

  // rho[n], n < count: of the left window around (x, y) with the right one around (x_first + n, y). All windows lie inside.
  const double* operator()(const StereoPair& pair, ptrdiff_t x, ptrdiff_t y, ptrdiff_t x_first, ptrdiff_t count, int half) {
    const int side = 2 * half + 1;
    const double area = side * side;
    const ptrdiff_t columns = count + 2 * half;
    std::fill_n(of_.sums.begin(), columns, 0.0f);
    std::fill_n(of_.squares.begin(), columns, 0.0f);
    float l[kMostSide][kMostSide];
    double sum_l = 0.0, sum_ll = 0.0;
    for (int v = 0; v < side; ++v) {
      const uint8_t* left = pair.left.row(y - half + v) + x - half;
      for (int u = 0; u < side; ++u) {
        l[v][u] = float(left[u]);
        sum_l += left[u];
        sum_ll += left[u] * left[u];
      }
      const uint8_t* right = pair.right.row(y - half + v) + x_first - half;
      float* __restrict r = row(v);
      float* __restrict sum = of_.sums.data(), * __restrict square = of_.squares.data();
      for (ptrdiff_t k = 0; k < columns; ++k) {
        r[k] = float(right[k]);
        sum[k] += r[k];
        square[k] += r[k] * r[k];
      }
    }
    correlate(l, side, count);
    float sum_r = 0.0f, sum_rr = 0.0f;
    for (ptrdiff_t k = 0; k < side - 1; ++k) sum_r += of_.sums[k], sum_rr += of_.squares[k];
    for (ptrdiff_t n = 0; n < count; ++n) {
      of_.window_sums[n] = sum_r += of_.sums[n + side - 1];
      of_.window_squares[n] = sum_rr += of_.squares[n + side - 1];
      sum_r -= of_.sums[n];
      sum_rr -= of_.squares[n];
    }
    const double energy_l = sum_ll - sum_l * sum_l / area;
    const float *products = of_.products.data(), *window_sums = of_.window_sums.data(), *window_squares = of_.window_squares.data();
    double* __restrict rho = of_.correlations.data();
    for (ptrdiff_t n = 0; n < count; ++n) {
      const double sum = window_sums[n], energies = energy_l * (window_squares[n] - sum * sum / area);
      const double value = (products[n] - sum_l * sum / area) / std::sqrt(energies);
      rho[n] = energies < 1e-6 ? -1.0 : value;
    }
    return of_.correlations.data();
  }

 private:
  float* row(int v) { return of_.rows.data() + v * room_; }

  // products[n] = sum l r; values beyond the rows' last column affect only products beyond count.
  void correlate(const float (&l)[kMostSide][kMostSide], int side, ptrdiff_t count) {
    for (ptrdiff_t n = 0; n < count; n += 8) {
      Eight<float> total = {};
      for (int v = 0; v < side; ++v) {
        const float* r = row(v) + n;
        Eight<float> of_row = {};
        for (int u = 0; u < side; ++u) of_row += l[v][u] * eight(r + u);
        total += of_row;
      }
      std::memcpy(of_.products.data() + n, &total, sizeof total);
    }
  }

  ptrdiff_t room_;
  StereoMatcher::Columns& of_;
};

// The whole-pixel disparity in [first, last] where rho is highest.
Peak search(const StereoPair& pair, ptrdiff_t x, ptrdiff_t y, ptrdiff_t first, ptrdiff_t last, int half, Correlation& correlation) {
  const ptrdiff_t height = pair.left.height, width = pair.left.width;
  if (y < half || y + half >= height || x < half || x + half >= width) return {};
  const ptrdiff_t x_first = std::max<ptrdiff_t>(x - last, half), x_last = std::min(x - first, width - 1 - half);
  const ptrdiff_t count = x_last - x_first + 1;
  if (count <= 0) return {};
  const double* rho = correlation(pair, x, y, x_first, count, half);
  Peak peak;
  ptrdiff_t best = -1;
  for (ptrdiff_t n = count; n-- > 0;)
    if (rho[n] > peak.correlation) best = n, peak.correlation = rho[n];
  if (best < 0) return {};
  for (ptrdiff_t n = 0; n < count; ++n)
    if (std::abs(n - best) > 2 && rho[n] > peak.rival) peak.rival = rho[n];
  peak.disparity = x - (x_first + best);
  return peak;
}

// Numbers of a row of samples: whole registers, of which those beyond the wanted ones mean nothing.
constexpr int stride_of(int half, int rim) { return (2 * (half + rim) + 4) / 4 * 4; }
constexpr int kMostStride = stride_of(kMostStereoHalf, 1);
using Samples = double[kMostSide * kMostStride];

// As many pixels as fill whole registers.
void widen(const uint8_t* __restrict pixels, double* __restrict to, int count) {
  for (int k = 0; k < (count + 7) / 8 * 8; ++k) to[k] = pixels[k];
}

void mix(const Bilinear<double>& at, const double* upper, const double* lower, double* __restrict to, int count) {
  for (int k = 0; k < count; ++k) to[k] = at(upper + k, lower + k);
}

// Brightness between pixels, whole steps apart: 2 half + 1 rows around (x, y), each of which goes on by `rim` pixels on both sides. All,
// and a row below, must lie inside.
void sample(GreyImage image, double x, double y, int half, int rim, Samples& samples) {
  const ptrdiff_t column = ptrdiff_t(x), row = ptrdiff_t(y);
  const Bilinear<double> at(x - double(column), y - double(row));
  const int columns = 2 * (half + rim) + 1, stride = stride_of(half, rim);
  double grey[2][kMostStride + 8] = {}, *to = samples;
  const auto line = [&](ptrdiff_t v) { return grey[v & 1]; };
  const auto take = [&](ptrdiff_t v) { widen(image.row(v) + column - half - rim, line(v), columns + 1); };
  take(row - half);
  for (ptrdiff_t v = row - half; v <= row + half; ++v, to += stride) {
    take(v + 1);
    mix(at, line(v), line(v + 1), to, stride);
  }
}

// Gauss-Newton from a disparity; unknown unless it converges.
Disparity refine(const StereoPair& pair, double x, double y, double disparity, int half) {
  const double height = double(pair.right.height), width = double(pair.right.width);
  const int side = 2 * half + 1, area = side * side, stride_l = stride_of(half, 0), stride = stride_of(half, 1);
  if (x - half < 1 || y - half < 1 || x + half + 2 >= width || y + half + 2 >= height) return {};
  Samples l, r;
  sample(pair.left, x, y, half, 0, l);
  const auto for_each_left = [&](const auto& visit) {
    for (int v = 0; v < side; ++v)
      for (int u = 0; u < side; ++u) visit(l[v * stride_l + u]);
  };
  double mean_l = 0.0, energy = 0.0;
  for_each_left([&](double value) { mean_l += value; });
  mean_l /= area;
  for_each_left([&](double& value) {
    value -= mean_l;
    energy += value * value;
  });
  if (energy < area) return {};
  for (int iteration = 0; iteration < kMostIterations; ++iteration) {
    const double x_right = x - disparity;
    if (x_right - half < 2 || x_right + half + 3 >= width) return {};
    sample(pair.right, x_right, y, half, 1, r);
    double sum_r = 0.0, sum_rr = 0.0, sum_lr = 0.0;
    for (int v = 0; v < side; ++v)
      for (int u = 0; u < side; ++u) {
        const double value = r[v * stride + u + 1];
        sum_r += value;
        sum_rr += value * value;
        sum_lr += l[v * stride_l + u] * value;
      }
    const double mean_r = sum_r / area, gain = sum_lr / std::max(sum_rr - sum_r * mean_r, 1e-9);
    if (gain < 0.4 || gain > 2.5) return {};
    double sum_jj = 0.0, sum_je = 0.0, sum_ee = 0.0;
    for (int v = 0; v < side; ++v)
      for (int u = 0; u < side; ++u) {
        const double* at = r + v * stride + u + 1;
        const double j = 0.5 * gain * (at[1] - at[-1]), e = l[v * stride_l + u] - gain * (at[0] - mean_r);
        sum_jj += j * j;
        sum_je += j * e;
        sum_ee += e * e;
      }
    if (sum_jj < 10.0 * area) return {};
    const double step = sum_je / sum_jj;
    disparity -= step;
    if (std::abs(step) > 2.0) return {};
    if (std::abs(step) < kSettledPx) {
      if (sum_ee > 0.3 * energy) return {};
      return {disparity, std::sqrt((sum_ee / area + 4.0) / sum_jj)};
    }
  }
  return {};
}

Disparity match(const StereoPair& whole, const StereoPair& halved, double x, double y, double prior_px, const StereoLimits& limits,
                Correlation& correlation) {
  if (!(x > -1.0 && y > -1.0 && x < double(whole.left.width) && y < double(whole.left.height))) return {};
  const ptrdiff_t column = ptrdiff_t(x + 0.5), row = ptrdiff_t(y + 0.5);
  ptrdiff_t around;
  if (prior_px == prior_px) {
    around = ptrdiff_t(std::clamp(prior_px, -1e6, 1e6) + 0.5);
    around = std::max<ptrdiff_t>(around, 3);
  } else {
    const Peak coarse = search(halved, column / 2, row / 2, 0, ptrdiff_t(limits.max_disparity_px / 2), kCoarseHalf, correlation);
    if (coarse.correlation < limits.min_correlation || coarse.rival > limits.uniqueness * coarse.correlation) return {};
    around = 2 * coarse.disparity;
  }
  const Peak peak = search(whole, column, row, std::max<ptrdiff_t>(around - 3, 0), around + 3, limits.wide_half, correlation);
  if (peak.correlation < limits.min_correlation) return {};
  const Disparity wide = refine(whole, x, y, double(peak.disparity), limits.wide_half);
  if (std::isnan(wide.px)) return {};
  const Disparity narrow = refine(whole, x, y, wide.px, limits.narrow_half);
  const double apart = wide.px - narrow.px;  // as a standard deviation, half of it
  if (std::isnan(narrow.px) || std::abs(apart) > limits.agreement_px) return {};
  return {narrow.px, std::sqrt(narrow.sigma_px * narrow.sigma_px + 0.25 * apart * apart)};
}

}  // namespace

void StereoMatcher::match_rows(const StereoPair& whole, const StereoPair& halved, const double* pixels, const double* prior_px,
                               size_t count, const StereoLimits& limits, double* out) {
  Correlation correlation(ptrdiff_t(limits.max_disparity_px) + 8, columns_);
  for (size_t n = 0; n < count; ++n) {
    const Disparity found = match(whole, halved, pixels[2 * n], pixels[2 * n + 1], prior_px[n], limits, correlation);
    out[2 * n] = found.px;
    out[2 * n + 1] = found.sigma_px;
  }
}

void match_depth(const Picture<const float>& disparity_px, const double* pixels, size_t count, double sigma_px, double* out) {
  for (size_t n = 0; n < count; ++n) {
    out[2 * n] = out[2 * n + 1] = kUnknown;
    const double x = std::nearbyint(pixels[2 * n]), y = std::nearbyint(pixels[2 * n + 1]);
    if (!(x > 0.0 && y > 0.0 && x < double(disparity_px.width - 1) && y < double(disparity_px.height - 1))) continue;
    float patch[9];
    for (int v = 0; v < 3; ++v) std::copy_n(disparity_px.row(ptrdiff_t(y) - 1 + v) + ptrdiff_t(x) - 1, 3, patch + 3 * v);
    if (!std::all_of(patch, patch + 9, [](float value) { return std::isfinite(value); })) continue;
    std::sort(patch, patch + 9);
    if (!(patch[8] - patch[0] < 0.08f * patch[4] + 0.5f)) continue;
    out[2 * n] = patch[4], out[2 * n + 1] = sigma_px;
  }
}

namespace {

auto match_rows(const Image& left, const Image& right, const Image& left_half, const Image& right_half, const Places& pixels,
                const Reals& prior_px, const nb::object& stereo, double max_disparity_px) {
  if (!same_size(left, right) || !same_size(left_half, right_half)) throw nb::value_error("right: of the left image's size");
  check_rows(pixels.shape(0), "prior_px: one for each pixel", prior_px);
  const size_t count = pixels.shape(0);
  std::vector<double> found(2 * count);
  const StereoLimits limits = stereo_limits({stereo}, max_disparity_px);
  unlocked([&] {
    StereoMatcher().match_rows({left, right}, {left_half, right_half}, pixels.data(), prior_px.data(), count, limits, found.data());
  });
  return as_numpy<double, 2>(std::move(found), {count, 2});
}

auto match_depth_of(const Array<float, -1, -1>& disparity_px, const Places& pixels, double sigma_px) {
  const size_t count = pixels.shape(0);
  std::vector<double> found(2 * count);
  unlocked([&] { match_depth(disparity_px, pixels.data(), count, sigma_px, found.data()); });
  return as_numpy<double, 2>(std::move(found), {count, 2});
}

}  // namespace

void bind_stereo(nb::module_& module) {
  module.def("match_rows", &match_rows, "left"_a, "right"_a, "left_half"_a, "right_half"_a, "pixels"_a, "prior_px"_a, "stereo"_a,
             "max_disparity_px"_a);
  module.def("match_depth", &match_depth_of, "disparity_px"_a, "pixels"_a, "sigma_px"_a);
}

}  // namespace fleetmap
