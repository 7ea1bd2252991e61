#include "patch_align.h"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace fleetmap {
namespace {

constexpr int kMostSide = 2 * kMostPatchHalf + 1, kMostCount = kMostSide * kMostSide;
constexpr int kMostIterations = 15;
constexpr double kScale = 1.2;  // from octave to octave
constexpr double kNearM = 1e-6;

// The level of the pyramid nearest to the scale of an octave.
int halvings(int octave) { return int(std::clamp(std::nearbyint(octave * std::log2(kScale)), 0.0, 2.0)); }

double sample(GreyImage image, double x, double y) {
  const ptrdiff_t column = ptrdiff_t(x), row = ptrdiff_t(y);
  const double a = x - double(column), b = y - double(row);
  const uint8_t *upper = image.row(row) + column, *lower = upper + image.width;
  return (1.0 - b) * ((1.0 - a) * upper[0] + a * upper[1]) + b * ((1.0 - a) * lower[0] + a * lower[1]);
}

// Pixels around (x, y), whole steps apart, and their sum. All must lie inside.
double sample_upright(GreyImage image, double x, double y, int half, double* samples) {
  const ptrdiff_t column = ptrdiff_t(x), row = ptrdiff_t(y);
  const Bilinear<double> at(x - double(column), y - double(row));
  const int side = 2 * half + 1;
  for (int v = 0; v < side; ++v) {
    const uint8_t *upper = image.row(row - half + v) + column - half, *lower = upper + image.width;
    double* __restrict out = samples + v * side;
    for (int u = 0; u < side; ++u) out[u] = at(upper + u, lower + u);
  }
  double total = 0.0;
  for (int n = 0; n < side * side; ++n) total += samples[n];
  return total;
}

// The reference's window less its mean, its slopes, and their sums.
struct Template {
  double grey[kMostCount], right[kMostCount], down[kMostCount];
  double xx = 0.0, xy = 0.0, yy = 0.0, energy = 0.0;

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
    for (int v = 0; v < side; ++v)
      for (int u = 0; u < side; ++u) {
        const double* at = wide + (v + 1) * stride + u + 1;
        const int n = v * side + u;
        right[n] = 0.5 * (at[1] - at[-1]);
        down[n] = 0.5 * (at[stride] - at[-stride]);
        grey[n] = at[0] - mean;
      }
    for (int n = 0; n < side * side; ++n) {
      xx += right[n] * right[n];
      xy += right[n] * down[n];
      yy += down[n] * down[n];
      energy += grey[n] * grey[n];
    }
  }
};

}  // namespace

Alignment align_patch(GreyImage reference, GreyImage current, double rx, double ry, double x, double y, const Warp& warp,
                      const PatchLimits& limits) {
  const int half = limits.half, count = (2 * half + 1) * (2 * half + 1);
  const double across = std::abs(warp.xx) + std::abs(warp.xy), down = std::abs(warp.yx) + std::abs(warp.yy);
  const double reach = (half + 1) * std::max(across, down) + 1.0;
  if (!(reach < rx && rx < double(reference.width) - reach - 2.0 && reach < ry && ry < double(reference.height) - reach - 2.0)) return {};
  if (!std::isfinite(across + down)) return {};
  const Template patch(reference, rx, ry, warp, half);
  const double determinant = patch.xx * patch.yy - patch.xy * patch.xy, trace = patch.xx + patch.yy;
  const double weak = 0.5 * trace - std::sqrt(std::max(0.25 * trace * trace - determinant, 0.0));
  if (weak < 5.0 * count || patch.energy < 1.0) return {};
  const double start_x = x, start_y = y;
  double seen[kMostCount];
  for (int iteration = 0; iteration < kMostIterations; ++iteration) {
    if (!(half + 1 < x && x < double(current.width - half - 3) && half + 1 < y && y < double(current.height - half - 3))) return {};
    const double mean = sample_upright(current, x, y, half, seen) / count;
    double cross = 0.0, power = 0.0;
    for (int n = 0; n < count; ++n) {
      seen[n] -= mean;
      cross += seen[n] * patch.grey[n];
      power += seen[n] * seen[n];
    }
    if (power < 1.0 || cross <= 0.0) return {};
    const double gain = cross / power;
    double bx = 0.0, by = 0.0, squared = 0.0;
    for (int n = 0; n < count; ++n) {
      const double off = gain * seen[n] - patch.grey[n];
      bx += patch.right[n] * off;
      by += patch.down[n] * off;
      squared += off * off;
    }
    const double dx = (patch.yy * bx - patch.xy * by) / determinant, dy = (patch.xx * by - patch.xy * bx) / determinant;
    x -= dx, y -= dy;
    if (std::abs(x - start_x) > limits.max_shift_px || std::abs(y - start_y) > limits.max_shift_px) return {};
    if (dx * dx + dy * dy < 1e-4) return {x, y, std::sqrt((squared / count + 4.0) / weak), cross / std::sqrt(power * patch.energy)};
  }
  return {};
}

Alignment align_feature(const PatchFeatures& reference, int64_t i, const PatchFeatures& current, int64_t j, Warp warp,
                        const PatchLimits& limits) {
  const int level = halvings(reference.octaves[i]), current_level = halvings(current.octaves[j]);
  const double size = 1 << level, current_size = 1 << current_level, ratio = current_size / size;
  warp = {ratio * warp.xx, ratio * warp.xy, ratio * warp.yx, ratio * warp.yy};
  const double *a = reference.pixels + 2 * i, *b = current.pixels + 2 * j;
  const Alignment found = align_patch(reference.pyramid[level], current.pyramid[current_level], a[0] / size, a[1] / size,
                                      b[0] / current_size, b[1] / current_size, warp, limits);
  if (!(found.correlation >= limits.min_correlation)) return {};
  return {found.x * current_size, found.y * current_size, found.sigma_px * current_size, found.correlation};
}

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
  const double a = (seen[1][0] - seen[0][0]) / kStep, b = (seen[2][0] - seen[0][0]) / kStep;
  const double c = (seen[1][1] - seen[0][1]) / kStep, d = (seen[2][1] - seen[0][1]) / kStep;
  const double determinant = a * d - b * c;
  if (!(0.02 < std::abs(determinant) && std::abs(determinant) < 50.0)) return {};
  return Warp{d / determinant, -b / determinant, -c / determinant, a / determinant};
}

Warp warp_from_features(int octave_reference, double angle_reference_deg, int octave_current, double angle_current_deg) {
  const double scale = std::pow(kScale, double(octave_reference - octave_current));
  const double angle = (angle_reference_deg - angle_current_deg) * (std::numbers::pi / 180.0);
  const double cosine = scale * std::cos(angle), sine = scale * std::sin(angle);
  return {cosine, -sine, sine, cosine};
}

}  // namespace fleetmap
