#include "matching.h"

#include <algorithm>
#include <numeric>

#include "dispatch.h"

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

}  // namespace

void nearest_two(Descriptors a, Descriptors b, int64_t* index, int32_t* first, int32_t* second) {
  for (size_t i = 0; i < a.count; ++i) {
    int best = kFar, runner_up = kFar;
    int64_t found = -1;
    for (size_t j = 0; j < b.count; ++j) {
      const int distance = hamming(a[i], b[j]);
      if (distance < best) {
        runner_up = best;
        best = distance;
        found = int64_t(j);
      } else if (distance < runner_up) {
        runner_up = distance;
      }
    }
    index[i] = found;
    first[i] = best;
    second[i] = runner_up;
  }
}

Pairs mutual(Descriptors a, Descriptors b, int max_distance, double ratio) {
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

Pairs mutual_within(Descriptors a, const int32_t* nodes_a, Descriptors b, const int32_t* nodes_b, int max_distance, double ratio) {
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

}  // namespace fleetmap
