#include "allocations.h"

#include <cstddef>
#include <cstdlib>
#include <new>

namespace {
thread_local uint64_t of_all = 0, of_steps = 0;
}

// In place of the library's, for this module.
void* operator new(size_t size) {
  ++of_all;
  if (void* const memory = std::malloc(size > 0 ? size : 1)) return memory;
  throw std::bad_alloc();
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, size_t) noexcept { std::free(memory); }

namespace fleetmap {

uint64_t all_allocations() { return of_all; }
uint64_t step_allocations() { return of_steps; }
CountedStep::~CountedStep() { of_steps += of_all - before_; }

}  // namespace fleetmap
