// Counts of memory allocations by steps of the core: steps that robots repeat in every frame should not allocate.
#pragma once

#include <cstdint>

namespace fleetmap {

// All allocations of this thread by operator new.
uint64_t all_allocations();

// Allocations of this thread within counted steps.
uint64_t step_allocations();

class CountedStep {
 public:
  CountedStep() : before_(all_allocations()) {}
  CountedStep(const CountedStep&) = delete;
  ~CountedStep();

 private:
  uint64_t before_;
};

}  // namespace fleetmap
