// Matching of two keyframes near a motion: prediction of one's features in the other, and the motion that fits them.
#include "bindings/arguments.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <limits>

namespace fleetmap {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr double kRatio = 0.95;  // of the nearest descriptor to its rival near a predicted pixel
constexpr double kScale = 1.2;   // from octave to octave
constexpr double kNearM = 1e-6;

using Size = std::tuple<double, double>;  // width and height
// Features of a keyframe: pixels, octaves, descriptors, disparities with their standard deviations, NaN unknown, points in the camera by
// those, and true if the keyframe measured the disparities itself.
using Features = std::tuple<Places, Array<int8_t, -1>, Packed, Places, Points, bool>;

void check(const Features& features) {
  const auto& [pixels, octaves, descriptors, disparities, points_cam, is_measured] = features;
  check_rows(descriptors.shape(0), "a, b: as many pixels, octaves, disparities and points as descriptors", pixels, octaves, disparities,
             points_cam);
}

struct PairGuidance {
  StereoLens lens;
  Size size_px;
  double sigma_px;  // of features; it grows with their octaves
  Refinement refinement;
  int max_distance;
};

struct GuidedPair {
  int good = 0;                               // number of successful radii
  std::vector<std::array<int32_t, 2>> pairs;  // if all succeeded
  SE3 b_from_a;
  Mat6 hessian = {};
};

// By which pixels of an octave are coarser than the image's.
double coarseness(double octave) { return std::pow(kScale, std::min(std::max(octave, 0.0), 4.0)); }

// Pixel of a point of camera b's frame, none outside of its image.
std::optional<std::array<double, 2>> seen_by(Vec3 point, const StereoLens& lens, const Size& size_px) {
  const auto [width_px, height_px] = size_px;
  if (!(point[2] > kNearM)) return {};
  const double u = lens.focal * point[0] / point[2] + lens.cx, v = lens.focal * point[1] / point[2] + lens.cy;
  if (!(0.0 < u && u < width_px && 0.0 < v && v < height_px)) return {};
  return {{u, v}};
}

// Matches of a's features with depth into b. Nearer, a feature appears larger and so on a higher octave; there pixels are coarser and the
// search is wider.
Pairs project_matches(const Features& a, const Features& b, const PairGuidance& guidance, const SE3& b_from_a, double radius_px) {
  const auto& [pixels, octaves, descriptors, disparities, points_cam, is_measured] = a;
  const auto& [pixels_b, octaves_b, descriptors_b, disparities_b, points_b, is_measured_b] = b;
  const size_t count = descriptors.shape(0);
  std::vector<double> predicted(2 * count, kNaN), radius(count, 0.0);
  std::vector<int64_t> span(2 * count, 0);
  for (size_t n = 0; n < count; ++n) {
    if (!std::isfinite(disparities(n, 0))) continue;
    const Vec3 point = points_cam.rows()[n], in_b = b_from_a * point;
    const auto seen = seen_by(in_b, guidance.lens, guidance.size_px);
    if (!seen) continue;
    const double nearer = std::min(std::max(point[2] / std::max(in_b[2], 0.05), 0.1), 10.0);
    const double octave = octaves(n) + std::log(nearer) / std::log(kScale);
    std::copy(seen->begin(), seen->end(), &predicted[2 * n]);
    span[2 * n] = int64_t(std::floor(octave)) - 2, span[2 * n + 1] = int64_t(std::ceil(octave)) + 2;
    radius[n] = radius_px * coarseness(octave);
  }
  std::vector<int64_t> found(count);
  std::vector<int32_t> distances(count);
  match_projected({predicted.data(), radius.data(), span.data(), descriptors}, {pixels_b.data(), octaves_b.data(), descriptors_b},
                  guidance.max_distance, kRatio, found.data(), distances.data());
  Pairs pairs;
  for (size_t n = 0; n < count; ++n)
    if (found[n] >= 0) pairs.push_back({int64_t(n), found[n]});
  return pairs;
}

// Whether the pairs give a motion, and their squared residuals.
bool refine(const Features& a, const Features& b, const PairGuidance& guidance, const Pairs& pairs, GuidedPair& found,
            std::vector<double>& squared) {
  const auto& [pixels, octaves, descriptors, disparities, points, is_measured] = b;
  ChosenSightings seen, inliers;
  squared.resize(pairs.size());
  for (const auto& [i, j] : pairs) {
    const double u = pixels(j, 0), disparity = is_measured ? disparities(j, 0) : kNaN, coarse = coarseness(octaves(j));
    const Vec3 pixel = {u, pixels(j, 1), u - disparity};
    const std::array<double, 2> weights = {1.0 / (guidance.sigma_px * coarse), 1.0 / std::max(guidance.sigma_px, coarse)};
    seen.add({std::get<Points>(a).rows() + i, &pixel, &weights, 1}, 0);
  }
  return refine_twice(seen.all(), guidance.lens, guidance.refinement, {}, found.b_from_a, found.hessian, squared.data(), inliers);
}

// The matches of a into b, and those of b into a whose features they leave free.
void match_both_ways(const Features& a, const Features& b, const PairGuidance& guidance, double radius_px, const Pairs& forward,
                     GuidedPair& found) {
  std::vector<char> taken_a(std::get<Packed>(a).shape(0)), taken_b(std::get<Packed>(b).shape(0));
  for (const auto& [i, j] : forward) {
    found.pairs.push_back({int32_t(i), int32_t(j)});
    taken_a[size_t(i)] = taken_b[size_t(j)] = true;
  }
  for (const auto& [j, i] : project_matches(b, a, guidance, inverse(found.b_from_a), radius_px))
    if (!taken_a[size_t(i)] && !taken_b[size_t(j)]) found.pairs.push_back({int32_t(i), int32_t(j)});
}

// Matches a's features into b by projection and finds the motion from them in turn, once for each radius: with so many inliers each time,
// and the first time with that share of the matches. At the end b's features are matched into a too, to those whose features are still
// free.
GuidedPair guided(const Features& a, const Features& b, const PairGuidance& guidance, const SE3& b_from_a,
                  const std::vector<double>& radii_px, int least_inliers, double least_share) {
  GuidedPair found;
  found.b_from_a = b_from_a;
  Pairs pairs;
  std::vector<double> squared;
  for (const double radius_px : radii_px) {
    pairs = project_matches(a, b, guidance, found.b_from_a, radius_px);
    if (pairs.size() < size_t(least_inliers) || !refine(a, b, guidance, pairs, found, squared)) return found;
    const double wanted = found.good == 0 ? least_share * double(pairs.size()) : 0.0;
    size_t inliers = 0;
    for (size_t n = 0; n < pairs.size(); ++n)
      if (squared[n] < guidance.refinement.gate_squared) pairs[inliers++] = pairs[n];
    if (double(inliers) < std::max(double(least_inliers), wanted)) return found;
    pairs.resize(inliers);
    ++found.good;
  }
  if (!radii_px.empty()) match_both_ways(a, b, guidance, radii_px.back(), pairs, found);
  return found;
}

auto match_guided(const Features& a, const Features& b, const SE3& b_from_a, const StereoLens& lens, const Size& size_px, double sigma_px,
                  const Limits& refinement, int max_distance, const Reals& radii_px, int least_inliers, double least_share) {
  if (least_inliers < 0) throw nb::value_error("least_inliers: not negative");
  const PairGuidance guidance{lens, size_px, sigma_px, refinement_of(refinement), max_distance};
  check(a), check(b);
  GuidedPair found =
      unlocked([&] { return guided(a, b, guidance, b_from_a, {radii_px.begin(), radii_px.end()}, least_inliers, least_share); });
  return std::tuple(found.good, std::move(found.pairs), found.b_from_a, found.hessian);
}

// Share of a's points with a disparity in view of b, at a similar distance.
double share_in_view(const SE3& b_from_a, const Points& points_a, const Places& disparities_a, const StereoLens& lens,
                     const Size& size_px) {
  check_rows(disparities_a.shape(0), "disparities_a: one for each point", points_a);
  return unlocked([&] {
    size_t known = 0, seen = 0;
    for (size_t n = 0; n < points_a.shape(0); ++n) {
      if (!std::isfinite(disparities_a(n, 0))) continue;
      ++known;
      const Vec3 point = points_a.rows()[n], in_b = b_from_a * point;
      const double farther = in_b[2] / point[2];
      seen += 0.4 < farther && farther < 2.5 && seen_by(in_b, lens, size_px);
    }
    return known ? double(seen) / double(known) : 0.0;
  });
}

}  // namespace

void bind_pair_matching(nb::module_& module) {
  module.def("match_guided", &match_guided, "a"_a, "b"_a, "b_from_a"_a, "lens"_a, "size_px"_a, "sigma_px"_a, "refinement"_a,
             "max_distance"_a, "radii_px"_a, "least_inliers"_a, "least_share"_a);
  module.def("share_in_view", &share_in_view, "b_from_a"_a, "points_a"_a, "disparities_a"_a, "lens"_a, "size_px"_a);
}

}  // namespace fleetmap
