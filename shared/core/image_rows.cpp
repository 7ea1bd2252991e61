// Equations of calibrations: rows of observations of a pair of images against their landmarks, whitened, and how they change; and sums of
// such rows by one frame.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <cmath>

namespace fleetmap {
namespace {

constexpr double kNearest = 0.05;           // metres ahead of the camera
constexpr double kBehindSigmas = 1000.0;    // residual of a landmark behind it: beyond every cutoff, with zero slope
constexpr size_t kRows = 4, kColumns = 64;  // of an observation; of a calibration, at most

using Poses = Array<double, -1, 4, 4>;
using Rows = Array<double, -1, 4>;
using Turns = Array<double, -1, 2, 2>;
// What is nearly constant near a state: slopes (M, 4, C) and (M, 2, 2, C) of the measured rows and of as_given, rates_map (K, 3), motions
// (K, 9), slopes of right_m by the baseline and its direction, the columns of turn, shift, time offset, focal ratio and those three of the
// baseline, and the focal ratio.
using Slopes =
    std::tuple<Array<double, -1, 4, -1>, Array<double, -1, 2, 2, -1>, Points, Array<double, -1, 9>, Mat3, Array<int64_t, 7>, double>;

struct Pinhole {
  double focal, cx, cy;
  double pixel(int axis, Vec3 point) const { return focal * point[axis] / point[2] + (axis ? cy : cx); }
  Vec3 slope(int axis, Vec3 point) const {
    const double z = std::max(point[2], kNearest), by_place = focal / z;
    return {axis ? 0.0 : by_place, axis ? by_place : 0.0, -focal * point[axis] / (z * z)};
  }
};

struct Observed {
  Vec3 from_body, in_left, in_right;  // in axes of the map, of the cameras
  Mat3 body_from_map, rect_from_map;
  double off[kRows], factor[kRows];
};

// Fills point (4, 3) and calibration (4, C) with an observation's derivatives.
void derive(const Observed& seen, const Pinhole* pair, bool has_right, const double* turn, const Slopes& slopes, size_t n, size_t k,
            double* point, double* calibration) {
  const auto& [by_lens, as_given, rates_map, motions, right_slopes, columns, focal_ratio] = slopes;
  const size_t width = by_lens.shape(2);
  const Vec3 flow = cross(seen.from_body, rates_map.rows()[k]) - vec3(&motions(k, 0));
  double rows[kRows][kColumns];
  Vec3 by_point[kRows];
  for (int row = 0; row < int(kRows); ++row) {
    const int axis = row % 2, first = row - axis;
    double* const out = rows[row];
    std::copy_n(&by_lens(n, row, 0), width, out);
    Vec3 by_cam = first && !has_right ? Vec3{} : pair[0].slope(axis, seen.in_left);
    if (first && has_right) {
      const Vec3 by_right = pair[1].slope(axis, seen.in_right), by_baseline = transposed(right_slopes) * by_right;
      by_cam = by_cam - by_right;
      for (int a = 0; a < 3; ++a) out[columns(size_t(4 + a))] -= by_baseline[a];
    }
    by_point[row] = -(transposed(seen.rect_from_map) * by_cam);
    store(-cross(by_cam, seen.in_left), out + columns(0));  // X <- Exp(-phi) X changes by X x phi
    store(-(seen.body_from_map * by_point[row]), out + columns(1));
    out[columns(2)] = dot(by_point[row], flow);
    if (first) out[columns(3)] += (seen.off[row] - seen.off[axis]) / focal_ratio;
  }
  for (size_t row = 0; row < kRows; ++row) {
    const size_t axis = row % 2, first = row - axis;
    const double factor = seen.factor[row], x = factor * turn[2 * axis], y = factor * turn[2 * axis + 1];
    const double off_x = factor * seen.off[first], off_y = factor * seen.off[first + 1];
    if (factor == 0.0) continue;
    store(x * by_point[first] + y * by_point[first + 1], point + 3 * row);
    const double *by_x = &as_given(n, axis, 0, 0), *by_y = &as_given(n, axis, 1, 0);
    for (size_t c = 0; c < width; ++c)
      calibration[row * width + c] = x * rows[first][c] + y * rows[first + 1][c] + off_x * by_x[c] + off_y * by_y[c];
  }
}

auto image_rows(const Array<double, 4>& lens, const SE3& cam_from_body, const Vec3& right_m, const Poses& map_from_body,
                const Points& points_map, const Numbers& obs_keyframe, const Numbers& obs_landmark, const Rows& measured,
                const Turns& as_given, const Rows& sigmas, const std::optional<Slopes>& slopes) {
  const size_t count = obs_keyframe.shape(0), keyframes = map_from_body.shape(0), width = slopes ? std::get<0>(*slopes).shape(2) : 0;
  check_rows(count, "obs_landmark, measured, as_given, sigmas: one for each of obs_keyframe", obs_landmark, measured, as_given, sigmas);
  check_below(keyframes, "obs_keyframe: keyframes", obs_keyframe);
  check_below(points_map.shape(0), "obs_landmark: landmarks", obs_landmark);
  if (slopes) {
    const auto& [by_lens, by_given, rates_map, motions, right_slopes, columns, focal_ratio] = *slopes;
    check_rows(count, "slopes: of each observation", by_lens, by_given);
    check_rows(keyframes, "rates_map, motions: of each keyframe", rates_map, motions);
    if (width > kColumns || by_given.shape(3) != width) throw nb::value_error("slopes: both by up to 64 columns");
    for (const int64_t column : columns)
      if (column < 0 || size_t(column) + 3 > width) throw nb::value_error("columns: three or more before the last one");
  }
  const size_t derived = slopes ? count : 0;
  auto residuals = zeros<double>(count * kRows), by_point = zeros<double>(derived * kRows * 3),
       by_calibration = zeros<double>(derived * kRows * width);
  const Pinhole pair[] = {{lens(0), lens(2), lens(3)}, {lens(1), lens(2), lens(3)}};
  const bool has_right = norm(right_m) > 0.0;
  unlocked([&] {
    for (size_t n = 0; n < count; ++n) {
      const size_t k = size_t(obs_keyframe(n));
      const SE3 body = se3(&map_from_body(k, 0, 0));
      Observed seen;
      seen.body_from_map = transposed(body.rotation), seen.rect_from_map = cam_from_body.rotation * seen.body_from_map;
      seen.from_body = points_map.rows()[obs_landmark(n)] - body.translation;
      seen.in_left = seen.rect_from_map * seen.from_body + cam_from_body.translation, seen.in_right = seen.in_left - right_m;
      const bool is_ahead = seen.in_left[2] > kNearest;
      for (size_t row = 0; row < kRows; ++row) {
        const bool is_seen = std::isfinite(sigmas(n, row)), is_usable = is_ahead && is_seen;
        const int axis = int(row % 2);
        double expected = row < 2 || has_right ? pair[0].pixel(axis, seen.in_left) : 0.0;
        if (row >= 2 && has_right) expected -= pair[1].pixel(axis, seen.in_right);
        seen.off[row] = is_usable ? measured(n, row) - expected : 0.0;
        seen.factor[row] = is_usable ? 1.0 / sigmas(n, row) : 0.0;
        if (is_seen && !is_ahead) residuals[n * kRows + row] = kBehindSigmas;
      }
      const double* const turn = &as_given(n, 0, 0);
      for (size_t row = 0; is_ahead && row < kRows; ++row) {
        const size_t axis = row % 2, first = row - axis;
        residuals[n * kRows + row] = seen.factor[row] * (turn[2 * axis] * seen.off[first] + turn[2 * axis + 1] * seen.off[first + 1]);
      }
      if (slopes && is_ahead)
        derive(seen, pair, has_right, turn, *slopes, n, k, &by_point[n * kRows * 3], &by_calibration[n * kRows * width]);
    }
  });
  return std::tuple(as_numpy<double, 2>(std::move(residuals), {count, kRows}),
                    as_numpy<double, 3>(std::move(by_point), {derived, kRows, 3}),
                    as_numpy<double, 3>(std::move(by_calibration), {derived, kRows, width}));
}

// Hessian and gradient of a pose, a left perturbation of cam_from_map, of a rig's parameters (8,) and its principal point, by matches whose
// residuals beyond `width` sigmas count less (Source: Geman and McClure 1985). The right camera's focal length, roll and yaw change
// disparities and rows_px, the rows of the right image.
auto camera_equations(const Points& points_map, const Points& pixels, const Places& sigmas_px, const Reals& rows_px, const StereoLens& lens,
                      const SE3& cam_from_map, const Array<double, 8>& parameters, double width) {
  constexpr size_t kUnknowns = 14;
  constexpr double kNearestM = 0.3, kRowSigmaPx = 0.2;
  check_rows(points_map.shape(0), "pixels, sigmas_px, rows_px: one for each point", pixels, sigmas_px, rows_px);
  std::vector<double> hessian(kUnknowns * kUnknowns), gradient(kUnknowns);
  const auto [focal, depth, yaw, right_focal, roll, pitch, centre_u, centre_v] = *reinterpret_cast<const double (*)[8]>(parameters.data());
  const auto robust = [&](double squared) { return std::pow(width * width / (width * width + squared), 2); };
  unlocked([&] {
    for (size_t n = 0; n < points_map.shape(0); ++n) {
      const Vec3 point = cam_from_map * points_map.rows()[n];
      if (!(point[2] > kNearestM)) continue;
      const double near = 1.0 / point[2], f = lens.focal, u = f * point[0] * near, v = f * point[1] * near, d = lens.focal_baseline * near;
      const double right = u - d, across = right * v / f, u_seen = pixels(n, 0), v_seen = pixels(n, 1);
      const double off[kRows] = {(1 + focal) * u + lens.cx + centre_u - u_seen, (1 + focal) * v + lens.cy + centre_v - v_seen,
                                 (1 + focal) * (1 + depth) * d + yaw * (f + right * right / f) - right_focal * right + roll * v -
                                     pitch * across - (u_seen - pixels(n, 2)),
                                 right_focal * v + roll * right + pitch * (f + v * v / f) - yaw * across - rows_px(n)};
      double rows[kRows][kUnknowns] = {{0, 0, 0, 0, 0, 0, u, 0, 0, 0, 0, 0, 1, 0},
                                       {0, 0, 0, 0, 0, 0, v, 0, 0, 0, 0, 0, 0, 1},
                                       {0, 0, 0, 0, 0, 0, d, d, f + right * right / f, -right, v, -across, 0, 0},
                                       {0, 0, 0, 0, 0, 0, 0, 0, -across, v, right, f + v * v / f, 0, 0}};
      const Vec3 by_point[3] = {{f * near, 0.0, -u * near}, {0.0, f * near, -v * near}, {0.0, 0.0, -d * near}};
      for (size_t row = 0; row < 3; ++row) store(cross(point, by_point[row]), rows[row]), store(by_point[row], rows[row] + 3);
      const double scales[kRows] = {1.0 / sigmas_px(n, 0), 1.0 / sigmas_px(n, 0), 1.0 / sigmas_px(n, 1), 1.0 / kRowSigmaPx};
      const auto squared = [&](size_t row) { return off[row] * off[row] * scales[row] * scales[row]; };
      const double of_left = robust(squared(0) + squared(1));
      for (size_t row = 0; row < kRows; ++row) {
        if (!std::isfinite(off[row])) continue;
        const double weight = scales[row] * scales[row] * of_left * (row < 2 ? 1.0 : robust(squared(row)));
        for (size_t a = 0; a < kUnknowns; ++a) {
          gradient[a] -= weight * rows[row][a] * off[row];
          for (size_t b = 0; b < kUnknowns; ++b) hessian[kUnknowns * a + b] += weight * rows[row][a] * rows[row][b];
        }
      }
    }
  });
  return std::tuple(as_numpy<double, 2>(std::move(hessian), {kUnknowns, kUnknowns}), std::move(gradient));
}

}  // namespace

void bind_image_rows(nb::module_& module) {
  module.def("image_rows", &image_rows, "lens"_a, "cam_from_body"_a, "right_m"_a, "map_from_body"_a, "points_map"_a, "obs_keyframe"_a,
             "obs_landmark"_a, "measured"_a, "as_given"_a, "sigmas"_a, "slopes"_a.none());
  module.def("camera_equations", &camera_equations, "points_map"_a, "pixels"_a, "sigmas_px"_a, "rows_px"_a, "lens"_a, "cam_from_map"_a,
             "parameters"_a, "width"_a);
}

}  // namespace fleetmap
