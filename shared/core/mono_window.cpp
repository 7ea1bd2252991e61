// Bundle adjustment of a small window of one camera's views: dense, for about ten views and a few hundred points.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>

#include "dense.h"

namespace fleetmap {
namespace {

constexpr double kNearest = 1e-3;

// Views are map_from_cam. Observations of point n are those from starts[n] to starts[n + 1]: the view, and the pixel (u, v).
struct MonoWindow {
  std::vector<SE3> views;
  std::vector<int64_t> slots;  // of each view among the free ones, -1 for one that stays
  std::vector<Vec3> points;
  const int64_t* starts;
  const int64_t* observers;
  const double* pixels;
  StereoLens lens;
  double sigma_px, huber_sigmas;
};

// A point in a view, and the derivatives of its pixel by the view and by the point.
struct Projection {
  double pixel[2], by_view[2][6];
  Vec3 by_point[2];
};

// False behind the camera.
bool project(const MonoWindow& window, const SE3& view, Vec3 point, Projection& out) {
  const Mat3& rotation = view.rotation;
  const Vec3 away = point - view.translation, y = transposed(rotation) * away;
  if (y[2] < kNearest) return false;
  const double inverse = 1.0 / y[2], centre[2] = {window.lens.cx, window.lens.cy};
  for (int row = 0; row < 2; ++row) {
    out.pixel[row] = window.lens.focal * y[row] * inverse + centre[row];
    for (int b = 0; b < 3; ++b) out.by_point[row][b] = window.lens.focal * inverse * (rotation[b][row] - y[row] * inverse * rotation[b][2]);
    store(cross(out.by_point[row], away), out.by_view[row]);
    store(-out.by_point[row], out.by_view[row] + 3);
  }
  return true;
}

double cost_of(const MonoWindow& window, double* squared) {
  const double width = window.huber_sigmas;
  double cost = 0.0;
  Projection seen;
  for (size_t n = 0; n < window.points.size(); ++n)
    for (int64_t m = window.starts[n]; m < window.starts[n + 1]; ++m) {
      squared[m] = 1e6;
      if (project(window, window.views[size_t(window.observers[m])], window.points[n], seen)) {
        const double du = window.pixels[2 * m] - seen.pixel[0], dv = window.pixels[2 * m + 1] - seen.pixel[1];
        squared[m] = (du * du + dv * dv) / (window.sigma_px * window.sigma_px);
      }
      const double off = std::sqrt(squared[m]);
      cost += off < width ? 0.5 * squared[m] : width * (off - 0.5 * width);
    }
  return cost;
}

struct Cross {
  double at[6][3];
};

// Normal equations of points and free views, and memory for their solution.
struct NormalSystem {
  Matrix hessian, reduced;
  std::vector<double> gradient, step;
  std::vector<Mat3> point_hessian;
  std::vector<Vec3> point_gradient, shifts;
  std::vector<Cross> cross;  // of each observation: view by point
};

void linearise(const MonoWindow& window, const double* squared, NormalSystem& system) {
  const size_t size = system.gradient.size();
  system.hessian.resize(size, size);
  std::fill(system.gradient.begin(), system.gradient.end(), 0.0);
  std::fill(system.point_hessian.begin(), system.point_hessian.end(), Mat3{});
  std::fill(system.point_gradient.begin(), system.point_gradient.end(), Vec3{});
  std::fill(system.cross.begin(), system.cross.end(), Cross{});
  Projection seen;
  for (size_t n = 0; n < window.points.size(); ++n)
    for (int64_t m = window.starts[n]; m < window.starts[n + 1]; ++m) {
      const size_t view = size_t(window.observers[m]);
      if (!project(window, window.views[view], window.points[n], seen)) continue;
      const double off = std::sqrt(squared[m]);
      double weight = 1.0 / (window.sigma_px * window.sigma_px);
      if (off > window.huber_sigmas) weight *= window.huber_sigmas / off;
      const int64_t slot = window.slots[view];
      for (int row = 0; row < 2; ++row) {
        const double residual = window.pixels[2 * m + row] - seen.pixel[row];
        const Vec3 by_point = seen.by_point[row];
        const double* const by_view = seen.by_view[row];
        for (int a = 0; a < 3; ++a) {
          system.point_gradient[n][a] += weight * by_point[a] * residual;
          for (int b = 0; b < 3; ++b) system.point_hessian[n][a][b] += weight * by_point[a] * by_point[b];
        }
        if (slot < 0) continue;
        const size_t at = 6 * size_t(slot);
        for (size_t a = 0; a < 6; ++a) {
          system.gradient[at + a] += weight * by_view[a] * residual;
          for (size_t b = 0; b < 6; ++b) system.hessian[at + a][at + b] += weight * by_view[a] * by_view[b];
          for (int b = 0; b < 3; ++b) system.cross[size_t(m)].at[a][b] += weight * by_view[a] * by_point[b];
        }
      }
    }
}

// The inverse of a symmetric matrix whose diagonal is raised by the damping's share of itself; zero where that is singular.
Mat3 damped_inverse(const Mat3& m, double damping) {
  const double a = m[0][0] * (1 + damping) + 1e-12, b = m[0][1], c = m[0][2];
  const double d = m[1][1] * (1 + damping) + 1e-12, e = m[1][2], f = m[2][2] * (1 + damping) + 1e-12;
  const double determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d);
  if (!(determinant > 0.0)) return {};
  const double ab = (c * e - b * f) / determinant, ac = (b * e - c * d) / determinant, bc = (b * c - a * e) / determinant;
  return {{{(d * f - e * e) / determinant, ab, ac}, {ab, (a * f - c * c) / determinant, bc}, {ac, bc, (a * d - b * b) / determinant}}};
}

// Fills the damped step of views and points, points eliminated first; false where the rest is not positive definite.
bool solve(const MonoWindow& window, double damping, NormalSystem& system) {
  const size_t size = system.gradient.size();
  system.reduced = system.hessian;
  system.step = system.gradient;
  for (size_t a = 0; a < size; ++a) system.reduced[a][a] += damping * system.hessian[a][a] + 1e-9;
  for (size_t n = 0; n < window.points.size(); ++n) {
    const Mat3 inverse = damped_inverse(system.point_hessian[n], damping);
    for (int64_t m = window.starts[n]; m < window.starts[n + 1]; ++m) {
      const int64_t slot = window.slots[size_t(window.observers[m])];
      if (slot < 0) continue;
      Cross carried;
      multiply(system.cross[size_t(m)].at[0], inverse[0], carried.at[0], 6, 3, 3);
      for (size_t a = 0; a < 6; ++a)
        for (int b = 0; b < 3; ++b) system.step[6 * size_t(slot) + a] -= carried.at[a][b] * system.point_gradient[n][b];
      for (int64_t other = window.starts[n]; other < window.starts[n + 1]; ++other) {
        const int64_t other_slot = window.slots[size_t(window.observers[other])];
        if (other_slot < 0) continue;
        const Cross& by = system.cross[size_t(other)];
        for (size_t a = 0; a < 6; ++a) {
          double* const to = system.reduced[6 * size_t(slot) + a] + 6 * other_slot;
          for (size_t b = 0; b < 6; ++b)
            for (int c = 0; c < 3; ++c) to[b] -= carried.at[a][c] * by.at[b][c];
        }
      }
    }
  }
  const bool is_solved = size == 0 || solve_spd(system.reduced[0], system.step.data(), size, size);
  for (size_t n = 0; n < window.points.size(); ++n) {
    Vec3 pull = system.point_gradient[n];
    for (int64_t m = window.starts[n]; m < window.starts[n + 1]; ++m) {
      const int64_t slot = window.slots[size_t(window.observers[m])];
      if (slot < 0) continue;
      for (int b = 0; b < 3; ++b)
        for (size_t a = 0; a < 6; ++a) pull[b] -= system.cross[size_t(m)].at[a][b] * system.step[6 * size_t(slot) + a];
    }
    system.shifts[n] = damped_inverse(system.point_hessian[n], damping) * pull;
  }
  return is_solved;
}

MonoWindow moved(const MonoWindow& window, const NormalSystem& system) {
  MonoWindow out = window;
  for (size_t k = 0; k < out.views.size(); ++k) {
    if (window.slots[k] < 0) continue;
    const double* const step = system.step.data() + 6 * window.slots[k];
    out.views[k] = {so3_exp(vec3(step)) * out.views[k].rotation, out.views[k].translation + vec3(step + 3)};
  }
  for (size_t n = 0; n < out.points.size(); ++n) out.points[n] = out.points[n] + system.shifts[n];
  return out;
}

// Moves views and points to the nearest optimum by Levenberg-Marquardt; half the robust sum of squares there. squared: of each
// observation, in sigmas, a million behind a camera. Views are perturbed as R <- Exp(rotation) R, p <- p + translation, both in map axes.
// The Schur complement over the points is solved dense. Source: Triggs et al. 2000.
double adjusted(MonoWindow& window, size_t free_views, int iterations, double* squared) {
  NormalSystem system;
  system.gradient.resize(6 * free_views);
  system.point_hessian.resize(window.points.size());
  system.point_gradient.resize(window.points.size());
  system.shifts.resize(window.points.size());
  system.cross.resize(size_t(window.starts[window.points.size()]));
  double cost = cost_of(window, squared), damping = 1e-4;
  for (int iteration = 0; iteration < iterations; ++iteration) {
    linearise(window, squared, system);
    bool is_better = false;
    double new_cost = cost;
    for (int attempt = 0; attempt < 8 && !is_better; ++attempt) {
      if (solve(window, damping, system)) {
        MonoWindow next = moved(window, system);
        new_cost = cost_of(next, squared);
        is_better = new_cost < cost;
        if (is_better) std::swap(window, next);
      }
      if (!is_better) damping *= 10.0;
    }
    if (!is_better) break;
    const bool is_small = cost - new_cost < 1e-5 * cost;
    cost = new_cost;
    damping = std::max(damping * 0.1, 1e-9);
    if (is_small) break;
  }
  return cost_of(window, squared);
}

auto adjust_window(const Array<double, -1, 4, 4>& map_from_cam, size_t held, const Points& points, const Indices& starts,
                   const Indices& views, const Places& pixels, const StereoLens& lens, double sigma_px, double huber_sigmas,
                   int iterations) {
  const size_t view_count = map_from_cam.shape(0), count = points.shape(0), seen = views.shape(0);
  if (view_count > 500) throw nb::value_error("map_from_cam: at most 500 views");
  check_rows(count + 1, "starts: one more than points", starts);
  check_rows(seen, "pixels: one for each of views", pixels);
  if (starts(0) != 0 || starts(count) != int64_t(seen) || !std::is_sorted(starts.begin(), starts.end()))
    throw nb::value_error("starts: rows of views");
  check_below(view_count, "views: numbers of map_from_cam", views);
  if (iterations < 0 || iterations > 1000) throw nb::value_error("iterations: 0 to 1000");
  MonoWindow window{{}, {}, {}, starts.data(), views.data(), pixels.data(), lens, sigma_px, huber_sigmas};
  for (size_t k = 0; k < view_count; ++k) {
    window.views.push_back(se3(map_from_cam.data() + 16 * k));
    window.slots.push_back(k < held ? -1 : int64_t(k - held));
  }
  window.points.assign(points.rows(), points.rows() + count);
  std::vector<double> squared(seen), moved(16 * view_count);
  const double cost = unlocked([&] { return adjusted(window, view_count - std::min(held, view_count), iterations, squared.data()); });
  for (size_t k = 0; k < view_count; ++k) store(window.views[k], moved.data() + 16 * k);
  return std::tuple(as_numpy<double, 3>(std::move(moved), {view_count, 4, 4}), std::move(window.points), std::move(squared), cost);
}

}  // namespace

void bind_mono_window(nb::module_& module) {
  module.def("adjust_window", &adjust_window, "map_from_cam"_a, "held"_a, "points"_a, "starts"_a, "views"_a, "pixels"_a, "lens"_a,
             "sigma_px"_a, "huber_sigmas"_a, "iterations"_a);
}

}  // namespace fleetmap
