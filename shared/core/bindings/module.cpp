// The module. This file is compiled for any processor of its kind, so that one that is too old gets to read why it is refused.
#include <nanobind/nanobind.h>

#if defined(__x86_64__)
#include <cpuid.h>
#endif

#include "allocations.h"

namespace nb = nanobind;

void bind_aliases(nb::module_&);
void bind_block_cholesky(nb::module_&);
void bind_bundle(nb::module_&);
void bind_camera(nb::module_&);
void bind_corners(nb::module_&);
void bind_filter(nb::module_&);
void bind_grid(nb::module_&);
void bind_imu_checks(nb::module_&);
void bind_mono_window(nb::module_&);
void bind_image_quality(nb::module_&);
void bind_landmarks(nb::module_&);
void bind_matching(nb::module_&);
void bind_pair_matching(nb::module_&);
void bind_patch_align(nb::module_&);
void bind_pnp(nb::module_&);
void bind_preintegration(nb::module_&);
void bind_relocalization(nb::module_&);
void bind_render(nb::module_&);
void bind_stereo(nb::module_&);
void bind_surfels(nb::module_&);
void bind_track_joining(nb::module_&);
void bind_tracking(nb::module_&);
void bind_vocabulary(nb::module_&);

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
  module.def("allocations", &fleetmap::step_allocations);
  bind_aliases(module);
  bind_block_cholesky(module);
  bind_bundle(module);
  bind_corners(module);
  bind_filter(module);
  bind_grid(module);
  bind_imu_checks(module);
  bind_mono_window(module);
  bind_camera(module);
  bind_image_quality(module);
  bind_landmarks(module);
  bind_matching(module);
  bind_pair_matching(module);
  bind_patch_align(module);
  bind_pnp(module);
  bind_preintegration(module);
  bind_relocalization(module);
  bind_render(module);
  bind_stereo(module);
  bind_track_joining(module);
  bind_vocabulary(module);
  bind_surfels(module);
  bind_tracking(module);
}
