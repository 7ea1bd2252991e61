#include "bindings/arguments.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>

namespace fleetmap {
namespace {

constexpr double kNearZero = 1e-9;
constexpr double kNearest = 0.05;  // metres before the camera

// Points and their measured pixels by column, so that wide registers project several at once.
struct Columns {
  std::vector<double> x, y, z, u, v;

  explicit Columns(const Sightings& seen) : x(seen.count), y(seen.count), z(seen.count), u(seen.count), v(seen.count) {
    for (size_t n = 0; n < seen.count; ++n) {
      const Vec3 point = seen.points[n], pixel = seen.pixels[n];
      x[n] = point[0], y[n] = point[1], z[n] = point[2], u[n] = pixel[0], v[n] = pixel[1];
    }
  }
};

// How many points a camera sees within the threshold of their pixels; 0 where that cannot be more than `least`.
size_t votes(const Columns& columns, const SE3& camera, const StereoLens& lens, double threshold_px, size_t least) {
  constexpr size_t kBlock = 64;
  const Mat3& r = camera.rotation;
  const Vec3 t = camera.translation;
  const size_t size = columns.x.size();
  size_t count = 0;
  for (size_t begin = 0; begin < size; begin += kBlock) {
    const size_t end = std::min(begin + kBlock, size);
    int64_t near = 0;
    for (size_t n = begin; n < end; ++n) {
      const double x = columns.x[n], y = columns.y[n], z = columns.z[n];
      const double depth = r[2][0] * x + r[2][1] * y + r[2][2] * z + t[2];
      const double du = lens.focal * (r[0][0] * x + r[0][1] * y + r[0][2] * z + t[0]) / depth + lens.cx - columns.u[n];
      const double dv = lens.focal * (r[1][0] * x + r[1][1] * y + r[1][2] * z + t[1]) / depth + lens.cy - columns.v[n];
      near += int64_t(depth > kNearest) & int64_t(du * du + dv * dv < threshold_px * threshold_px);
    }
    count += size_t(near);
    if (count + size - end <= least) return 0;
  }
  return count;
}

// Fills the real roots of a x^4 + b x^3 + c x^2 + d x + e and returns their number; rounding may miss double ones.
// Source: Ferrari's method by the largest root of the resolvent cubic, then Newton's.
int real_roots(double a, double b, double c, double d, double e, double (&roots)[4]) {
  if (std::abs(a) < 1e-12 * (std::abs(b) + std::abs(c) + std::abs(d) + std::abs(e))) return 0;
  b /= a, c /= a, d /= a, e /= a;
  // Without the cubic term: y^4 + p y^2 + q y + r for y = x + shift.
  const double shift = 0.25 * b, shift2 = shift * shift;
  const double p = c - 6.0 * shift * shift;
  const double q = d - 2.0 * c * shift + 8.0 * (shift * shift2);
  const double r = e - d * shift + c * shift * shift - 3.0 * (shift2 * shift2);
  // 8 m^3 + 8 p m^2 + (2 p^2 - 8 r) m - q^2 = 0, whose largest root is not negative. By Cardano, or by angles.
  const double third = p / 3.0, linear = 0.25 * p * p - r, constant = -0.125 * q * q;
  const double s = linear / 3.0 - third * third, t = third * third * third - 0.5 * third * linear + 0.5 * constant;
  const double discriminant = s * s * s + t * t;
  double m;
  if (discriminant > 0.0) {
    const double side = std::sqrt(discriminant);
    m = std::cbrt(-t + side) + std::cbrt(-t - side) - third;
  } else {
    const double angle = std::acos(std::clamp(-t / std::sqrt(std::max(-(s * s * s), 1e-300)), -1.0, 1.0));
    m = 2.0 * std::sqrt(std::max(-s, 0.0)) * std::cos(angle / 3.0) - third;
  }
  int count = 0;
  if (m <= 1e-14 * (std::abs(p) + std::sqrt(std::abs(r)))) {  // q is 0: a quadratic of y^2
    const double inner = p * p - 4.0 * r;
    if (inner < 0.0) return 0;
    for (const double sign : {-1.0, 1.0}) {
      const double squared = 0.5 * (-p + sign * std::sqrt(inner));
      if (!(squared >= 0.0)) continue;
      roots[count++] = std::sqrt(squared) - shift;
      roots[count++] = -std::sqrt(squared) - shift;
    }
  } else {
    const double half = std::sqrt(2.0 * m);
    for (const double sign : {-1.0, 1.0}) {
      const double inner = -(2.0 * p + 2.0 * m + sign * 2.0 * q / half);
      if (!(inner >= 0.0)) continue;
      roots[count++] = 0.5 * (sign * half + std::sqrt(inner)) - shift;
      roots[count++] = 0.5 * (sign * half - std::sqrt(inner)) - shift;
    }
  }
  for (int k = 0; k < count; ++k)
    for (int step = 0; step < 2; ++step) {
      const double x = roots[k], slope = ((4.0 * x + 3.0 * b) * x + 2.0 * c) * x + d;
      if (slope != 0.0) roots[k] = x - ((((x + b) * x + c) * x + d) * x + e) / slope;
    }
  return count;
}

// The axes, in columns, defined by three points; false if they are collinear.
bool axes_of(const Vec3 (&points)[3], Mat3& axes) {
  const Vec3 along = points[1] - points[0], other = points[2] - points[0], normal = cross(along, other);
  const double length = norm(along), height = norm(normal);
  if (!(height > 1e-4 * length * norm(other))) return false;
  const Vec3 x = along / length, z = normal / height, y = cross(z, x);
  axes = {{{x[0], y[0], z[0]}, {x[1], y[1], z[1]}, {x[2], y[2], z[2]}}};
  return true;
}

// Fills the cameras that see three points along unit rays of theirs and returns their number.
int three_point(const Vec3 (&points)[3], const Vec3 (&rays)[3], SE3 (&cameras)[4]) {
  Mat3 source, axes;
  if (!axes_of(points, source)) return 0;
  double squares[3], cosines[3];  // of the sides across from the first point, the second, the third
  for (int k = 0; k < 3; ++k) {
    const int i = (k + 1) % 3, j = (k + 2) % 3;
    const Vec3 side = points[i] - points[j];
    squares[k] = dot(side, side), cosines[k] = dot(rays[i], rays[j]);
  }
  const double ca = cosines[0], cb = cosines[1], cg = cosines[2];
  const double aa = squares[0] / squares[1], cc = squares[2] / squares[1], d = aa - cc, s = aa + cc;
  // Distances of the points: first, u first, v first.
  double roots[4];
  const int found = real_roots(
      (d - 1.0) * (d - 1.0) - 4.0 * cc * ca * ca, 4.0 * (d * (1.0 - d) * cb - (1.0 - s) * ca * cg + 2.0 * cc * ca * ca * cb),
      2.0 * (d * d - 1.0 + 2.0 * d * d * cb * cb + 2.0 * (1.0 - cc) * ca * ca - 4.0 * s * ca * cb * cg + 2.0 * (1.0 - aa) * cg * cg),
      4.0 * (-d * (1.0 + d) * cb + 2.0 * aa * cg * cg * cb - (1.0 - s) * ca * cg), (1.0 + d) * (1.0 + d) - 4.0 * aa * cg * cg, roots);
  int count = 0;
  for (int k = 0; k < found; ++k) {
    const double v = roots[k], below = 2.0 * (cg - v * ca);
    if (!(v > 0.0) || std::abs(below) < kNearZero) continue;
    const double u = ((d - 1.0) * v * v - 2.0 * d * cb * v + 1.0 + d) / below, spread = 1.0 + v * v - 2.0 * v * cb;
    if (!(u > 0.0) || !(spread >= kNearZero)) continue;
    const double first = std::sqrt(squares[1] / spread);
    if (!axes_of({first * rays[0], first * u * rays[1], first * v * rays[2]}, axes)) continue;
    SE3& camera = cameras[count++];
    camera.rotation = axes * transposed(source);
    camera.translation = first * rays[0];
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) camera.translation[a] -= camera.rotation[a][b] * points[0][b];
  }
  return count;
}

// Three different indices under `size` of three numbers in [0, 1).
struct Three {
  size_t i, j, k;

  Three(Vec3 draw, size_t size)
      : i(size_t(draw[0] * double(size))), j(size_t(draw[1] * double(size - 1))), k(size_t(draw[2] * double(size - 2))) {
    if (j >= i) ++j;
    if (k >= std::min(i, j)) ++k;
    if (k >= std::max(i, j)) ++k;
  }
};

// Refinement by the points that a start sees near their pixels, then by all.
std::optional<Resection> refine_from(const SE3& start, const Sightings& seen, const StereoLens& lens, const Refinement& refinement,
                                     const Mat6& prior, const Agreement& agreement) {
  ChosenSightings near;
  for (size_t n = 0; n < seen.count; ++n) {
    const Vec3 point = start * seen.points[n], pixel = seen.pixels[n];
    const double z = point[2];
    const double du = lens.focal * point[0] / z + lens.cx - pixel[0], dv = lens.focal * point[1] / z + lens.cy - pixel[1];
    if (z > 1e-6 && std::sqrt(du * du + dv * dv) < agreement.threshold_px) near.add(seen, n);
  }
  if (near.points.empty()) return {};
  auto found = refine_pnp(near.all(), lens, refinement, prior, start);
  if (found) found = refine_pnp(seen, lens, refinement, prior, found->cam_from_source);
  if (!found) return {};
  const auto is_inlier = [&](double e2) { return e2 < refinement.gate_squared; };
  return size_t(std::count_if(found->squared.begin(), found->squared.end(), is_inlier)) < agreement.min_inliers ? std::nullopt : found;
}

}  // namespace

std::optional<Resection> ransac_pnp(const Sightings& seen, const StereoLens& lens, const Refinement& refinement, const Agreement& agreement,
                                    const Vec3* draws, size_t draw_count, double confidence) {
  const size_t size = seen.count;
  if (size < std::max<size_t>(agreement.min_inliers, 4)) return {};
  const Columns columns(seen);
  std::vector<Vec3> rays(size);
  for (size_t n = 0; n < size; ++n) {
    const double x = (columns.u[n] - lens.cx) / lens.focal, y = (columns.v[n] - lens.cy) / lens.focal;
    const double length = std::sqrt(x * x + y * y + 1.0);
    rays[n] = {x / length, y / length, 1.0 / length};
  }
  size_t best = 0;
  SE3 best_camera{}, cameras[4];
  double needed = double(draw_count);
  for (size_t tried = 0; double(tried) < needed; ++tried) {
    const auto [i, j, k] = Three(draws[tried], size);
    const int proposed = three_point({seen.points[i], seen.points[j], seen.points[k]}, {rays[i], rays[j], rays[k]}, cameras);
    for (int m = 0; m < proposed; ++m) {
      const size_t count = votes(columns, cameras[m], lens, agreement.threshold_px, best);
      if (count <= best) continue;
      best = count, best_camera = cameras[m];
      const double share = double(best) / double(size), miss = 1.0 - share * share * share;
      needed = miss <= 0.0 ? 0.0 : std::min(needed, std::log(1.0 - confidence) / std::log(miss));
    }
  }
  if (best < std::max<size_t>(agreement.min_inliers, 1)) return {};
  return refine_from(best_camera, seen, lens, refinement, {}, agreement);
}

namespace {

// As ransac_pnp where the rotation is nearly known: each point whose depth the camera's stereo measured proposes a translation. Finds the
// camera among far more wrong matches than three points can.
std::optional<Resection> with_rotation(const Sightings& seen, const StereoLens& lens, const Refinement& refinement,
                                       const Agreement& agreement, const Mat3& rotation, double rotation_sigma_rad) {
  if (seen.count < agreement.min_inliers) return {};
  Columns columns(seen);  // of the points turned into the camera's axes
  for (size_t n = 0; n < seen.count; ++n) {
    const Vec3 turned = rotation * seen.points[n];
    columns.x[n] = turned[0], columns.y[n] = turned[1], columns.z[n] = turned[2];
  }
  size_t best = 0;
  SE3 best_camera{rotation, {}};
  for (size_t k = 0; k < seen.count; ++k) {
    const Vec3 pixel = seen.pixels[k];
    const double depth = lens.focal_baseline / (pixel[0] - pixel[2]);
    if (std::isnan(depth)) continue;
    const Vec3 own{(pixel[0] - lens.cx) * depth / lens.focal, (pixel[1] - lens.cy) * depth / lens.focal, depth};
    const Vec3 translation = own - Vec3{columns.x[k], columns.y[k], columns.z[k]};
    const size_t count = votes(columns, {kIdentity, translation}, lens, agreement.threshold_px, best);
    if (count > best) best = count, best_camera.translation = translation;
  }
  if (best < agreement.min_inliers) return {};
  Mat6 prior = {};
  for (int a = 0; a < 3; ++a) prior[a][a] = 1.0 / (rotation_sigma_rad * rotation_sigma_rad);
  return refine_from(best_camera, seen, lens, refinement, prior, agreement);
}

Agreement agreement_of(double threshold_px, int min_inliers) { return {threshold_px, size_t(std::max(min_inliers, 0))}; }

using Result = std::optional<std::tuple<SE3, Mat6, std::vector<double>>>;

Result result_of(std::optional<Resection>&& found) {
  if (!found) return {};
  return {{found->cam_from_source, found->information, std::move(found->squared)}};
}

Result refine_pnp_of(const Points& points, const Points& pixels, const Places& weights, const StereoLens& lens, const Limits& refinement,
                     const SE3& cam_from_source, const std::optional<Mat6>& prior) {
  const Sightings seen = sightings_of(points, pixels, weights);
  const Refinement limits = refinement_of(refinement);
  return result_of(unlocked([&] { return refine_pnp(seen, lens, limits, prior.value_or(Mat6{}), cam_from_source); }));
}

Result ransac_pnp_of(const Points& points, const Points& pixels, const Places& weights, const StereoLens& lens, const Limits& refinement,
                     double threshold_px, int min_inliers, const Points& draws, double confidence) {
  const Sightings seen = sightings_of(points, pixels, weights);
  if (!std::all_of(draws.begin(), draws.end(), [](double draw) { return draw >= 0.0 && draw < 1.0; }))
    throw nb::value_error("draws: from 0 to below 1");
  const Refinement limits = refinement_of(refinement);
  return result_of(unlocked(
      [&] { return ransac_pnp(seen, lens, limits, agreement_of(threshold_px, min_inliers), draws.rows(), draws.shape(0), confidence); }));
}

Result pnp_with_rotation_of(const Points& points, const Points& pixels, const Places& weights, const StereoLens& lens,
                            const Limits& refinement, double threshold_px, int min_inliers, const Mat3& rotation,
                            double rotation_sigma_rad) {
  const Sightings seen = sightings_of(points, pixels, weights);
  const Refinement limits = refinement_of(refinement);
  return result_of(
      unlocked([&] { return with_rotation(seen, lens, limits, agreement_of(threshold_px, min_inliers), rotation, rotation_sigma_rad); }));
}

}  // namespace

void bind_pnp(nb::module_& module) {
  module.def("refine_pnp", &refine_pnp_of, "points"_a, "pixels"_a, "weights"_a, "lens"_a, "refinement"_a, "cam_from_source"_a, "prior"_a);
  module.def("ransac_pnp", &ransac_pnp_of, "points"_a, "pixels"_a, "weights"_a, "lens"_a, "refinement"_a, "threshold_px"_a, "min_inliers"_a,
             "draws"_a, "confidence"_a);
  module.def("pnp_with_rotation", &pnp_with_rotation_of, "points"_a, "pixels"_a, "weights"_a, "lens"_a, "refinement"_a, "threshold_px"_a,
             "min_inliers"_a, "rotation"_a, "rotation_sigma_rad"_a);
}

}  // namespace fleetmap
