#include "pair_matching.h"
#include "refinement.h"  // first: Python's header comes before the system's

using namespace fleetmap;

namespace {

using Points = Array<double, -1, 3>;
using Size = std::tuple<double, double>;
// pixels (N, 2), octaves (N,), descriptors (N, 4), disparities (N, 2), points_cam (N, 3), true if the disparities are measured
using Features = std::tuple<Array<double, -1, 2>, Array<int8_t, -1>, Array<uint64_t, -1, 4>, Array<double, -1, 2>, Points, bool>;

KeyframeFeatures features_of(const Features& features) {
  const auto& [pixels, octaves, descriptors, disparities, points_cam, is_measured] = features;
  const size_t count = descriptors.shape(0);
  if (pixels.shape(0) != count || octaves.shape(0) != count || disparities.shape(0) != count || points_cam.shape(0) != count)
    throw nb::value_error("a, b: as many pixels, octaves, disparities and points as descriptors");
  return {pixels.data(), octaves.data(), {descriptors.data(), count}, disparities.data(), points_cam.data(), is_measured};
}

auto match_guided_of(const Features& a, const Features& b, const Array<double, 4, 4>& b_from_a, const Lens& lens, const Size& size_px,
                     double sigma_px, const Limits& refinement, int max_distance, const Array<double, -1>& radii_px, int least_inliers,
                     double least_share) {
  if (least_inliers < 0) throw nb::value_error("least_inliers: not negative");
  const PairGuidance guidance{lens_of(lens), std::get<0>(size_px), std::get<1>(size_px), sigma_px, refinement_of(refinement), max_distance};
  const PairStart start{{radii_px.data(), radii_px.data() + radii_px.size()}, least_inliers, least_share};
  const KeyframeFeatures ours = features_of(a), theirs = features_of(b);
  GuidedPair found = unlocked([&] { return match_guided(ours, theirs, guidance, se3(b_from_a.data()), start); });
  std::vector<double> motion(16), hessian(found.hessian, found.hessian + 36);
  store(found.b_from_a, motion.data());
  const size_t count = found.pairs.size();
  static_assert(sizeof(found.pairs[0]) == 2 * sizeof(int32_t));
  return std::make_tuple(int(found.good), as_numpy<int32_t, 2>(std::move(found.pairs), {count, 2}),
                         as_numpy<double, 2>(std::move(motion), {4, 4}), as_numpy<double, 2>(std::move(hessian), {6, 6}));
}

double share_in_view_of(const Array<double, 4, 4>& b_from_a, const Points& points_a, const Array<double, -1, 2>& disparities_a,
                        const Lens& lens, const Size& size_px) {
  if (points_a.shape(0) != disparities_a.shape(0)) throw nb::value_error("disparities_a: one for each point");
  return unlocked([&] {
    return share_in_view(se3(b_from_a.data()), points_a.data(), disparities_a.data(), points_a.shape(0), lens_of(lens),
                         std::get<0>(size_px), std::get<1>(size_px));
  });
}

}  // namespace

void bind_pair_matching(nb::module_& module) {
  const auto b_from_a = "b_from_a"_a.noconvert(), lens = "lens"_a.noconvert();
  module.def("match_guided", &match_guided_of, "a"_a.noconvert(), "b"_a.noconvert(), b_from_a, lens, "size_px"_a, "sigma_px"_a,
             "refinement"_a, "max_distance"_a, "radii_px"_a.noconvert(), "least_inliers"_a, "least_share"_a);
  module.def("share_in_view", &share_in_view_of, b_from_a, "points_a"_a.noconvert(), "disparities_a"_a.noconvert(), lens, "size_px"_a);
}
