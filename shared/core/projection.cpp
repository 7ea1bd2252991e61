#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace fleetmap {
namespace {

constexpr double kCellPx = 24.0;
constexpr double kMostCells = 512;     // per side, however wild the coordinates
constexpr double kFarthestPx = 1e100;  // pixels farther away, or not finite, are in no image

// Pixels sorted into square cells.
class PixelGrid {
 public:
  PixelGrid(const double* pixels, size_t count) {
    constexpr double kInfinity = std::numeric_limits<double>::infinity();
    double high_x = -kInfinity, high_y = -kInfinity;
    low_x_ = low_y_ = kInfinity;
    auto is_known = [&](size_t n) { return std::abs(pixels[2 * n]) < kFarthestPx && std::abs(pixels[2 * n + 1]) < kFarthestPx; };
    for (size_t n = 0; n < count; ++n) {
      if (!is_known(n)) continue;
      low_x_ = std::min(low_x_, pixels[2 * n]), high_x = std::max(high_x, pixels[2 * n]);
      low_y_ = std::min(low_y_, pixels[2 * n + 1]), high_y = std::max(high_y, pixels[2 * n + 1]);
    }
    if (low_x_ > high_x) return;
    size_ = std::max(kCellPx, std::max(high_x - low_x_, high_y - low_y_) / kMostCells);
    columns_ = ptrdiff_t((high_x - low_x_) / size_) + 1, rows_ = ptrdiff_t((high_y - low_y_) / size_) + 1;
    std::vector<size_t> cell(count);
    starts_.assign(size_t(columns_ * rows_) + 1, 0);
    for (size_t n = 0; n < count; ++n) {
      if (!is_known(n)) continue;
      cell[n] = size_t(ptrdiff_t((pixels[2 * n + 1] - low_y_) / size_) * columns_ + ptrdiff_t((pixels[2 * n] - low_x_) / size_));
      ++starts_[cell[n] + 1];
    }
    std::partial_sum(starts_.begin(), starts_.end(), starts_.begin());
    members_.resize(starts_.back());
    std::vector<size_t> filled(starts_);
    for (size_t n = 0; n < count; ++n)
      if (is_known(n)) members_[filled[cell[n]]++] = int64_t(n);
  }

  // Calls visit(n) for each pixel in the cells that a square around (x, y) touches.
  template <typename Visit>
  void visit_near(double x, double y, double reach, const Visit& visit) const {
    const auto [first_column, last_column] = cells(x - reach, x + reach, low_x_, columns_);
    const auto [first_row, last_row] = cells(y - reach, y + reach, low_y_, rows_);
    if (first_column > last_column) return;
    for (ptrdiff_t row = first_row; row <= last_row; ++row)
      for (size_t slot = starts_[size_t(row * columns_ + first_column)]; slot < starts_[size_t(row * columns_ + last_column + 1)]; ++slot)
        visit(members_[slot]);
  }

 private:
  std::pair<ptrdiff_t, ptrdiff_t> cells(double from, double to, double origin, ptrdiff_t count) const {
    auto cell = [&](double at) { return ptrdiff_t(std::min(std::max(-1.0, std::floor((at - origin) / size_)), double(count))); };
    return {std::max<ptrdiff_t>(cell(from), 0), std::min(cell(to), count - 1)};
  }

  double low_x_, low_y_, size_ = 1.0;
  ptrdiff_t columns_ = 0, rows_ = 0;
  std::vector<size_t> starts_;
  std::vector<int64_t> members_;
};

// Per octave, the smallest distance of a feature that was not the best.
class Rivals {
 public:
  Rivals() { std::fill(std::begin(distance_), std::end(distance_), kFar); }
  void add(int8_t octave, int distance) {
    const int k = octave + 128;
    distance_[k] = std::min(distance_[k], distance);
    first_ = std::min(first_, k), last_ = std::max(last_, k);
  }
  int of(int8_t octave) const { return distance_[octave + 128]; }
  void forget() {
    for (int k = first_; k <= last_; ++k) distance_[k] = kFar;
    first_ = 256, last_ = -1;
  }

 private:
  int distance_[256], first_ = 256, last_ = -1;
};

}  // namespace

void match_projected(const Projections& a, const SeenFeatures& b, int max_distance, double ratio, int64_t* index, int32_t* distances) {
  const PixelGrid grid(b.pixels, b.descriptors.count);
  std::vector<int64_t> owner(b.descriptors.count, -1);
  Rivals rivals;
  std::fill_n(index, a.descriptors.count, -1);
  std::fill_n(distances, a.descriptors.count, kFar);
  for (size_t i = 0; i < a.descriptors.count; ++i) {
    const double x = a.pixels[2 * i], y = a.pixels[2 * i + 1], reach = a.radius_px[i];
    if (!(std::isfinite(x) && std::isfinite(y) && reach >= 0.0)) continue;
    const int64_t lowest = a.octave_range[2 * i], highest = a.octave_range[2 * i + 1];
    int best = kFar;
    int64_t found = -1;
    rivals.forget();
    grid.visit_near(x, y, reach, [&](int64_t j) {
      const int8_t octave = b.octaves[j];
      const double dx = b.pixels[2 * j] - x, dy = b.pixels[2 * j + 1] - y;
      if (dx * dx + dy * dy > reach * reach || octave < lowest || octave > highest) return;
      const int distance = hamming(a.descriptors[i], b.descriptors[size_t(j)]);
      if (distance < best || (distance == best && j < found)) {
        if (found >= 0) rivals.add(b.octaves[found], best);
        best = distance, found = j;
      } else {
        rivals.add(octave, distance);
      }
    });
    if (found < 0 || best > max_distance || !(best < ratio * rivals.of(b.octaves[found]))) continue;
    const int64_t holder = owner[size_t(found)];
    if (holder >= 0 && distances[holder] <= best) continue;
    if (holder >= 0) index[holder] = -1, distances[holder] = kFar;
    owner[size_t(found)] = int64_t(i), index[i] = found, distances[i] = best;
  }
}

static auto match_projected_of(const Places& predicted, const Reals& radius_px, const Packed& a, const Array<int64_t, -1, 2>& octave_range,
                               const Places& pixels, const Array<int8_t, -1>& octaves, const Packed& b, int max_distance, double ratio) {
  const size_t count = a.shape(0);
  check_rows(count, "predicted, radius_px, octave_range: one for each descriptor of a", predicted, radius_px, octave_range);
  check_rows(b.shape(0), "pixels, octaves: one for each descriptor of b", pixels, octaves);
  auto index = zeros<int64_t>(count);
  auto distances = zeros<int32_t>(count);
  unlocked([&] {
    match_projected({predicted.data(), radius_px.data(), octave_range.data(), a}, {pixels.data(), octaves.data(), b}, max_distance, ratio,
                    index.data(), distances.data());
  });
  return std::tuple(std::move(index), std::move(distances));
}

void bind_projection(nb::module_& module) {
  module.def("match_projected", &match_projected_of, "predicted"_a, "radius_px"_a, "a"_a, "octave_range"_a, "pixels"_a, "octaves"_a, "b"_a,
             "max_distance"_a, "ratio"_a);
}

}  // namespace fleetmap
