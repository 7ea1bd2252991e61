#include "aliases.h"

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

void add_to_cells(const PlaceEvidence& place, int side, const CellLattice& lattice, std::vector<Cell>& table) {
  const auto [cell_m, shift] = lattice;
  for (size_t n = 0; n < place.count; ++n) {
    if (place.skipped[n]) continue;
    const double* point = place.points_odom + 3 * n;
    const int64_t number = cell_of(point, cell_m, shift);
    size_t slot = slot_of(number, table.size());
    while (!table[slot].is_free() && table[slot].number != number) slot = (slot + 1) & (table.size() - 1);
    Cell& cell = table[slot];
    cell.number = number;
    for (int k = 0; k < 3; ++k) cell.middle[k] = (std::floor(point[k] / cell_m + shift) + 0.5 - shift) * cell_m;
    cell.sides[side].present += place.scores[2 * n];
    cell.sides[side].absent += place.scores[2 * n + 1];
    cell.sides[side].count += 1.0;
  }
}

// log(weight exp(a) + other_weight exp(b)).
double log_sum(double weight, double a, double other_weight, double b) {
  const double top = std::max(a, b);
  return top + std::log(weight * std::exp(a - top) + other_weight * std::exp(b - top));
}

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

}  // namespace

std::vector<Lookalike> lookalikes(Descriptors features, const double* heights_m, Descriptors landmarks, const double* points_map,
                                  size_t first, size_t last, size_t room) {
  std::vector<int32_t> order;  // by rising height
  for (size_t i = 0; i < features.count; ++i)
    if (!std::isnan(heights_m[i])) order.push_back(int32_t(i));
  std::stable_sort(order.begin(), order.end(), [&](int32_t a, int32_t b) { return heights_m[a] < heights_m[b]; });
  std::vector<Lookalike> pairs;
  for (size_t j = first; j < last && pairs.size() < room; ++j) {
    const double z = points_map[3 * j + 2];
    const auto low = std::partition_point(order.begin(), order.end(), [&](int32_t i) { return z - heights_m[i] > kSameHeightM; });
    const size_t before = pairs.size();
    for (auto at = low; at != order.end() && !(heights_m[*at] - z > kSameHeightM); ++at)
      if (hamming(features[size_t(*at)], landmarks[j]) <= kMaxBits) pairs.push_back({*at, int32_t(j)});
    std::sort(pairs.begin() + ptrdiff_t(before), pairs.end(), [](Lookalike a, Lookalike b) { return a.feature < b.feature; });
  }
  if (pairs.size() > room) pairs.resize(room);
  return pairs;
}

std::vector<int32_t> camera_votes(const Lookalike* pairs, size_t count, const double* offsets_m, const double* points_map,
                                  const SquareLattice& lattice) {
  const ptrdiff_t columns = lattice.columns, rows = lattice.rows;
  std::vector<int32_t> counts(size_t(columns * rows)), last(size_t(columns * rows), -1);
  for (size_t k = 0; k < count; ++k) {
    const int32_t feature = pairs[k].feature;
    const double *point = points_map + 3 * size_t(pairs[k].landmark), *offset = offsets_m + 2 * size_t(feature);
    const double x = (point[0] - offset[0] - lattice.low_x) / lattice.cell_m, y = (point[1] - offset[1] - lattice.low_y) / lattice.cell_m;
    if (!(1.0 <= x && x < double(columns) && 1.0 <= y && y < double(rows))) continue;
    for (ptrdiff_t column = ptrdiff_t(x) - 1; column <= ptrdiff_t(x); ++column)
      for (ptrdiff_t row = ptrdiff_t(y) - 1; row <= ptrdiff_t(y); ++row) {
        const size_t cell = size_t(column * rows + row);
        if (last[cell] == feature) continue;
        last[cell] = feature;
        ++counts[cell];
      }
  }
  return counts;
}

void mark_shared(const PlaceLandmarks& one, const PlaceLandmarks& other, double reach_m, int max_bits, uint8_t* one_shared,
                 uint8_t* other_shared) {
  const size_t slots = std::bit_ceil(2 * std::max<size_t>(other.descriptors.count, 8));
  std::vector<int32_t> heads(slots, -1), following(other.descriptors.count, -1);
  const double cell_m = 2.0 * reach_m;
  for (size_t m = 0; m < other.descriptors.count; ++m) {
    int32_t& head = heads[slot_of(cell_of(other.points_odom + 3 * m, cell_m, 0.0), slots)];
    following[m] = head;
    head = int32_t(m);
  }
  for (size_t n = 0; n < one.descriptors.count; ++n) {
    const double* point = one.points_odom + 3 * n;
    for (int corner = 0; corner < 8; ++corner) {  // cells are twice the reach wide, so that the corners of its cube lie in all that count
      double at[3];
      for (int k = 0; k < 3; ++k) at[k] = point[k] + (corner >> k & 1 ? reach_m : -reach_m);
      for (int32_t m = heads[slot_of(cell_of(at, cell_m, 0.0), slots)]; m >= 0; m = following[size_t(m)]) {
        const double* beside = other.points_odom + 3 * size_t(m);
        if (std::abs(beside[0] - point[0]) <= reach_m && std::abs(beside[1] - point[1]) <= reach_m &&
            std::abs(beside[2] - point[2]) <= reach_m && hamming(one.descriptors[n], other.descriptors[size_t(m)]) <= max_bits)
          one_shared[n] = other_shared[m] = 1;
      }
    }
  }
}

std::vector<double> block_log_odds(const PlaceEvidence& one, const PlaceEvidence& other, const CellLattice* lattices, size_t lattice_count,
                                   const CellModel& model, double block_m, size_t room) {
  std::vector<Cell> table(std::bit_ceil(2 * std::max<size_t>(one.count + other.count, 1)));
  std::vector<int64_t> blocks;
  std::vector<double> totals;  // of the blocks by this lattice
  std::vector<double> most, least;
  for (size_t k = 0; k < lattice_count; ++k) {
    std::fill(table.begin(), table.end(), Cell{});
    add_to_cells(one, 0, lattices[k], table);
    add_to_cells(other, 1, lattices[k], table);
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

}  // namespace fleetmap
