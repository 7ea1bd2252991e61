// Hamming distances of 256-bit descriptors, and nearest neighbours by them.
#pragma once

#include <bit>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace fleetmap {

constexpr int kFar = 257;  // more than any two descriptors can differ by

// N descriptors of four words each, one after the other.
struct Descriptors {
  const uint64_t* words;
  size_t count;
  const uint64_t* operator[](size_t i) const { return words + 4 * i; }
};

inline int hamming(const uint64_t* a, const uint64_t* b) {
  return std::popcount(a[0] ^ b[0]) + std::popcount(a[1] ^ b[1]) + std::popcount(a[2] ^ b[2]) + std::popcount(a[3] ^ b[3]);
}

using Pairs = std::vector<std::pair<int64_t, int64_t>>;

// Fills, for every descriptor of a, the nearest of b (-1 none), its distance and the second smallest one (kFar none).
// Ties go to the lower index.
void nearest_two(Descriptors a, Descriptors b, int64_t* index, int32_t* first, int32_t* second);

// Pairs that are each other's nearest, by rising index in a: at most max_distance apart, and below ratio times the distance of
// a's second nearest. Ties go to the lower index. Source: Lowe 2004.
Pairs mutual(Descriptors a, Descriptors b, int max_distance, double ratio);

// As mutual, of each of a with those of b whose node is one of its two: nodes_a holds two numbers for each of a, nodes_b one
// for each of b, none negative. Source: direct index, Galvez-Lopez and Tardos 2012, section III-B.
Pairs mutual_within(Descriptors a, const int32_t* nodes_a, Descriptors b, const int32_t* nodes_b, int max_distance, double ratio);

}  // namespace fleetmap
