#include "pair_matching.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include "projection.h"

namespace fleetmap {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr double kRatio = 0.95;  // of the nearest descriptor to its rival near a predicted pixel
constexpr double kScale = 1.2;   // from octave to octave
constexpr double kNearM = 1e-6;

// By which pixels of an octave are coarser than the image's.
double coarseness(double octave) { return std::pow(kScale, std::min(std::max(octave, 0.0), 4.0)); }

// Pixel of a point of camera b's frame, none outside of its image.
std::optional<std::pair<double, double>> seen_by(Vec3 point, const StereoLens& lens, double width_px, double height_px) {
  if (!(point[2] > kNearM)) return {};
  const double u = lens.focal * point[0] / point[2] + lens.cx, v = lens.focal * point[1] / point[2] + lens.cy;
  if (!(0.0 < u && u < width_px && 0.0 < v && v < height_px)) return {};
  return std::pair(u, v);
}

// Matches of a's features with depth into b. Nearer, a feature appears larger and so on a higher octave; there pixels are coarser and the
// search is wider.
Pairs project_matches(const KeyframeFeatures& a, const KeyframeFeatures& b, const PairGuidance& guidance, const SE3& b_from_a,
                      double radius_px) {
  const size_t count = a.count();
  std::vector<double> predicted(2 * count, kNaN), radius(count, 0.0);
  std::vector<int64_t> span(2 * count, 0);
  for (size_t n = 0; n < count; ++n) {
    if (!std::isfinite(a.disparities[2 * n])) continue;
    const Vec3 point = vec3(a.points_cam + 3 * n), in_b = b_from_a * point;
    const auto seen = seen_by(in_b, guidance.lens, guidance.width_px, guidance.height_px);
    if (!seen) continue;
    const double nearer = std::min(std::max(point[2] / std::max(in_b[2], 0.05), 0.1), 10.0);
    const double octave = a.octaves[n] + std::log(nearer) / std::log(kScale);
    predicted[2 * n] = seen->first, predicted[2 * n + 1] = seen->second;
    span[2 * n] = int64_t(std::floor(octave)) - 2, span[2 * n + 1] = int64_t(std::ceil(octave)) + 2;
    radius[n] = radius_px * coarseness(octave);
  }
  std::vector<int64_t> found(count);
  std::vector<int32_t> distances(count);
  match_projected({predicted.data(), radius.data(), span.data(), a.descriptors}, {b.pixels, b.octaves, b.descriptors},
                  guidance.max_distance, kRatio, found.data(), distances.data());
  Pairs pairs;
  for (size_t n = 0; n < count; ++n)
    if (found[n] >= 0) pairs.emplace_back(int64_t(n), found[n]);
  return pairs;
}

// Whether the pairs give a motion, and their squared residuals.
bool refine(const KeyframeFeatures& a, const KeyframeFeatures& b, const PairGuidance& guidance, const Pairs& pairs, GuidedPair& found,
            std::vector<double>& squared) {
  const size_t count = pairs.size();
  std::vector<double> points(3 * count), pixels(3 * count), weights(2 * count);
  squared.resize(count);
  for (size_t n = 0; n < count; ++n) {
    const auto [i, j] = pairs[n];
    std::copy_n(a.points_cam + 3 * i, 3, points.data() + 3 * n);
    const double u = b.pixels[2 * j], v = b.pixels[2 * j + 1], disparity = b.is_measured ? b.disparities[2 * j] : kNaN;
    pixels[3 * n] = u, pixels[3 * n + 1] = v, pixels[3 * n + 2] = u - disparity;
    const double coarse = coarseness(b.octaves[j]);
    weights[2 * n] = 1.0 / (guidance.sigma_px * coarse), weights[2 * n + 1] = 1.0 / std::max(guidance.sigma_px, coarse);
  }
  ChosenSightings inliers;
  return refine_twice({points.data(), pixels.data(), weights.data(), count}, guidance.lens, guidance.refinement, nullptr, found.b_from_a,
                      found.hessian, squared.data(), inliers);
}

// The matches of a into b, and those of b into a whose features they leave free.
void match_both_ways(const KeyframeFeatures& a, const KeyframeFeatures& b, const PairGuidance& guidance, double radius_px,
                     const Pairs& forward, GuidedPair& found) {
  std::vector<char> taken_a(a.count(), false), taken_b(b.count(), false);
  for (const auto& [i, j] : forward) {
    found.pairs.emplace_back(int32_t(i), int32_t(j));
    taken_a[size_t(i)] = taken_b[size_t(j)] = true;
  }
  for (const auto& [j, i] : project_matches(b, a, guidance, inverse(found.b_from_a), radius_px))
    if (!taken_a[size_t(i)] && !taken_b[size_t(j)]) found.pairs.emplace_back(int32_t(i), int32_t(j));
}

}  // namespace

GuidedPair match_guided(const KeyframeFeatures& a, const KeyframeFeatures& b, const PairGuidance& guidance, const SE3& b_from_a,
                        const PairStart& start) {
  GuidedPair found;
  found.b_from_a = b_from_a;
  Pairs pairs;
  std::vector<double> squared;
  for (const double radius_px : start.radii_px) {
    pairs = project_matches(a, b, guidance, found.b_from_a, radius_px);
    if (pairs.size() < size_t(start.least_inliers) || !refine(a, b, guidance, pairs, found, squared)) return found;
    const double wanted = found.good == 0 ? start.least_share * double(pairs.size()) : 0.0;
    size_t inliers = 0;
    for (size_t n = 0; n < pairs.size(); ++n)
      if (squared[n] < guidance.refinement.gate_squared) pairs[inliers++] = pairs[n];
    if (double(inliers) < std::max(double(start.least_inliers), wanted)) return found;
    pairs.resize(inliers);
    ++found.good;
  }
  if (!start.radii_px.empty()) match_both_ways(a, b, guidance, start.radii_px.back(), pairs, found);
  return found;
}

double share_in_view(const SE3& b_from_a, const double* points_a, const double* disparities_a, size_t count, const StereoLens& lens,
                     double width_px, double height_px) {
  size_t known = 0, seen = 0;
  for (size_t n = 0; n < count; ++n) {
    if (!std::isfinite(disparities_a[2 * n])) continue;
    ++known;
    const Vec3 point = vec3(points_a + 3 * n), in_b = b_from_a * point;
    const double farther = in_b[2] / point[2];
    seen += 0.4 < farther && farther < 2.5 && seen_by(in_b, lens, width_px, height_px);
  }
  return known ? double(seen) / double(known) : 0.0;
}

}  // namespace fleetmap
