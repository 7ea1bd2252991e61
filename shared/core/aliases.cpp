// Places that look alike: search for them in a map, and tests to distinguish them.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <bit>
#include <cmath>
#include <numeric>

namespace fleetmap {
namespace {

constexpr int kMaxBits = 50;
constexpr double kSameHeightM = 0.3;

// A number for the cell that holds a point; the lattice is shifted by a share of the cell.
int64_t cell_of(const double* point, double cell_m, double shift) {
  uint64_t index[3];
  for (int k = 0; k < 3; ++k) {
    const double floor = std::floor(point[k] / cell_m + shift);
    index[k] = uint64_t(std::abs(floor) < 1e15 ? int64_t(floor) : 0);
  }
  return int64_t((index[0] * 2097169 + index[1]) * 8209 + index[2]);
}

// The first slot to probe in a table whose size is a power of two.
size_t slot_of(int64_t cell, size_t slots) { return size_t((uint64_t(cell) * 0x9E3779B97F4A7C15) >> 32) & (slots - 1); }

// A cell of two places: the sums of their log likelihoods and the number of their landmarks.
struct Cell {
  struct Side {
    double present, absent, count;
  };
  int64_t number;
  double middle[3];
  Side sides[2];

  bool is_free() const { return sides[0].count + sides[1].count == 0.0; }
};

// Observations of the landmarks of one place, at points_odom (count, 3): scores (count, 2), log likelihoods of the observation if the
// landmark is present, and if it is absent; flags of skipped ones.
using Evidence = std::tuple<Points, Array<double, -1, 2>, Array<bool, -1>>;

struct CellLattice {
  double cell_m, shift;  // the latter a share of the former
};

void add_to_cells(const Evidence& place, int side, const CellLattice& lattice, std::vector<Cell>& table) {
  const auto [cell_m, shift] = lattice;
  const auto& [points_odom, scores, skipped] = place;
  for (size_t n = 0; n < points_odom.shape(0); ++n) {
    if (skipped(n)) continue;
    const double* point = points_odom.data() + 3 * n;
    const int64_t number = cell_of(point, cell_m, shift);
    size_t slot = slot_of(number, table.size());
    while (!table[slot].is_free() && table[slot].number != number) slot = (slot + 1) & (table.size() - 1);
    Cell& cell = table[slot];
    cell.number = number;
    for (int k = 0; k < 3; ++k) cell.middle[k] = (std::floor(point[k] / cell_m + shift) + 0.5 - shift) * cell_m;
    cell.sides[side].present += scores(n, 0);
    cell.sides[side].absent += scores(n, 1);
    cell.sides[side].count += 1.0;
  }
}

// log(weight exp(a) + other_weight exp(b)).
double log_sum(double weight, double a, double other_weight, double b) {
  const double top = std::max(a, b);
  return top + std::log(weight * std::exp(a - top) + other_weight * std::exp(b - top));
}

// Probabilities of a cell's states. The absence of fewer than `least` landmarks does not count. In a share of the cells the landmarks
// of both places were removed; in another only the right one of the two has them, except for an odd share. Log odds count beyond
// the threshold.
struct CellModel {
  double least, taken_share, different_share, odd_share, threshold;
};

// Of the first place against the second: both places have the same thing in the cell, or it was taken away wherever the robot is; or one
// of them alone has it.
double cell_log_odds(const Cell& cell, const CellModel& model) {
  const auto& [one, other] = cell.sides;
  const auto absence = [&](const Cell::Side& side) {
    return side.count >= model.least ? side.absent : std::min(side.present, side.absent);
  };
  const double absent = absence(one), other_absent = absence(other);
  const double same = log_sum(1.0 - model.taken_share, one.present + other.present, model.taken_share, absent + other_absent);
  const double first = one.present + other_absent, second = absent + other.present;
  const double for_first = log_sum(1.0 - model.odd_share, first, model.odd_share, second);
  const double for_second = log_sum(1.0 - model.odd_share, second, model.odd_share, first);
  return log_sum(1.0 - model.different_share, same, model.different_share, for_first) -
         log_sum(1.0 - model.different_share, same, model.different_share, for_second);
}

// Pairs, up to `room`, of features at heights_m and landmarks at points_map (count, 3) from `first` to before `last` that look the same at
// the same height, by rising landmark.
auto lookalikes(const Packed& packed_features, const Reals& heights, const Packed& packed_landmarks, const Points& points_map,
                int64_t first, int64_t last, int64_t room) {
  const Descriptors features = packed_features, landmarks = packed_landmarks;
  check_rows(features.count, "heights_m: one for each feature", heights);
  check_rows(landmarks.count, "points_map: one for each landmark", points_map);
  if (first < 0 || last < first || last > int64_t(landmarks.count)) throw nb::value_error("first, last: of landmarks");
  if (room < 0) throw nb::value_error("room: not negative");
  const double* const heights_m = heights.data();
  using Lookalike = std::array<int32_t, 2>;  // a feature and a landmark
  std::vector<Lookalike> pairs;
  unlocked([&] {
    std::vector<int32_t> order;  // by rising height
    for (size_t i = 0; i < features.count; ++i)
      if (!std::isnan(heights_m[i])) order.push_back(int32_t(i));
    std::stable_sort(order.begin(), order.end(), [&](int32_t a, int32_t b) { return heights_m[a] < heights_m[b]; });
    for (int64_t j = first; j < last && int64_t(pairs.size()) < room; ++j) {
      const double z = points_map(size_t(j), 2);
      const auto low = std::partition_point(order.begin(), order.end(), [&](int32_t i) { return z - heights_m[i] > kSameHeightM; });
      const size_t before = pairs.size();
      for (auto at = low; at != order.end() && !(heights_m[*at] - z > kSameHeightM); ++at)
        if (hamming(features[size_t(*at)], landmarks[size_t(j)]) <= kMaxBits) pairs.push_back({*at, int32_t(j)});
      std::sort(pairs.begin() + ptrdiff_t(before), pairs.end());
    }
    if (int64_t(pairs.size()) > room) pairs.resize(size_t(room));
  });
  return pairs;
}

// Counts (columns, rows), columns along x, the features that vote for a camera in a square of two cells' side that begins at the cell's
// corner. offsets_m: (x, y) from the camera to each feature's point, in the rotation of the hypothesis. All pairs of a feature are
// consecutive. Source: the generalised Hough transform, Ballard 1981.
auto camera_votes(const Array<int32_t, -1, 2>& pairs, const Places& offsets_m, const Points& points_map, const Array<double, 2>& low_m,
                  double cell_m, int columns, int rows) {
  constexpr int64_t kMostCells = 1 << 26;
  if (columns < 0 || rows < 0 || int64_t(columns) * rows > kMostCells) throw nb::value_error("columns, rows: up to 2^26 cells");
  std::vector<int32_t> counts;
  unlocked([&] {
    counts.resize(size_t(columns) * size_t(rows));
    std::vector<int32_t> last(counts.size(), -1);
    for (const int32_t* pair = pairs.begin(); pair < pairs.end(); pair += 2) {
      const auto [feature, landmark] = std::pair(pair[0], pair[1]);
      if (feature < 0 || landmark < 0 || size_t(feature) >= offsets_m.shape(0) || size_t(landmark) >= points_map.shape(0))
        throw nb::value_error("pairs: rows of offsets_m and of points_map");
      const double *point = &points_map(size_t(landmark), 0), *offset = &offsets_m(size_t(feature), 0);
      const double x = (point[0] - offset[0] - low_m(0)) / cell_m, y = (point[1] - offset[1] - low_m(1)) / cell_m;
      if (!(1.0 <= x && x < double(columns) && 1.0 <= y && y < double(rows))) continue;
      for (ptrdiff_t column = ptrdiff_t(x) - 1; column <= ptrdiff_t(x); ++column)
        for (ptrdiff_t row = ptrdiff_t(y) - 1; row <= ptrdiff_t(y); ++row) {
          const size_t cell = size_t(column * rows + row);
          if (std::exchange(last[cell], feature) != feature) ++counts[cell];
        }
    }
  });
  return as_numpy<int32_t, 2>(std::move(counts), {size_t(columns), size_t(rows)});
}

// Landmarks of one place, at points_odom (count, 3), their descriptors, and flags to set.
using Place = std::tuple<Points, Packed, Flags>;

// Refuses columns of a place that differ in length.
template <typename Place>
void check_place(const Place& place) {
  const size_t count = std::get<0>(place).shape(0);
  std::apply([&](const auto&... columns) { check_rows(count, "one, other: a row for each landmark", columns...); }, place);
}

// Marks landmarks of two places that have a look-alike of the other place within reach_m along each axis.
void mark_shared(const Place& one, const Place& other, double reach_m, int max_bits) {
  check_place(one), check_place(other);
  const nb::gil_scoped_release others_run;
  const CountedStep counted;
  const auto& [points, packed, shared] = one;
  const auto& [other_points, other_packed, other_shared] = other;
  const Descriptors descriptors = packed, other_descriptors = other_packed;
  const size_t slots = std::bit_ceil(2 * std::max<size_t>(other_descriptors.count, 8));
  std::vector<int32_t> heads(slots, -1), following(other_descriptors.count, -1);
  const double cell_m = 2.0 * reach_m;
  for (size_t m = 0; m < other_descriptors.count; ++m)
    following[m] = std::exchange(heads[slot_of(cell_of(&other_points(m, 0), cell_m, 0.0), slots)], int32_t(m));
  for (size_t n = 0; n < descriptors.count; ++n) {
    const double* point = &points(n, 0);
    for (int corner = 0; corner < 8; ++corner) {  // cells are twice the reach wide, so that the corners of its cube lie in all that count
      double at[3];
      for (int k = 0; k < 3; ++k) at[k] = point[k] + (corner >> k & 1 ? reach_m : -reach_m);
      for (int32_t m = heads[slot_of(cell_of(at, cell_m, 0.0), slots)]; m >= 0; m = following[size_t(m)]) {
        const double* beside = &other_points(size_t(m), 0);
        if (std::abs(beside[0] - point[0]) <= reach_m && std::abs(beside[1] - point[1]) <= reach_m &&
            std::abs(beside[2] - point[2]) <= reach_m && hamming(descriptors[n], other_descriptors[size_t(m)]) <= max_bits)
          shared(n) = other_shared(size_t(m)) = true;
      }
    }
  }
}

// Log odds of the first place against the second, of each block of cells: those of the lattice that is strongest for either place.
// At most `room` blocks, 0 for missing ones: as many as ever surround a robot; omitted ones do not increase certainty.
std::vector<double> odds_of_blocks(const Evidence& one, const Evidence& other, const Array<double, -1, 2>& lattices, const CellModel& model,
                                   double block_m, size_t room) {
  std::vector<Cell> table(std::bit_ceil(2 * std::max<size_t>(std::get<0>(one).shape(0) + std::get<0>(other).shape(0), 1)));
  std::vector<int64_t> blocks;
  std::vector<double> totals;  // of the blocks by this lattice
  std::vector<double> most, least;
  for (size_t k = 0; k < lattices.shape(0); ++k) {
    std::fill(table.begin(), table.end(), Cell{});
    const CellLattice lattice{lattices(k, 0), lattices(k, 1)};
    add_to_cells(one, 0, lattice, table);
    add_to_cells(other, 1, lattice, table);
    std::fill(totals.begin(), totals.end(), 0.0);
    for (const Cell& cell : table) {
      if (cell.sides[0].count == 0.0 || cell.sides[1].count == 0.0) continue;
      const double found = cell_log_odds(cell, model);
      if (std::abs(found) <= model.threshold) continue;
      const int64_t block = cell_of(cell.middle, block_m, 0.0);
      const size_t at = size_t(std::find(blocks.begin(), blocks.end(), block) - blocks.begin());
      if (at == room) continue;
      if (at == blocks.size()) blocks.push_back(block), totals.push_back(0.0), most.push_back(0.0), least.push_back(0.0);
      totals[at] += found > 0.0 ? found - model.threshold : found + model.threshold;
    }
    for (size_t b = 0; b < blocks.size(); ++b) most[b] = std::max(most[b], totals[b]), least[b] = std::min(least[b], totals[b]);
  }
  for (size_t b = 0; b < blocks.size(); ++b) most[b] += least[b];
  most.resize(room);
  return most;
}

auto block_log_odds(const Evidence& one, const Evidence& other, const Array<double, -1, 2>& lattices,
                    const std::tuple<double, double, double, double, double>& model, double block_m, int room) {
  if (room < 0 || room > 1 << 20) throw nb::value_error("room: up to 2^20");
  check_place(one), check_place(other);
  return unlocked([&] { return odds_of_blocks(one, other, lattices, std::make_from_tuple<CellModel>(model), block_m, size_t(room)); });
}

}  // namespace

void bind_aliases(nb::module_& module) {
  module.def("lookalikes", &lookalikes, "features"_a, "heights_m"_a, "landmarks"_a, "points_map"_a, "first"_a, "last"_a, "room"_a);
  module.def("camera_votes", &camera_votes, "pairs"_a, "offsets_m"_a, "points_map"_a, "low_m"_a, "cell_m"_a, "columns"_a, "rows"_a);
  module.def("mark_shared", &mark_shared, "one"_a, "other"_a, "reach_m"_a, "max_bits"_a);
  module.def("block_log_odds", &block_log_odds, "one"_a, "other"_a, "lattices"_a, "model"_a, "block_m"_a, "room"_a);
}

}  // namespace fleetmap
