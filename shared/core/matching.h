// Hamming distances of 256-bit descriptors, and matching by them near a predicted pixel.
#pragma once

#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
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

// Loops in versions for the instructions that a processor has: of integers only, whose results are the same in each.
#if defined(__x86_64__)
template <typename Loop>
__attribute__((noinline, target("avx512f,avx512vl,avx512vpopcntdq"))) void run_with_vector_popcount(const Loop& loop) {
  loop();
}

// Runs a loop that counts bits, by the processor's instruction for vectors of counts where it has one, which halves the time. The
// loop is a lambda with __attribute__((always_inline)).
template <typename Loop>
void run_popcount(const Loop& loop) {
  static const bool has_vector_popcount = __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512vpopcntdq");
  if (has_vector_popcount)
    run_with_vector_popcount(loop);
  else
    loop();
}
#else
template <typename Loop>
void run_popcount(const Loop& loop) {
  loop();
}
#endif

using Pairs = std::vector<std::array<int64_t, 2>>;

// Predicted pixels and appearance of landmarks or features in an image; NaN excludes one from matching.
struct Projections {
  const double *pixels, *radius_px;  // (A, 2), (A,)
  const int64_t* octave_range;       // (A, 2) lowest and highest octave, both included
  Descriptors descriptors;           // of A
};

struct SeenFeatures {
  const double* pixels;  // (B, 2)
  const int8_t* octaves;
  Descriptors descriptors;  // of B
};

// Fills index (A,) of the matching feature of each, -1 none, and their distance (A,), kFar none. The distance is at most max_distance and
// below ratio times that of its nearest rival of the same octave: a corner found again on the next octave is no rival. Each feature goes
// to the nearest candidate that chose it, the others stay unmatched; ties to the lower index.
void match_projected(const Projections& a, const SeenFeatures& b, int max_distance, double ratio, int64_t* index, int32_t* distances);

}  // namespace fleetmap
