// The module. This file is compiled for any processor of its kind, so that one that is too old gets to read why it is refused.
#include <nanobind/nanobind.h>

#if defined(__x86_64__)
#include <cpuid.h>
#endif

#include <cstdlib>
#include <new>

#include "allocations.h"

// In place of the library's, for this module.
void* operator new(size_t size) {
  ++fleetmap::all_allocations;
  if (void* const memory = std::malloc(size > 0 ? size : 1)) return memory;
  throw std::bad_alloc();
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, size_t) noexcept { std::free(memory); }

namespace nb = nanobind;

namespace fleetmap {

using Bind = void(nb::module_&);
Bind bind_aliases, bind_bundle, bind_camera, bind_corners, bind_dense_stereo, bind_filter, bind_grid, bind_image_quality, bind_image_rows,
    bind_imu_checks, bind_landmarks, bind_matching, bind_mono_window, bind_pair_matching, bind_patch_align, bind_png, bind_pnp,
    bind_preintegration, bind_projection, bind_protection, bind_rays, bind_relocalization, bind_remap, bind_render, bind_stereo,
    bind_surfels, bind_tracking, bind_vocabulary;

}  // namespace fleetmap

#if defined(__x86_64__)
// Queried from the processor itself: not every compiler's library supports __builtin_cpu_supports.
static bool has_avx2_and_fma() {
  unsigned a = 0, b = 0, c = 0, d = 0;
  if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_FMA) || !(c & bit_OSXSAVE)) return false;
  unsigned saved_low = 0, saved_high = 0;  // registers that the system saves: those of AVX are bits 1 and 2
  __asm__ volatile("xgetbv" : "=a"(saved_low), "=d"(saved_high) : "c"(0));
  if ((saved_low & 6) != 6) return false;
  return __get_cpuid_count(7, 0, &a, &b, &c, &d) && (b & bit_AVX2) && (b & bit_BMI2);
}
#endif

NB_MODULE(_core, module) {
#if defined(__x86_64__)
  if (!has_avx2_and_fma())
    throw nb::import_error(
        "fleetmap needs a processor with AVX2 and FMA (x86-64-v3: Intel since Haswell, 2013; AMD since Excavator, 2015), which this one "
        "is not; in a virtual machine let it see the host's processor");
#endif
  using namespace fleetmap;
  module.def("allocations", [] { return step_allocations; });
  for (Bind* const bind :
       {bind_dense_stereo,   bind_aliases,    bind_bundle,     bind_camera,         bind_corners,    bind_filter,      bind_grid,
        bind_image_quality,  bind_image_rows, bind_imu_checks, bind_landmarks,      bind_matching,   bind_mono_window, bind_pair_matching,
        bind_patch_align,    bind_png,        bind_pnp,        bind_preintegration, bind_projection, bind_protection,  bind_rays,
        bind_relocalization, bind_remap,      bind_render,     bind_stereo,         bind_surfels,    bind_tracking,    bind_vocabulary})
    bind(module);
}
