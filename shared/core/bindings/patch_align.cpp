#include "patch_align.h"
#include "images.h"  // first: Python's header comes before the system's

using namespace fleetmap;

namespace {

using Pyramid = std::tuple<Image, Image, Image>;
using Octaves = Array<int8_t, -1>;
using Points = Array<double, -1, 3>;
// Those of an image: pyramid, pixels (M, 2), octaves (M,), angles in degrees (M,), and the chosen ones (N,).
using Features = std::tuple<Pyramid, Places, Octaves, Array<float, -1>, Array<int64_t, -1>>;

PatchFeatures features_of(const Pyramid& pyramid, const Places& pixels, const Octaves& octaves) {
  if (octaves.shape(0) != pixels.shape(0)) throw nb::value_error("octaves: one for each pixel");
  const auto& [whole, half, quarter] = pyramid;
  return {{grey(whole), grey(half), grey(quarter)}, pixels.data(), octaves.data()};
}

PatchLimits limits_of(int half, double max_shift_px, double min_correlation) {
  if (half < 1 || half > kMostPatchHalf) throw nb::value_error("half: 1 to 15");
  return {half, max_shift_px, min_correlation};
}

void store(const Alignment& found, double* row) { row[0] = found.x, row[1] = found.y, row[2] = found.sigma_px; }

auto align_patches_of(const Pyramid& reference, const Places& reference_pixels, const Octaves& reference_octaves, const Pyramid& current,
                      const Places& pixels, const Octaves& octaves, const Array<double, -1, 2, 3>& warps, int half, double max_shift_px,
                      double min_correlation) {
  const PatchLimits limits = limits_of(half, max_shift_px, min_correlation);
  const PatchFeatures a = features_of(reference, reference_pixels, reference_octaves), b = features_of(current, pixels, octaves);
  const size_t count = pixels.shape(0);
  if (reference_pixels.shape(0) != count || warps.shape(0) != count) throw nb::value_error("reference_pixels, warps: one for each pixel");
  std::vector<double> found(3 * count);
  unlocked([&] {
    for (size_t n = 0; n < count; ++n) {
      const double* row = warps.data() + 6 * n;
      const Warp warp{row[0], row[1], row[3], row[4], row[2], row[5]};
      store(align_feature(a, int64_t(n), b, int64_t(n), warp, limits), found.data() + 3 * n);
    }
  });
  return as_numpy<double, 2>(std::move(found), {count, 3});
}

auto align_observations_of(const Features& reference, const Features& own, const Points& points_reference,
                           const Array<double, 4, 4>& own_from_reference, int half, double max_shift_px, double min_correlation) {
  const PatchLimits limits = limits_of(half, max_shift_px, min_correlation);
  const auto& [pyramid_a, pixels_a, octaves_a, angles_a, chosen_a] = reference;
  const auto& [pyramid_b, pixels_b, octaves_b, angles_b, chosen_b] = own;
  const PatchFeatures a = features_of(pyramid_a, pixels_a, octaves_a), b = features_of(pyramid_b, pixels_b, octaves_b);
  const size_t count = chosen_b.shape(0);
  if (angles_a.shape(0) != pixels_a.shape(0) || angles_b.shape(0) != pixels_b.shape(0)) throw nb::value_error("angles: one for each pixel");
  if (chosen_a.shape(0) != count || points_reference.shape(0) != count) throw nb::value_error("points_reference: one for each chosen");
  for (size_t n = 0; n < count; ++n)
    if (size_t(chosen_a(n)) >= pixels_a.shape(0) || size_t(chosen_b(n)) >= pixels_b.shape(0))
      throw nb::value_error("chosen: indices of pixels");
  std::vector<double> found(3 * count);
  unlocked([&] {
    const SE3 motion = se3(own_from_reference.data());
    for (size_t n = 0; n < count; ++n) {
      const int64_t i = chosen_a.data()[n], j = chosen_b.data()[n];
      // finer than octaves and angles
      const auto by_motion = warp_from_motion(vec3(points_reference.data() + 3 * n), motion);
      const Warp warp =
          by_motion ? *by_motion : warp_from_features(octaves_a.data()[i], angles_a.data()[i], octaves_b.data()[j], angles_b.data()[j]);
      store(align_feature(a, i, b, j, warp, limits), found.data() + 3 * n);
    }
  });
  return as_numpy<double, 2>(std::move(found), {count, 3});
}

auto warps_from_motion_of(const Points& points_reference, const Array<double, 4, 4>& current_from_reference) {
  const size_t count = points_reference.shape(0);
  std::vector<double> warps(6 * count, Alignment::kNaN);
  unlocked([&] {
    for (size_t n = 0; n < count; ++n)
      if (const auto warp = warp_from_motion(vec3(points_reference.data() + 3 * n), se3(current_from_reference.data()))) {
        double* row = warps.data() + 6 * n;
        row[0] = warp->xx, row[1] = warp->xy, row[2] = warp->slant_x, row[3] = warp->yx, row[4] = warp->yy, row[5] = warp->slant_y;
      }
  });
  return as_numpy<double, 3>(std::move(warps), {count, 2, 3});
}

}  // namespace

void bind_patch_align(nb::module_& module) {
  const auto reference = "reference"_a.noconvert();
  module.def("align_patches", &align_patches_of, reference, "reference_pixels"_a.noconvert(), "reference_octaves"_a.noconvert(),
             "current"_a.noconvert(), "pixels"_a.noconvert(), "octaves"_a.noconvert(), "warps"_a.noconvert(), "half"_a, "max_shift_px"_a,
             "min_correlation"_a);
  module.def("align_observations", &align_observations_of, reference, "own"_a.noconvert(), "points_reference"_a.noconvert(),
             "own_from_reference"_a.noconvert(), "half"_a, "max_shift_px"_a, "min_correlation"_a);
  module.def("warps_from_motion", &warps_from_motion_of, "points_reference"_a.noconvert(), "current_from_reference"_a.noconvert());
}
