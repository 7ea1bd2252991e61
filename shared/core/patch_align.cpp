// Alignment of patches: a small window of one image in another, to a fraction of a pixel.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <numbers>

#include "dense.h"

namespace fleetmap {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr int kMostPatchHalf = 15;
constexpr int kMostSide = 2 * kMostPatchHalf + 1, kMostCount = kMostSide * kMostSide;
constexpr int kMostIterations = 30;
constexpr double kScale = 1.2;  // from octave to octave
constexpr double kNearM = 1e-6;
constexpr double kSlantSigma = 3.0;  // see align_patch

// Position of the patch in the current image: its standard deviation comes from the residual and the window's gradients in the weaker
// direction. All NaN where alignment fails.
struct Alignment {
  double x = kNaN, y = kNaN, sigma_px = kNaN, correlation = kNaN;
};

struct PatchLimits {
  int half;  // patches have 2 half + 1 pixels
  double max_shift_px, min_correlation;
  PatchLimits(int half, double max_shift_px, double min_correlation)
      : half(half), max_shift_px(max_shift_px), min_correlation(min_correlation) {
    if (half < 1 || half > kMostPatchHalf) throw nb::value_error("half: 1 to 15");
  }
};

// Offsets in the reference image of offsets in the current one, on a surface that faces the camera. On one whose inverse depth changes
// along the current offset (u, v), relative to itself by s and t in a unit of normalised coordinates, a pixel lies (s u + t v) (slant_x,
// slant_y) aside of that; these are 0 where the motion is not known.
struct Warp {
  double xx, xy, slant_x, yx, yy, slant_y;
};

// The level of the pyramid nearest to the scale of an octave.
int halvings(int octave) { return int(std::clamp(std::nearbyint(octave * std::log2(kScale)), 0.0, 2.0)); }

double sample(GreyImage image, double x, double y) {
  const ptrdiff_t column = ptrdiff_t(x), row = ptrdiff_t(y);
  const double a = x - double(column), b = y - double(row);
  const uint8_t *upper = image.row(row) + column, *lower = upper + image.width;
  return (1.0 - b) * ((1.0 - a) * upper[0] + a * upper[1]) + b * ((1.0 - a) * lower[0] + a * lower[1]);
}

// Where a patch lies in the current image, with the slants of its surface.
struct Place {
  double x, y, s = 0.0, t = 0.0;
  double reach(const Warp& warp, int half) const {
    return half * (1.0 + std::max(std::abs(warp.slant_x), std::abs(warp.slant_y)) * (std::abs(s) + std::abs(t)));
  }
};

// Brightness at a patch's pixels, and its sum. All must lie inside.
double sample(GreyImage image, const Place& place, const Warp& warp, int half, double* __restrict samples) {
  double total = 0.0;
  for (int v = -half; v <= half; ++v)
    for (int u = -half; u <= half; ++u, ++samples) {
      const double aside = place.s * u + place.t * v;
      *samples = sample(image, place.x + u + warp.slant_x * aside, place.y + v + warp.slant_y * aside);
      total += *samples;
    }
  return total;
}

// The reference's window less its mean, and its slopes by place and slants without what offset and gain explain.
struct Template {
  double grey[kMostCount], slopes[kMostCount][4];
  double products[4][4] = {};       // of the slopes, lower triangle
  double weak = 0.0, energy = 0.0;  // smaller eigenvalue of the gradients' matrix; variance of grey

  Template(GreyImage reference, double rx, double ry, const Warp& warp, int half) {
    const int side = 2 * half + 1, stride = side + 2;
    double wide[(kMostSide + 2) * (kMostSide + 2)];
    for (int v = 0; v < stride; ++v)
      for (int u = 0; u < stride; ++u) {
        const double du = u - half - 1.0, dv = v - half - 1.0;
        wide[v * stride + u] = sample(reference, rx + warp.xx * du + warp.xy * dv, ry + warp.yx * du + warp.yy * dv);
      }
    double mean = 0.0;
    for (int v = 1; v <= side; ++v)
      for (int u = 1; u <= side; ++u) mean += wide[v * stride + u];
    mean /= side * side;
    double sums[4] = {}, along[4] = {}, xx = 0.0, xy = 0.0, yy = 0.0;
    for (int v = 0, n = 0; v < side; ++v)
      for (int u = 0; u < side; ++u, ++n) {
        const double* at = wide + (v + 1) * stride + u + 1;
        const double right = 0.5 * (at[1] - at[-1]), down = 0.5 * (at[stride] - at[-stride]);
        const double aside = warp.slant_x * right + warp.slant_y * down;
        const double slope[4] = {right, down, aside * (u - half), aside * (v - half)};
        std::copy_n(slope, 4, slopes[n]);
        xx += right * right, xy += right * down, yy += down * down;
        grey[n] = at[0] - mean;
        energy += grey[n] * grey[n];
        for (int i = 0; i < 4; ++i) sums[i] += slope[i], along[i] += slope[i] * grey[n];
      }
    weak = 0.5 * (xx + yy) - std::hypot(0.5 * (xx - yy), xy);
    for (int n = 0; n < side * side; ++n) {
      for (int i = 0; i < 4; ++i) slopes[n][i] -= sums[i] / (side * side) + along[i] / std::max(energy, 1e-9) * grey[n];
      for (int i = 0; i < 4; ++i)
        for (int k = 0; k <= i; ++k) products[i][k] += slopes[n][i] * slopes[n][k];
    }
  }
};

// Moves (x, y) of the current image, and the slants s and t of the surface, until the reference's window around (rx, ry), warped, lies on
// it.
//
// With T the warped window less its mean, I the current one less its own, T' = slant_x Tx + slant_y Ty, and J = (Tx, Ty, T' u, T' v) less
// what an offset and T explain of it, each step solves
//   (sum J^T J + diag(0, 0, p, p)) d = sum J^T (g I - T) + p (0, 0, s, t),   g = sum I T / sum I I,   p = (sum (g I - T)^2 / A + 4) / 3^2
// and goes to (x, y, s, t) - d. p holds the slants near 0: their standard deviation 3 is the cotangent of the 18 degrees at which a
// surface is seen, A the number of pixels, and 4 the variance of two pixels' own noise. A wall along the motion, taken to face the
// camera, would draw (x, y) towards its place in the reference.
// Inverse compositional, with free offset and gain. Sources: Baker and Matthews 2004; Shi and Tomasi 1994 for windows that deform.
Alignment align_patch(GreyImage reference, GreyImage current, double rx, double ry, double x, double y, const Warp& warp,
                      const PatchLimits& limits) {
  const int half = limits.half, count = (2 * half + 1) * (2 * half + 1);
  const double across = std::abs(warp.xx) + std::abs(warp.xy), down = std::abs(warp.yx) + std::abs(warp.yy);
  const double rim = (half + 1) * std::max(across, down) + 1.0;
  if (!(rim < rx && rx < double(reference.width) - rim - 2.0 && rim < ry && ry < double(reference.height) - rim - 2.0)) return {};
  if (!std::isfinite(across + down + warp.slant_x + warp.slant_y)) return {};
  const Template patch(reference, rx, ry, warp, half);
  if (patch.weak < 5.0 * count || patch.energy < 1.0) return {};
  Place place{x, y};
  double seen[kMostCount];
  for (int iteration = 0; iteration < kMostIterations; ++iteration) {
    const double reach = place.reach(warp, half);
    if (!(reach + 1 < place.x && place.x < double(current.width) - reach - 3)) return {};
    if (!(reach + 1 < place.y && place.y < double(current.height) - reach - 3)) return {};
    const double mean = sample(current, place, warp, half, seen) / count;
    double cross = 0.0, power = 0.0;
    for (int n = 0; n < count; ++n) {
      seen[n] -= mean;
      cross += seen[n] * patch.grey[n];
      power += seen[n] * seen[n];
    }
    if (power < 1.0 || cross <= 0.0) return {};
    const double gain = cross / power;
    double step[4] = {}, squared = 0.0;
    for (int n = 0; n < count; ++n) {
      const double off = gain * seen[n] - patch.grey[n];
      for (int i = 0; i < 4; ++i) step[i] += patch.slopes[n][i] * off;
      squared += off * off;
    }
    const double noise = squared / count + 4.0, prior = noise / (kSlantSigma * kSlantSigma);
    double lower[4][4];
    std::memcpy(lower, patch.products, sizeof lower);
    lower[2][2] += prior, lower[3][3] += prior;
    step[2] += prior * place.s, step[3] += prior * place.t;
    if (!cholesky_in_place(lower[0], 4, 4)) return {};
    forward_substitute(lower[0], step, 4, 4);
    back_substitute(lower[0], step, 4, 4);
    place = {place.x - step[0], place.y - step[1], place.s - step[2], place.t - step[3]};
    if (!(std::abs(place.x - x) <= limits.max_shift_px && std::abs(place.y - y) <= limits.max_shift_px)) return {};
    if (step[0] * step[0] + step[1] * step[1] < 1e-4)
      return {place.x, place.y, std::sqrt(noise / patch.weak), cross / std::sqrt(power * patch.energy)};
  }
  return {};
}

using Pyramid = std::tuple<Image, Image, Image>;
using Octaves = Array<int8_t, -1>;

// Features of an image, whole, halved and quartered; pixels (M, 2) in the whole one, where the scale of octave k is 1.2^k.
struct PatchFeatures {
  GreyImage pyramid[3];
  const double* pixels;
  const int8_t* octaves;

  PatchFeatures(const Pyramid& images, const Places& places, const Octaves& of)
      : pyramid{std::get<0>(images), std::get<1>(images), std::get<2>(images)}, pixels(places.data()), octaves(of.data()) {
    check_rows(places.shape(0), "octaves: one for each pixel", of);
  }
};

// align_patch of feature i of the reference and feature j of the current image, each on the halving nearest to its scale. The warp and
// the result are for the whole images; NaN below min_correlation.
Alignment align_feature(const PatchFeatures& reference, int64_t i, const PatchFeatures& current, int64_t j, Warp warp,
                        const PatchLimits& limits) {
  const int level = halvings(reference.octaves[i]), current_level = halvings(current.octaves[j]);
  const double size = 1 << level, current_size = 1 << current_level, ratio = current_size / size;
  warp = {ratio * warp.xx, ratio * warp.xy, warp.slant_x, ratio * warp.yx, ratio * warp.yy, warp.slant_y};
  const double *a = reference.pixels + 2 * i, *b = current.pixels + 2 * j;
  const Alignment found = align_patch(reference.pyramid[level], current.pyramid[current_level], a[0] / size, a[1] / size,
                                      b[0] / current_size, b[1] / current_size, warp, limits);
  if (!(found.correlation >= limits.min_correlation)) return {};
  return {found.x * current_size, found.y * current_size, found.sigma_px * current_size, found.correlation};
}

// The warp around a point of the reference camera; none where it is degenerate.
std::optional<Warp> warp_from_motion(Vec3 point, const SE3& current_from_reference) {
  if (!(point[2] > kNearM)) return {};
  constexpr double kStep = 0.01;  // of the depth, to the right and below
  double seen[3][2];
  for (int k = 0; k < 3; ++k) {
    Vec3 moved = point;
    if (k > 0) moved[k - 1] += kStep * point[2];
    moved = current_from_reference * moved;
    if (!(moved[2] > kNearM)) return {};
    seen[k][0] = moved[0] / moved[2], seen[k][1] = moved[1] / moved[2];
  }
  // current_from_reference of offsets, whose inverse is sought
  const Vec3 origin = current_from_reference.translation;
  const double depth = (current_from_reference * point)[2];
  const double slant_x = (origin[0] - seen[0][0] * origin[2]) / depth, slant_y = (origin[1] - seen[0][1] * origin[2]) / depth;
  const double a = (seen[1][0] - seen[0][0]) / kStep, b = (seen[2][0] - seen[0][0]) / kStep;
  const double c = (seen[1][1] - seen[0][1]) / kStep, d = (seen[2][1] - seen[0][1]) / kStep;
  const double determinant = a * d - b * c;
  if (!(0.02 < std::abs(determinant) && std::abs(determinant) < 50.0)) return {};
  return Warp{d / determinant, -b / determinant, slant_x, -c / determinant, a / determinant, slant_y};
}

// The warp between two features, by octaves and orientations.
Warp warp_from_features(int octave_reference, double angle_reference_deg, int octave_current, double angle_current_deg) {
  const double scale = std::pow(kScale, double(octave_reference - octave_current));
  const double angle = (angle_reference_deg - angle_current_deg) * (std::numbers::pi / 180.0);
  const double cosine = scale * std::cos(angle), sine = scale * std::sin(angle);
  return {cosine, -sine, 0.0, sine, cosine, 0.0};
}

// Those of an image: pyramid, pixels (M, 2), octaves (M,), angles in degrees (M,), and the chosen ones (N,).
using Features = std::tuple<Pyramid, Places, Octaves, Array<float, -1>, Indices>;

// Places (N, 3) x, y, sigma_px in the own image; the warps are those of the motion, or of octaves and angles where it is degenerate.
auto align_features(const Features& reference, const Features& own, const Points& points_reference, const SE3& own_from_reference, int half,
                    double max_shift_px, double min_correlation) {
  const PatchLimits limits(half, max_shift_px, min_correlation);
  const auto& [pyramid_a, pixels_a, octaves_a, angles_a, chosen_a] = reference;
  const auto& [pyramid_b, pixels_b, octaves_b, angles_b, chosen_b] = own;
  const PatchFeatures a(pyramid_a, pixels_a, octaves_a), b(pyramid_b, pixels_b, octaves_b);
  const size_t count = chosen_b.shape(0);
  if (angles_a.shape(0) != pixels_a.shape(0) || angles_b.shape(0) != pixels_b.shape(0)) throw nb::value_error("angles: one for each pixel");
  check_rows(count, "points_reference: one for each chosen", chosen_a, points_reference);
  check_below(pixels_a.shape(0), "chosen: indices of pixels", chosen_a);
  check_below(pixels_b.shape(0), "chosen: indices of pixels", chosen_b);
  std::vector<std::array<double, 3>> found(count);
  unlocked([&] {
    for (size_t n = 0; n < count; ++n) {
      const int64_t i = chosen_a(n), j = chosen_b(n);
      // finer than octaves and angles
      const auto by_motion = warp_from_motion(vec3(&points_reference(n, 0)), own_from_reference);
      const Warp warp =
          by_motion ? *by_motion : warp_from_features(octaves_a(size_t(i)), angles_a(size_t(i)), octaves_b(size_t(j)), angles_b(size_t(j)));
      const Alignment at = align_feature(a, i, b, j, warp, limits);
      found[n] = {at.x, at.y, at.sigma_px};
    }
  });
  return found;
}

}  // namespace

void bind_patch_align(nb::module_& module) {
  module.def("align_features", &align_features, "reference"_a, "own"_a, "points_reference"_a, "own_from_reference"_a, "half"_a,
             "max_shift_px"_a, "min_correlation"_a);
}

}  // namespace fleetmap
