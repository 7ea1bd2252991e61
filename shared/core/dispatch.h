// Loops in versions for the instructions that a processor has: of integers only, whose results are the same in each.
#pragma once

namespace fleetmap {

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

}  // namespace fleetmap
