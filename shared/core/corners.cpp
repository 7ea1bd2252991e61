#include "corners.h"
#include "bindings/arguments.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <functional>
#include <numbers>

namespace fleetmap {
namespace {

constexpr ptrdiff_t kCircleRadius = 3;

inline Eight<int16_t> wide(const uint8_t* pixels) { return __builtin_convertvector(eight(pixels), Eight<int16_t>); }

template <bool kHighest>
inline uint8_t extreme(uint8_t a, uint8_t b) {
  return (kHighest ? a > b : a < b) ? a : b;
}

// Of all nine pixels in a row of the circle their highest, and of those the lowest; or the other way round. Rows of nine share rows
// of eight. All loops are unrolled, so that the caller's loop over pixels becomes one over wide registers.
template <bool kHighest>
inline uint8_t best_arc(const uint8_t (&circle)[16]) {
  uint8_t twos[8], fours[8], eights[8];
#pragma GCC unroll 8
  for (int k = 0; k < 8; ++k) twos[k] = extreme<kHighest>(circle[2 * k + 1], circle[(2 * k + 2) % 16]);
#pragma GCC unroll 8
  for (int k = 0; k < 8; ++k) fours[k] = extreme<kHighest>(twos[k], twos[(k + 1) % 8]);
#pragma GCC unroll 8
  for (int k = 0; k < 8; ++k) eights[k] = extreme<kHighest>(fours[k], fours[(k + 2) % 8]);
  uint8_t best = extreme<kHighest>(eights[0], extreme<!kHighest>(circle[0], circle[9]));
#pragma GCC unroll 8
  for (int k = 1; k < 8; ++k)
    best = extreme<!kHighest>(best, extreme<kHighest>(eights[k], extreme<!kHighest>(circle[2 * k], circle[(2 * k + 9) % 16])));
  return best;
}

// Scores of pixels of a row, 0 for no corner.
[[gnu::always_inline]] inline void score_pixels(const uint8_t* __restrict at, ptrdiff_t stride, ptrdiff_t count, uint8_t threshold,
                                                uint8_t* __restrict score) {
  const uint8_t *up3 = at - 3 * stride, *up2 = at - 2 * stride, *up1 = at - stride;
  const uint8_t *down1 = at + stride, *down2 = at + 2 * stride, *down3 = at + 3 * stride;
  for (ptrdiff_t x = 0; x < count; ++x) {
    const uint8_t circle[16] = {up3[x],   up3[x + 1],   up2[x + 2],   up1[x + 3],   at[x + 3], down1[x + 3], down2[x + 2], down3[x + 1],
                                down3[x], down3[x - 1], down2[x - 2], down1[x - 3], at[x - 3], up1[x - 3],   up2[x - 2],   up3[x - 1]};
    const uint8_t centre = at[x], arc_low = best_arc<false>(circle), arc_high = best_arc<true>(circle);
    const uint8_t brighter = arc_low > centre ? arc_low - centre : 0, darker = centre > arc_high ? centre - arc_high : 0;
    const uint8_t found = brighter > darker ? brighter : darker;
    score[x] = found > threshold ? found : 0;
  }
}

// As score_pixels, in blocks of one wide register, of which the last overlaps the one before. `at`: the first pixel of the row that is
// three from the image's edges.
void score_row(const uint8_t* at, ptrdiff_t stride, ptrdiff_t count, uint8_t threshold, uint8_t* score) {
  constexpr ptrdiff_t kBlock = 32;
  if (count < kBlock) return score_pixels(at, stride, count, threshold, score);
  for (ptrdiff_t x = 0; x < count; x += kBlock) {
    const ptrdiff_t begin = std::min(x, count - kBlock);
    score_pixels(at + begin, stride, kBlock, threshold, score + begin);
  }
}

// Scores of a row that are higher than all eight neighbours, 0 for others.
void keep_peaks(const uint8_t* above, const uint8_t* here, const uint8_t* below, uint8_t* __restrict peaks, ptrdiff_t count) {
  for (ptrdiff_t x = 0; x < count; ++x) {
    const auto most = [x](const uint8_t* row) { return extreme<true>(extreme<true>(row[x - 1], row[x]), row[x + 1]); };
    const uint8_t rival = extreme<true>(extreme<true>(most(above), most(below)), extreme<true>(here[x - 1], here[x + 1]));
    peaks[x] = here[x] > rival ? here[x] : 0;
  }
}

// Calls visit(x) for each x from first to last whose byte of the row is not 0.
template <typename Visit>
inline void for_each_set(const uint8_t* row, ptrdiff_t first, ptrdiff_t last, const Visit& visit) {
  ptrdiff_t x = first;
  for (; x + 8 <= last; x += 8) {
    uint64_t bytes;
    std::memcpy(&bytes, row + x, sizeof bytes);
    while (bytes != 0) {
      const int k = std::countr_zero(bytes) / 8;
      bytes &= ~(uint64_t(0xFF) << (8 * k));
      visit(x + k);
    }
  }
  for (; x < last; ++x)
    if (row[x] != 0) visit(x);
}

// Fills the smaller eigenvalue of the gradient matrix around each pixel; 0 at the image's rim.
void min_eigenvalues(GreyImage image, const Pixel* pixels, size_t count, double* scores) {
  constexpr ptrdiff_t kHalf = 3, kRim = kHalf + 1;
  for (size_t n = 0; n < count; ++n) {
    scores[n] = 0.0;
    const ptrdiff_t x = whole(pixels[n].x), y = whole(pixels[n].y);
    if (x < kRim || y < kRim || x >= image.width - kRim || y >= image.height - kRim) continue;
    // Rows of eight pixels, of which the eighth is not counted: in the last row that is used it may be the first of the next row of the
    // image.
    const uint8_t* corner = image.row(y - kHalf) + x - kHalf;
    Eight<int32_t> column_xx = {}, column_xy = {}, column_yy = {};
    for (ptrdiff_t v = 0; v < 7; ++v) {
      const uint8_t* row = corner + v * image.width;
      const auto along = __builtin_convertvector(wide(row + 1) - wide(row - 1), Eight<int32_t>);
      const auto down = __builtin_convertvector(wide(row + image.width) - wide(row - image.width), Eight<int32_t>);
      column_xx += along * along;
      column_xy += along * down;
      column_yy += down * down;
    }
    int32_t sum_xx = 0, sum_xy = 0, sum_yy = 0;
    for (int u = 0; u < 7; ++u) {
      sum_xx += column_xx[u];
      sum_xy += column_xy[u];
      sum_yy += column_yy[u];
    }
    const double xx = sum_xx, xy = sum_xy, yy = sum_yy;
    const double mean = 0.5 * (xx + yy);
    scores[n] = mean - std::sqrt(std::max(mean * mean - (xx * yy - xy * xy), 0.0));
  }
}

// Sets pixels nearer than radius to one of taken to 0, a ring of up to 1.5 px at the edge left out.
void clear_discs(Picture<uint8_t> free, const Pixel* taken, size_t count, double radius) {
  const double reach = std::min(radius, double(free.width + free.height)) - 0.75;  // from the nearest whole pixel
  const ptrdiff_t size = ptrdiff_t(reach);
  for (size_t n = 0; n < count; ++n) {
    const double nearest_x = std::floor(double(taken[n].x) + 0.5), nearest_y = std::floor(double(taken[n].y) + 0.5);
    if (!(nearest_x >= 0.0 && nearest_y >= 0.0 && nearest_x < double(free.width) && nearest_y < double(free.height))) continue;
    const ptrdiff_t x = ptrdiff_t(nearest_x), y = ptrdiff_t(nearest_y);
    for (ptrdiff_t v = -std::min(size, y); v <= std::min(size, free.height - 1 - y); ++v) {
      const ptrdiff_t half = ptrdiff_t(std::sqrt(reach * reach - double(v * v)));
      const ptrdiff_t first = std::max<ptrdiff_t>(x - half, 0), last = std::min(x + half + 1, free.width);
      std::fill(free.row(y + v) + first, free.row(y + v) + last, uint8_t(0));
    }
  }
}

}  // namespace

// Row by row; none where free, of the image's size, is 0 (no pointer: all is free).
void CornerFinder::fast(GreyImage image, const CornerLimits& limits, const uint8_t* free, std::vector<Pixel>& found) {
  found.clear();
  const int threshold = limits.threshold;
  const ptrdiff_t border = limits.border;
  const ptrdiff_t width = image.width, height = image.height;
  if (std::min(width, height) <= 2 * border) return;
  // Scores of three rows: that which is looked through, the one above and the one below.
  rows_.assign(3 * size_t(width), 0), peaks_.resize(size_t(width));
  auto scores_of = [&](ptrdiff_t y) { return rows_.data() + (y % 3) * width; };
  auto score = [&](ptrdiff_t y) {
    if (y < kCircleRadius || y >= height - kCircleRadius)
      std::fill_n(scores_of(y), width, uint8_t(0));
    else
      score_row(image.row(y) + kCircleRadius, width, width - 2 * kCircleRadius, uint8_t(threshold), scores_of(y) + kCircleRadius);
  };
  score(border - 1);
  score(border);
  for (ptrdiff_t y = border; y < height - border; ++y) {
    score(y + 1);
    keep_peaks(scores_of(y - 1) + border, scores_of(y) + border, scores_of(y + 1) + border, peaks_.data() + border, width - 2 * border);
    for_each_set(peaks_.data(), border, width - border, [&](ptrdiff_t x) {
      if (free != nullptr && free[y * width + x] == 0) return;
      if (limits.clearance.holds(limits.scale * double(x), limits.scale * double(y), limits.scale * limits.clear))
        found.push_back({float(x), float(y)});
    });
  }
}

void CornerFinder::spread(GreyImage image, size_t count, double distance, const Pixel* taken, size_t taken_count) {
  const ptrdiff_t columns = ptrdiff_t(double(image.width) / distance) + 1, rows = ptrdiff_t(double(image.height) / distance) + 1;
  held_.clear(), chosen_.clear();
  newest_.assign(size_t(rows * columns), -1);
  auto hold = [&](double x, double y, ptrdiff_t column, ptrdiff_t row) {
    int64_t& cell = newest_[size_t(row * columns + column)];
    held_.push_back({x, y, cell});
    cell = int64_t(held_.size()) - 1;
  };
  for (size_t n = 0; n < taken_count; ++n) {
    const double column = std::floor(taken[n].x / distance), row = std::floor(taken[n].y / distance);
    if (column >= 0.0 && column < double(columns) && row >= 0.0 && row < double(rows))
      hold(taken[n].x, taken[n].y, ptrdiff_t(column), ptrdiff_t(row));
  }
  for (size_t k = 0; k < order_.size() && chosen_.size() < count; ++k) {
    const double x = candidates_[size_t(order_[k])].x, y = candidates_[size_t(order_[k])].y;
    const ptrdiff_t column = ptrdiff_t(x / distance), row = ptrdiff_t(y / distance);
    bool is_free = true;
    for (ptrdiff_t r = std::max<ptrdiff_t>(row - 1, 0); r < std::min(row + 2, rows); ++r)
      for (ptrdiff_t c = std::max<ptrdiff_t>(column - 1, 0); c < std::min(column + 2, columns); ++c)
        for (int64_t n = newest_[size_t(r * columns + c)]; is_free && n >= 0; n = held_[size_t(n)].earlier) {
          const double dx = held_[size_t(n)].x - x, dy = held_[size_t(n)].y - y;
          is_free = dx * dx + dy * dy >= distance * distance;
        }
    if (!is_free) continue;
    hold(x, y, column, row);
    chosen_.push_back(order_[k]);
  }
}

// Candidates by falling score: the best `most`, and all equal to the last of them. Of equals the first found comes first.
void CornerFinder::put_in_order(size_t most) {
  double least = 0.0;
  if (most < candidates_.size()) {
    ordered_ = eigenvalues_;
    std::nth_element(ordered_.begin(), ordered_.begin() + ptrdiff_t(most) - 1, ordered_.end(), std::greater<double>());
    least = ordered_[most - 1];
  }
  order_.clear();
  for (size_t n = 0; n < candidates_.size(); ++n)
    if (eigenvalues_[n] >= least) order_.push_back(int64_t(n));
  std::sort(order_.begin(), order_.end(), [&](int64_t a, int64_t b) {
    const double score_a = eigenvalues_[size_t(a)], score_b = eigenvalues_[size_t(b)];
    return score_a > score_b || (score_a == score_b && a < b);
  });
}

void CornerFinder::find(GreyImage image, size_t count, const CornerLimits& limits, const Pixel* taken, size_t taken_count) {
  const uint8_t* free = nullptr;
  if (taken_count > 0) {
    free_.assign(size_t(image.height * image.width), 255);
    clear_discs({free_.data(), image.height, image.width}, taken, taken_count, limits.distance);
    free = free_.data();
  }
  const size_t enough = 2 * count;
  fast(image, limits, free, candidates_);
  if (candidates_.size() < enough) {
    CornerLimits other = limits;
    other.border = kCircleRadius;
    fast(image, other, nullptr, whole_);
    other = limits, other.threshold = std::max(limits.threshold / 2, 4);
    if (whole_.size() < enough) fast(image, other, free, candidates_);
  }
  eigenvalues_.resize(candidates_.size());
  min_eigenvalues(image, candidates_.data(), candidates_.size(), eigenvalues_.data());
  size_t shown = 0;
  for (size_t n = 0; n < candidates_.size(); ++n)
    if (eigenvalues_[n] > 0.0) candidates_[shown] = candidates_[n], eigenvalues_[shown++] = eigenvalues_[n];
  candidates_.resize(shown), eigenvalues_.resize(shown);
  corners.clear(), scores.clear();
  if (count == 0) return;
  for (const size_t most : {4 * count, shown}) {
    put_in_order(most);
    spread(image, count, limits.distance, taken, taken_count);
    if (chosen_.size() < count && order_.size() < shown) continue;
    for (const int64_t n : chosen_) corners.push_back(candidates_[size_t(n)]), scores.push_back(eigenvalues_[size_t(n)]);
    return;
  }
}

namespace {

using Pixels = Array<float, -1, 2>;

const Pixel* first(const Pixels& pixels) { return reinterpret_cast<const Pixel*>(pixels.data()); }

auto spread_corners(const Image& image, int count, double distance_px, int threshold, int border_px, const Pixels& taken,
                    const std::optional<Image>& clearance_px, double scale, double clear_px) {
  if (count < 0) throw nb::value_error("count: not negative");
  if (threshold < 0 || threshold > 255) throw nb::value_error("threshold: a difference of grey values, 0 to 255");
  if (border_px < 3) throw nb::value_error("border_px: at least the circle's radius, 3");
  check_corners(distance_px, double(image.shape(1)), double(image.shape(0)));
  if (!(scale >= 1.0)) throw nb::value_error("scale: at least 1");
  const CornerLimits limits{threshold, border_px, distance_px, clearance(clearance_px), scale, clear_px};
  CornerFinder found;
  unlocked([&] { found.find(image, size_t(count), limits, first(taken), taken.shape(0)); });
  return std::tuple(as_numpy<float>(std::move(found.corners)), std::move(found.scores));
}

int32_t product(const uint8_t* pixels, const int16_t* weights, ptrdiff_t count) {
  int32_t total = 0;
  for (ptrdiff_t k = 0; k < count; ++k) total += int16_t(pixels[k]) * weights[k];
  return total;
}

// The direction in degrees, 0 to 360, from each pixel to the intensity centroid of the disc around it; beyond the image's edge
// its outermost pixels go on. Source: Rosin 1999, as ORB uses it.
auto centroid_angles_deg(const Image& grey, const Pixels& pixels, int radius) {
  if (radius < 0 || radius > 255) throw nb::value_error("radius: 0 to 255");
  const size_t count = pixels.shape(0);
  if (count && grey.size() == 0) throw nb::value_error("image: not empty");
  std::vector<float> degrees(count);
  const GreyImage image = grey;
  const Pixel* const places = first(pixels);
  unlocked([&] {
    // Weights of a square's pixels, which are 0 outside of the disc and where rows are filled up to whole registers.
    const ptrdiff_t side = 2 * ptrdiff_t(radius) + 1, stride = (side + 15) / 16 * 16;
    std::vector<int16_t> by_x(size_t(side * stride)), by_y(by_x);
    for (ptrdiff_t v = -radius; v <= radius; ++v) {
      const ptrdiff_t reach = ptrdiff_t(std::sqrt(double(radius * radius - v * v))), middle = (v + radius) * stride + radius;
      for (ptrdiff_t u = -reach; u <= reach; ++u) by_x[size_t(middle + u)] = int16_t(u), by_y[size_t(middle + u)] = int16_t(v);
    }
    std::vector<uint8_t> extended(static_cast<size_t>(stride));
    for (size_t n = 0; n < count; ++n) {
      const ptrdiff_t left = whole(places[n].x + 0.5) - radius, top = whole(places[n].y + 0.5) - radius;
      int64_t moment_x = 0, moment_y = 0;
      for (ptrdiff_t v = 0; v < side; ++v) {
        const uint8_t* row = image.row(std::clamp<ptrdiff_t>(top + v, 0, image.height - 1));
        if (left < 0 || left + stride > image.width) {
          for (ptrdiff_t u = 0; u < side; ++u) extended[size_t(u)] = row[std::clamp<ptrdiff_t>(left + u, 0, image.width - 1)];
          row = extended.data();
        } else {
          row += left;
        }
        moment_x += product(row, by_x.data() + v * stride, stride);
        moment_y += product(row, by_y.data() + v * stride, stride);
      }
      const double angle = std::fmod(std::atan2(double(moment_y), double(moment_x)) * (180.0 / std::numbers::pi), 360.0);
      degrees[n] = float(angle < 0.0 ? angle + 360.0 : angle);
    }
  });
  return degrees;
}

}  // namespace

void bind_corners(nb::module_& module) {
  module.def("spread_corners", &spread_corners, "image"_a, "count"_a, "distance_px"_a, "threshold"_a, "border_px"_a, "taken"_a,
             "clearance_px"_a = nb::none(), "scale"_a = 1.0, "clear_px"_a = 0.0);
  module.def("centroid_angles_deg", &centroid_angles_deg, "image"_a, "pixels"_a, "radius"_a);
}

}  // namespace fleetmap
