#include "stereo.h"
#include "images.h"  // first: Python's header comes before the system's

using namespace fleetmap;

namespace {

auto match_rows_of(const Image& left, const Image& right, const Image& left_half, const Image& right_half, const Places& pixels,
                   const Array<double, -1>& prior_px, double max_disparity_px, double min_correlation, double uniqueness, int wide_half,
                   int narrow_half, double agreement_px) {
  if (!same_size(left, right) || !same_size(left_half, right_half)) throw nb::value_error("right: of the left image's size");
  if (prior_px.shape(0) != pixels.shape(0)) throw nb::value_error("prior_px: one for each pixel");
  const size_t count = pixels.shape(0);
  std::vector<double> found(2 * count);
  const StereoLimits limits = checked({max_disparity_px, min_correlation, uniqueness, wide_half, narrow_half, agreement_px});
  unlocked([&] {
    StereoMatcher().match_rows({grey(left), grey(right)}, {grey(left_half), grey(right_half)}, pixels.data(), prior_px.data(), count,
                               limits, found.data());
  });
  return as_numpy<double, 2>(std::move(found), {count, 2});
}

auto match_depth_of(const Array<float, -1, -1>& disparity_px, const Places& pixels, double sigma_px) {
  const size_t count = pixels.shape(0);
  std::vector<double> found(2 * count);
  unlocked([&] { match_depth(grey(disparity_px), pixels.data(), count, sigma_px, found.data()); });
  return as_numpy<double, 2>(std::move(found), {count, 2});
}

}  // namespace

void bind_stereo(nb::module_& module) {
  module.def("match_rows", &match_rows_of, "left"_a.noconvert(), "right"_a.noconvert(), "left_half"_a.noconvert(),
             "right_half"_a.noconvert(), "pixels"_a.noconvert(), "prior_px"_a.noconvert(), "max_disparity_px"_a, "min_correlation"_a,
             "uniqueness"_a, "wide_half"_a, "narrow_half"_a, "agreement_px"_a);
  module.def("match_depth", &match_depth_of, "disparity_px"_a.noconvert(), "pixels"_a.noconvert(), "sigma_px"_a);
}
