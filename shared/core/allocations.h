// Counts of memory allocations by steps of the core: steps that robots repeat in every frame should not allocate.
#pragma once

#include <cstdint>

namespace fleetmap {

// Of this thread, by operator new: all, and those within counted steps.
inline thread_local uint64_t all_allocations = 0, step_allocations = 0;

class CountedStep {
 public:
  CountedStep() = default;
  CountedStep(const CountedStep&) = delete;
  ~CountedStep() { step_allocations += all_allocations - before_; }

 private:
  uint64_t before_ = all_allocations;
};

}  // namespace fleetmap
