#include "arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <optional>

#include "pnp_search.h"
#include "refinement.h"

using namespace fleetmap;

namespace {

using Points = Array<double, -1, 3>;
using Weights = Array<double, -1, 2>;

Sightings sightings_of(const Points& points, const Points& pixels, const Weights& weights) {
  if (pixels.shape(0) != points.shape(0) || weights.shape(0) != points.shape(0))
    throw nb::value_error("pixels and weights: one row for each point");
  return {points.data(), pixels.data(), weights.data(), points.shape(0)};
}

Agreement agreement_of(double threshold_px, int min_inliers) { return {threshold_px, size_t(std::max(min_inliers, 0))}; }

using Matrix2 = nb::ndarray<nb::numpy, double, nb::ndim<2>>;
using Result = std::optional<std::tuple<Matrix2, Matrix2, nb::ndarray<nb::numpy, double, nb::ndim<1>>>>;

Result result_of(std::optional<Resection>&& found) {
  if (!found) return {};
  std::vector<double> matrix(16), information(found->information, found->information + 36);
  store(found->cam_from_source, matrix.data());
  return {{as_numpy<double, 2>(std::move(matrix), {4, 4}), as_numpy<double, 2>(std::move(information), {6, 6}),
           as_numpy<double>(std::move(found->squared))}};
}

Result refine_pnp_of(const Points& points, const Points& pixels, const Weights& weights, const Lens& lens, const Limits& refinement,
                     const Array<double, 4, 4>& cam_from_source, const std::optional<Array<double, 6, 6>>& prior) {
  const Sightings seen = sightings_of(points, pixels, weights);
  const Refinement limits = refinement_of(refinement);
  return result_of(
      unlocked([&] { return refine_pnp(seen, lens_of(lens), limits, prior ? prior->data() : nullptr, se3(cam_from_source.data())); }));
}

Result ransac_pnp_of(const Points& points, const Points& pixels, const Weights& weights, const Lens& lens, const Limits& refinement,
                     double threshold_px, int min_inliers, const Points& draws, double confidence) {
  const Sightings seen = sightings_of(points, pixels, weights);
  if (!std::all_of(draws.data(), draws.data() + draws.size(), [](double draw) { return draw >= 0.0 && draw < 1.0; }))
    throw nb::value_error("draws: from 0 to below 1");
  const Refinement limits = refinement_of(refinement);
  return result_of(unlocked([&] {
    return ransac_pnp(seen, lens_of(lens), limits, agreement_of(threshold_px, min_inliers), draws.data(), draws.shape(0), confidence);
  }));
}

Result pnp_with_rotation_of(const Points& points, const Points& pixels, const Weights& weights, const Lens& lens, const Limits& refinement,
                            double threshold_px, int min_inliers, const Array<double, 3, 3>& rotation, double rotation_sigma_rad) {
  const Sightings seen = sightings_of(points, pixels, weights);
  const Refinement limits = refinement_of(refinement);
  return result_of(unlocked([&] {
    return pnp_with_rotation(seen, lens_of(lens), limits, agreement_of(threshold_px, min_inliers), mat3(rotation.data()),
                             rotation_sigma_rad);
  }));
}

}  // namespace

void bind_pnp(nb::module_& module) {
  const auto points = "points"_a.noconvert(), pixels = "pixels"_a.noconvert(), weights = "weights"_a.noconvert();
  const auto lens = "lens"_a.noconvert();
  const auto refinement = "refinement"_a, threshold = "threshold_px"_a, least = "min_inliers"_a;
  module.def("refine_pnp", &refine_pnp_of, points, pixels, weights, lens, refinement, "cam_from_source"_a.noconvert(),
             "prior"_a.noconvert().none());
  module.def("ransac_pnp", &ransac_pnp_of, points, pixels, weights, lens, refinement, threshold, least, "draws"_a.noconvert(),
             "confidence"_a);
  module.def("pnp_with_rotation", &pnp_with_rotation_of, points, pixels, weights, lens, refinement, threshold, least,
             "rotation"_a.noconvert(), "rotation_sigma_rad"_a);
}
