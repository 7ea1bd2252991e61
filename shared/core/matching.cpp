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

// Compares one row with columns first..last. Each loop is one over wide registers.
[[gnu::always_inline]] inline void compare_row(const uint64_t* row, int64_t row_index, const Columns& columns, size_t first, size_t last,
                                               std::vector<int32_t>& scratch, Claims& claims, Nearest& nearest) {
  const size_t count = last - first;
  const uint64_t a0 = row[0], a1 = row[1], a2 = row[2], a3 = row[3];
  const uint64_t* w0 = columns.words.data() + first;
  const uint64_t *w1 = w0 + columns.count, *w2 = w1 + columns.count, *w3 = w2 + columns.count;
  int32_t* __restrict distance = scratch.data();
  for (size_t j = 0; j < count; ++j)
    distance[j] = int32_t(std::popcount(a0 ^ w0[j]) + std::popcount(a1 ^ w1[j]) + std::popcount(a2 ^ w2[j]) + std::popcount(a3 ^ w3[j]));
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

// Rows' choices that their columns return.
Pairs returned(const std::vector<int64_t>& choice, const Claims& claims) {
  Pairs pairs;
  for (size_t i = 0; i < choice.size(); ++i)
    if (choice[i] >= 0 && claims.row[size_t(choice[i])] == int64_t(i)) pairs.emplace_back(int64_t(i), choice[i]);
  return pairs;
}

// For every descriptor of a, the nearest of b (-1 none), its distance and the second smallest one (kFar none).
// Ties go to the lower index.
auto nearest_two(const Packed& packed_a, const Packed& packed_b) {
  const Descriptors a = packed_a, b = packed_b;
  auto index = zeros<int64_t>(a.count);
  auto first = zeros<int32_t>(a.count), second = zeros<int32_t>(a.count);
  unlocked([&] {
    for (size_t i = 0; i < a.count; ++i) {
      const TwoNearest found(a[i], b);
      index[i] = found.first, first[i] = found.distance, second[i] = found.second_distance;
    }
  });
  return std::tuple(as_numpy<int64_t>(std::move(index)), as_numpy<int32_t>(std::move(first)), as_numpy<int32_t>(std::move(second)));
}

// Pairs that are each other's nearest, by rising index in a: at most max_distance apart, and below ratio times the distance of
// a's second nearest. Ties go to the lower index. Source: Lowe 2004.
Pairs mutual_pairs(Descriptors a, Descriptors b, int max_distance, double ratio) {
  const Columns columns(b);
  Claims claims(b.count);
  std::vector<int32_t> scratch(b.count);
  std::vector<int64_t> choice(a.count, -1);
  run_popcount([&]() __attribute__((always_inline)) {
    for (size_t i = 0; i < a.count; ++i) {
      Nearest nearest;
      compare_row(a[i], int64_t(i), columns, 0, b.count, scratch, claims, nearest);
      if (nearest.passes(max_distance, ratio)) choice[i] = nearest.found;
    }
  });
  return returned(choice, claims);
}

auto mutual(const Packed& a, const Packed& b, int max_distance, double ratio) {
  return as_numpy<int64_t>(unlocked([&] { return mutual_pairs(a, b, max_distance, ratio); }));
}

// As mutual, of each of a with those of b whose node is one of its two: nodes_a holds two numbers for each of a, nodes_b one
// for each of b, none negative. Source: direct index, Galvez-Lopez and Tardos 2012, section III-B.
Pairs mutual_pairs_within(Descriptors a, const int32_t* nodes_a, Descriptors b, const int32_t* nodes_b, int max_distance, double ratio) {
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
  Pairs pairs = returned(choice, claims);
  for (auto& [i, j] : pairs) j = order[size_t(j)];
  return pairs;
}

auto mutual_within(const Packed& a, const Array<int32_t, -1, 2>& nodes_a, const Packed& b, const Numbers& nodes_b, int max_distance,
                   double ratio) {
  constexpr size_t kMostNodes = 1 << 20;
  if (nodes_a.shape(0) != a.shape(0) || nodes_b.shape(0) != b.shape(0)) throw nb::value_error("a node for each descriptor is needed");
  check_below(kMostNodes, "nodes are numbers from 0 to 2^20", nodes_a, nodes_b);
  return as_numpy<int64_t>(unlocked([&] { return mutual_pairs_within(a, nodes_a.data(), b, nodes_b.data(), max_distance, ratio); }));
}

}  // namespace

void bind_matching(nb::module_& module) {
  module.def("nearest_two", &nearest_two, "a"_a, "b"_a);
  module.def("mutual", &mutual, "a"_a, "b"_a, "max_distance"_a, "ratio"_a);
  module.def("mutual_within", &mutual_within, "a"_a, "nodes_a"_a, "b"_a, "nodes_b"_a, "max_distance"_a, "ratio"_a);
}

}  // namespace fleetmap
