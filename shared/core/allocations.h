// How often steps of the core allocate memory: what robots repeat in every frame should not.
#pragma once

#include <cstdint>

namespace fleetmap {

// Of this thread, by operator new, whatever for.
uint64_t all_allocations();

// Of this thread, within the steps that were counted.
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
