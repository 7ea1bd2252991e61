// Nearest neighbours of descriptors by their Hamming distances.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <numeric>

namespace fleetmap {
namespace {

// Descriptors by column: word w of all of them is one row, so that wide registers compare several at once.
struct Columns {
  std::vector<uint64_t> words;
  size_t count;

  explicit Columns(Descriptors from) : words(4 * from.count), count(from.count) {
    for (size_t j = 0; j < count; ++j)
      for (size_t w = 0; w < 4; ++w) words[w * count + j] = from[j][w];
  }
};

// For each column, the nearest row so far; ties go to the first.
struct Claims {
  std::vector<int32_t> distance;
  std::vector<int64_t> row;

  explicit Claims(size_t columns) : distance(columns, kFar), row(columns, -1) {}
};

// What of a row's columns is nearest, and the second smallest distance; ties go to the lower column.
struct Nearest {
  int32_t best = kFar, second = kFar;
  int64_t found = -1;

  bool passes(int max_distance, double ratio) const { return best <= max_distance && double(best) < ratio * double(second); }
};

// Fills the distances of a descriptor from columns first..last, over wide registers.
[[gnu::always_inline]] inline void measure(const uint64_t* from, const Columns& columns, size_t first, size_t last,
                                           std::vector<int32_t>& distances) {
  const uint64_t a0 = from[0], a1 = from[1], a2 = from[2], a3 = from[3];
  const uint64_t* w0 = columns.words.data() + first;
  const uint64_t *w1 = w0 + columns.count, *w2 = w1 + columns.count, *w3 = w2 + columns.count;
  int32_t* __restrict distance = distances.data();
  for (size_t j = 0; j < last - first; ++j)
    distance[j] = int32_t(std::popcount(a0 ^ w0[j]) + std::popcount(a1 ^ w1[j]) + std::popcount(a2 ^ w2[j]) + std::popcount(a3 ^ w3[j]));
}

// Compares one row with columns first..last. Each loop is one over wide registers.
[[gnu::always_inline]] inline void compare_row(const uint64_t* row, int64_t row_index, const Columns& columns, size_t first, size_t last,
                                               std::vector<int32_t>& scratch, Claims& claims, Nearest& nearest) {
  const size_t count = last - first;
  measure(row, columns, first, last, scratch);
  int32_t* __restrict distance = scratch.data();
  int32_t* __restrict claimed = claims.distance.data() + first;
  int64_t* __restrict claimant = claims.row.data() + first;
  for (size_t j = 0; j < count; ++j) {
    const bool is_nearer = distance[j] < claimed[j];
    claimed[j] = is_nearer ? distance[j] : claimed[j];
    claimant[j] = is_nearer ? row_index : claimant[j];
  }
  int32_t best = kFar;
  for (size_t j = 0; j < count; ++j) best = distance[j] < best ? distance[j] : best;
  if (best >= nearest.second) return;
  const size_t at = size_t(std::find(distance, distance + count, best) - distance);
  int32_t second = kFar;
  distance[at] = kFar;
  for (size_t j = 0; j < count; ++j) second = distance[j] < second ? distance[j] : second;
  if (best < nearest.best)
    nearest = {best, std::min(nearest.best, second), int64_t(first + at)};
  else
    nearest.second = std::min(nearest.second, best);
}

// Pairs that are each other's nearest, by rising index in a: at most max_distance apart, and below ratio times the distance of
// a's second nearest, of each of a with those of b whose node is one of its two: nodes_a holds two numbers for each of a, nodes_b one
// for each of b, none negative. Ties go to the lower index. Sources: Lowe 2004; direct index, Galvez-Lopez and Tardos 2012, section III-B.
Pairs mutual_pairs(Descriptors a, const int32_t* nodes_a, Descriptors b, const int32_t* nodes_b, int max_distance, double ratio) {
  if (a.count == 0 || b.count == 0) return {};
  // b sorted by node: those of node n are the columns starts[n]..starts[n + 1].
  std::vector<int64_t> order(b.count);
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(), [&](int64_t i, int64_t j) { return nodes_b[i] < nodes_b[j]; });
  const int32_t last_node = std::max(*std::max_element(nodes_a, nodes_a + 2 * a.count), nodes_b[order.back()]);
  std::vector<size_t> starts(size_t(last_node) + 2, 0);
  for (size_t j = 0; j < b.count; ++j) ++starts[size_t(nodes_b[j]) + 1];
  std::partial_sum(starts.begin(), starts.end(), starts.begin());
  std::vector<uint64_t> sorted(4 * b.count);
  for (size_t j = 0; j < b.count; ++j) std::copy_n(b[size_t(order[j])], 4, sorted.data() + 4 * j);

  const Columns columns(Descriptors{sorted.data(), b.count});
  Claims claims(b.count);
  std::vector<int32_t> scratch(b.count);
  std::vector<int64_t> choice(a.count, -1);
  run_popcount([&]() __attribute__((always_inline)) {
    for (size_t i = 0; i < a.count; ++i) {
      const int32_t* nodes = nodes_a + 2 * i;
      Nearest nearest;
      for (int side = 0; side < (nodes[1] != nodes[0] ? 2 : 1); ++side) {
        const size_t first = starts[size_t(nodes[side])], last = starts[size_t(nodes[side]) + 1];
        compare_row(a[i], int64_t(i), columns, first, last, scratch, claims, nearest);
      }
      if (nearest.passes(max_distance, ratio)) choice[i] = nearest.found;
    }
  });
  Pairs pairs;  // rows' choices that their columns return
  for (size_t i = 0; i < a.count; ++i)
    if (choice[i] >= 0 && claims.row[size_t(choice[i])] == int64_t(i)) pairs.push_back({int64_t(i), order[size_t(choice[i])]});
  return pairs;
}

Pairs mutual(const Packed& a, const Packed& b, int max_distance, double ratio) {
  return unlocked([&] {
    const std::vector<int32_t> nodes(std::max(2 * a.shape(0), b.shape(0)));  // one for all
    return mutual_pairs(a, nodes.data(), b, nodes.data(), max_distance, ratio);
  });
}

Pairs mutual_within(const Packed& a, const Array<int32_t, -1, 2>& nodes_a, const Packed& b, const Numbers& nodes_b, int max_distance,
                    double ratio) {
  constexpr size_t kMostNodes = 1 << 20;
  if (nodes_a.shape(0) != a.shape(0) || nodes_b.shape(0) != b.shape(0)) throw nb::value_error("a node for each descriptor is needed");
  check_below(kMostNodes, "nodes are numbers from 0 to 2^20", nodes_a, nodes_b);
  return unlocked([&] { return mutual_pairs(a, nodes_a.data(), b, nodes_b.data(), max_distance, ratio); });
}

// For each descriptor, `cells` numbers of the centres nearest to it, the nearest first, -1 where there are fewer. Ties go to the lower
// number.
std::vector<int32_t> cells_of(Descriptors descriptors, Descriptors centres, size_t cells) {
  const Columns columns(centres);
  std::vector<int32_t> distances(centres.count), nearest(cells), numbers(descriptors.count * cells, -1);
  run_popcount([&]() __attribute__((always_inline)) {
    for (size_t i = 0; i < descriptors.count; ++i) {
      measure(descriptors[i], columns, 0, centres.count, distances);
      int32_t* const found = numbers.data() + i * cells;
      size_t held = 0;
      for (size_t c = 0; c < centres.count; ++c) {
        if (held == cells && distances[c] >= nearest[cells - 1]) continue;
        size_t at = held < cells ? held++ : cells - 1;
        for (; at > 0 && nearest[at - 1] > distances[c]; --at) nearest[at] = nearest[at - 1], found[at] = found[at - 1];
        nearest[at] = distances[c], found[at] = int32_t(c);
      }
    }
  });
  return numbers;
}

size_t checked_cells(int cells) {
  if (cells < 1 || cells > 1024) throw nb::value_error("cells: 1 to 1024");
  return size_t(cells);
}

auto nearest_cells(const Packed& descriptors, const Packed& centres, int cells) {
  const size_t wanted = checked_cells(cells);
  return as_numpy<int32_t, 2>(unlocked([&] { return cells_of(descriptors, centres, wanted); }), {descriptors.shape(0), wanted});
}

// Which of the held descriptors are within max_bits of any query, and lie in one of the `cells` cells nearest to the query. Those of cell
// c are held[starts[c]] to held[starts[c + 1]].
// Sources: Sivic and Zisserman 2003 on inverted files; Jegou, Douze and Schmid 2008 on querying several cells and comparing bits.
auto near_descriptors(const Packed& queries, const Packed& centres, int cells, const Packed& held_ones, const Indices& starts,
                      int max_bits) {
  const size_t asked = checked_cells(cells);
  const Descriptors descriptors = queries, held = held_ones;
  check_rows(centres.shape(0) + 1, "starts: one more than centres", starts);
  for (size_t c = 0; c < starts.shape(0); ++c)
    if (starts(c) < (c ? starts(c - 1) : 0) || starts(c) > int64_t(held.count)) throw nb::value_error("starts: rising, of held");
  auto is_near = zeros<uint8_t>(held.count);
  unlocked([&] {
    const std::vector<int32_t> numbers = cells_of(descriptors, centres, asked);
    for (size_t i = 0; i < descriptors.count; ++i)
      for (size_t p = 0; p < asked && numbers[i * asked + p] >= 0; ++p) {
        const size_t cell = size_t(numbers[i * asked + p]);
        for (int64_t j = starts(cell); j < starts(cell + 1); ++j)
          if (!is_near[size_t(j)] && hamming(descriptors[i], held[size_t(j)]) <= max_bits) is_near[size_t(j)] = true;
      }
  });
  return as_numpy<bool>(std::move(is_near));
}

}  // namespace

void bind_matching(nb::module_& module) {
  module.def("mutual", &mutual, "a"_a, "b"_a, "max_distance"_a, "ratio"_a);
  module.def("mutual_within", &mutual_within, "a"_a, "nodes_a"_a, "b"_a, "nodes_b"_a, "max_distance"_a, "ratio"_a);
  module.def("nearest_cells", &nearest_cells, "descriptors"_a, "centres"_a, "cells"_a);
  module.def("near_descriptors", &near_descriptors, "descriptors"_a, "centres"_a, "cells"_a, "held"_a, "starts"_a, "max_bits"_a);
}

}  // namespace fleetmap
