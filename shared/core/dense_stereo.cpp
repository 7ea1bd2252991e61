// Disparities of a whole rectified pair, at every second pixel of every second row. Sources: Hirschmueller 2008, semi-global matching, here
// with paths from the left, from the right and from above; Konolige 1997, slopes in place of grey levels, and texture.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <numeric>

namespace fleetmap {
namespace {

constexpr ptrdiff_t kStepPx = 2;                       // from one sample to the next
constexpr ptrdiff_t kBlockPx = 7;                      // of the three by three samples, with their slopes, that are compared
constexpr ptrdiff_t kLanes = 16, kMostRange = 1024;    // disparities in a register, and in all
constexpr int kFractions = 16, kMostSlope = 31;        // of a pixel; in eighths of a grey level, as slopes are
constexpr int kStepCost = 160, kJumpCost = 800;        // of a disparity's change by one, and by more
constexpr ptrdiff_t kTexture = 5;                      // samples each way,
constexpr int kMinTexture = 12 * kTexture * kTexture;  // and the least sum of their slopes
constexpr uint8_t kOutside = 255;
constexpr uint16_t kNever = 65535, kFar = 16383;

// As many costs as a wide register holds.
using Lanes [[gnu::vector_size(2 * kLanes)]] = uint16_t;
using Bytes [[gnu::vector_size(kLanes)]] = uint8_t;

template <typename Register = Lanes, typename Number>
inline Register loaded(const Number* from) {
  Register out;
  std::memcpy(&out, from, sizeof out);
  return out;
}
inline void store(Lanes from, uint16_t* to) { std::memcpy(to, &from, sizeof from); }
inline Lanes lesser(Lanes a, Lanes b) { return a < b ? a : b; }
// The least, in all places.
inline Lanes spread_least(Lanes of) {
  uint16_t least = of[0];
  for (ptrdiff_t k = 1; k < kLanes; ++k) least = std::min<uint16_t>(least, of[k]);
  return Lanes{} + least;
}

// Costs by disparity of the paths that end at each pixel of a row, with kLanes of kFar before and after each; the least of each.
struct Paths {
  std::vector<uint16_t> costs;
  std::vector<Lanes> least;
  ptrdiff_t stride;
  Paths(ptrdiff_t columns, ptrdiff_t range)
      : costs(size_t(kLanes + columns * (range + kLanes)), kFar), least(size_t(columns), Lanes{}), stride(range + kLanes) {
    for (ptrdiff_t i = 0; i < columns; ++i) std::fill_n(at(i), range, uint16_t(0));
  }
  uint16_t* at(ptrdiff_t i) { return costs.data() + kLanes + i * stride; }
};

// A path goes on to a pixel of these costs, and is added to the totals.
inline void extend(Paths& before, ptrdiff_t from, const uint16_t* cost, Paths& after, ptrdiff_t to, uint16_t* total) {
  const uint16_t* const old = before.at(from);
  uint16_t* const path = after.at(to);
  const Lanes less = before.least[size_t(from)], jump = less + uint16_t(kJumpCost);
  Lanes least = ~Lanes{};
  for (ptrdiff_t d = 0; d < before.stride - kLanes; d += kLanes) {
    const Lanes beside = lesser(loaded(old + d - 1), loaded(old + d + 1)) + uint16_t(kStepCost);
    const Lanes now = loaded(cost + d) + lesser(lesser(loaded(old + d), beside), jump) - less;
    store(now, path + d), store(loaded(total + d) + now, total + d);
    least = lesser(least, now);
  }
  after.least[size_t(to)] = spread_least(least);
}

// The horizontal slopes of every second row.
std::vector<int16_t> slopes_of(GreyImage picture) {
  std::vector<int16_t> slopes(size_t((picture.height + kStepPx - 1) / kStepPx * picture.width), 0);
  int16_t* out = slopes.data();
  for (ptrdiff_t y = 0; y < picture.height; y += kStepPx, out += picture.width) {
    const uint8_t *const above = picture.row(std::max<ptrdiff_t>(y - 1, 0)), *const here = picture.row(y),
                         *const below = picture.row(std::min(y + 1, picture.height - 1));
    for (ptrdiff_t x = 1; x < picture.width - 1; ++x)
      out[x] = int16_t(above[x + 1] - above[x - 1] + 2 * (here[x + 1] - here[x - 1]) + below[x + 1] - below[x - 1]);
  }
  return slopes;
}

inline uint8_t limited(int16_t slope) { return uint8_t(std::clamp<int16_t>(slope, -kMostSlope, kMostSlope) + kMostSlope); }

// kFractions of a pixel for each sample, 0 unknown. range: disparities below are compared, the last only beside its neighbour; of kLanes.
std::vector<int16_t> match(GreyImage left, GreyImage right, ptrdiff_t range) {
  const ptrdiff_t width = left.width, rows = (left.height + kStepPx - 1) / kStepPx, columns = (width + kStepPx - 1) / kStepPx;
  std::vector<int16_t> found(size_t(rows * columns), 0);
  const std::vector<int16_t> of_left = slopes_of(left), of_right = slopes_of(right);
  const ptrdiff_t mirror = width + range;  // rows of the right picture from right to left: disparities then rise, also beyond its edge
  std::vector<uint8_t> mirrored(size_t(3 * mirror), kOutside);
  std::vector<uint16_t> least(static_cast<size_t>(width)), least_at(static_cast<size_t>(width));  // of the right picture's pixels
  std::vector<int> textures(static_cast<size_t>(columns + kTexture));
  std::vector<uint16_t> costs(size_t(columns * range)), totals(size_t(columns * range));
  uint16_t sums[3][kMostRange];
  Paths above(columns, range), below(columns, range);
  const Lanes numbers = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  for (ptrdiff_t row = 0; row < rows; ++row) {
    const int16_t* here[3];
    const uint8_t* there[3];
    for (ptrdiff_t y = row > 0 ? row + 1 : 0; y < std::min(row + 2, rows); ++y)
      for (ptrdiff_t x = 0; x < width; ++x) mirrored[size_t(y % 3 * mirror + width - 1 - x)] = limited(of_right[size_t(y * width + x)]);
    for (ptrdiff_t k = 0; k < 3; ++k) {
      const ptrdiff_t y = std::clamp<ptrdiff_t>(row + k - 1, 0, rows - 1);
      here[k] = of_left.data() + y * width, there[k] = mirrored.data() + y % 3 * mirror + width - 1;
    }
    const auto sum_column = [&](ptrdiff_t i) {
      uint16_t* const sum = sums[(i + 3) % 3];
      if (i < 0 || i >= columns) return void(std::fill_n(sum, range, uint16_t(0)));
      Bytes mine[3];
      for (ptrdiff_t k = 0; k < 3; ++k) mine[k] = Bytes{} + limited(here[k][i * kStepPx]);
      for (ptrdiff_t d = 0; d < range; d += kLanes) {
        Lanes all = {};
        for (ptrdiff_t k = 0; k < 3; ++k) {
          const Bytes other = loaded<Bytes>(there[k] - i * kStepPx + d);
          all += __builtin_convertvector(mine[k] > other ? mine[k] - other : other - mine[k], Lanes);
        }
        store(all, sum + d);
      }
    };
    std::fill(totals.begin(), totals.end(), uint16_t(0));
    Paths aside(2, range);
    sum_column(-1), sum_column(0);
    for (ptrdiff_t i = 0; i < columns; ++i) {
      sum_column(i + 1);
      uint16_t *const cost = costs.data() + i * range, *const total = totals.data() + i * range;
      for (ptrdiff_t d = 0; d < range; d += kLanes) store(loaded(sums[0] + d) + loaded(sums[1] + d) + loaded(sums[2] + d), cost + d);
      extend(aside, i & 1, cost, aside, ~i & 1, total);
      extend(above, i, cost, below, i, total);
    }
    std::swap(above, below);
    std::fill(textures.begin(), textures.end(), 0);
    for (ptrdiff_t y = std::max<ptrdiff_t>(row - kTexture / 2, 0); y <= std::min(row + kTexture / 2, rows - 1); ++y)
      for (ptrdiff_t i = 0; i < columns; ++i) textures[size_t(i + kTexture / 2)] += std::abs(of_left[size_t(y * width + i * kStepPx)]);
    int16_t* const out = found.data() + row * columns;
    std::fill(least.begin(), least.end(), kNever);
    aside = Paths(2, range);
    for (ptrdiff_t i = columns - 1; i >= 0; --i) {
      uint16_t* const total = totals.data() + i * range;
      extend(aside, i & 1, costs.data() + i * range, aside, ~i & 1, total);
      const bool sees_all = i * kStepPx >= range;  // at the left edge the right picture does not show what is near
      if (!sees_all || std::accumulate(textures.begin() + i, textures.begin() + i + kTexture, 0) < kMinTexture) continue;
      Lanes best = ~Lanes{}, nearest = best;
      for (ptrdiff_t d = 0; d < range; d += kLanes) best = lesser(best, loaded(total + d));
      best = spread_least(best);
      for (ptrdiff_t d = 0; d < range; d += kLanes) nearest = lesser(nearest, loaded(total + d) == best ? numbers + uint16_t(d) : ~Lanes{});
      nearest = spread_least(nearest);
      const ptrdiff_t at = nearest[0], other = i * kStepPx - at;
      const int cheapest = best[0];
      if (at == 0 || at + 1 >= range || other < 0) continue;
      if (cheapest < least[size_t(other)]) least[size_t(other)] = best[0], least_at[size_t(other)] = nearest[0];
      const int low = total[at - 1], high = total[at + 1], height = low + high - 2 * cheapest;  // a parabola through the three
      out[i] = int16_t(at * kFractions + (height > 0 ? (kFractions * (low - high) + height) / (2 * height) : 0));
    }
    // What the right picture's pixel matches better elsewhere is hidden from one camera.
    for (ptrdiff_t i = 0; i < columns; ++i) {
      const ptrdiff_t at = (out[i] + kFractions / 2) / kFractions, other = i * kStepPx - at;
      if (other >= 0 && least[size_t(other)] != kNever && std::abs(least_at[size_t(other)] - at) > 1) out[i] = 0;
    }
  }
  return found;
}

auto match_densely(const Image& left, const Image& right, double farthest_px) {
  if (!same_size(left, right)) throw nb::value_error("right: of the size of left");
  if (!(farthest_px >= 0.0 && farthest_px <= kMostRange - kLanes)) throw nb::value_error("farthest_px: from 0 to 1008");
  const size_t rows = (left.shape(0) + kStepPx - 1) / kStepPx, columns = (left.shape(1) + kStepPx - 1) / kStepPx;
  std::vector<int16_t> found;
  if (rows > 0 && columns > 0) unlocked([&] { found = match(left, right, (ptrdiff_t(farthest_px + 1.0) / kLanes + 1) * kLanes); });
  return as_numpy<int16_t, 2>(std::move(found), {rows, columns});
}

}  // namespace

void bind_dense_stereo(nb::module_& module) {
  module.attr("DENSE_STEP_PX") = kStepPx;
  module.attr("DENSE_BLOCK_PX") = kBlockPx;
  module.attr("DENSE_FRACTIONS") = kFractions;
  module.attr("DENSE_MOST_PX") = kMostRange - kLanes;
  module.def("match_densely", &match_densely, "left"_a, "right"_a, "farthest_px"_a);
}

}  // namespace fleetmap
