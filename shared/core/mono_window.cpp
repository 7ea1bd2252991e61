#include "mono_window.h"

#include <algorithm>
#include <cmath>

#include "dense.h"

namespace fleetmap {

namespace {

constexpr double kNearest = 1e-3;

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
  const double inverse = 1.0 / y[2], centre[2] = {window.cx, window.cy};
  for (int row = 0; row < 2; ++row) {
    out.pixel[row] = window.focal * y[row] * inverse + centre[row];
    for (int b = 0; b < 3; ++b) out.by_point[row][b] = window.focal * inverse * (rotation[b][row] - y[row] * inverse * rotation[b][2]);
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
  std::vector<int64_t> slots;  // of each view among the free ones, -1 for a fixed one
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
      const int64_t slot = system.slots[view];
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
      const int64_t slot = system.slots[size_t(window.observers[m])];
      if (slot < 0) continue;
      Cross carried;
      multiply(system.cross[size_t(m)].at[0], inverse[0], carried.at[0], 6, 3, 3);
      for (size_t a = 0; a < 6; ++a)
        for (int b = 0; b < 3; ++b) system.step[6 * size_t(slot) + a] -= carried.at[a][b] * system.point_gradient[n][b];
      for (int64_t other = window.starts[n]; other < window.starts[n + 1]; ++other) {
        const int64_t other_slot = system.slots[size_t(window.observers[other])];
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
      const int64_t slot = system.slots[size_t(window.observers[m])];
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
    if (system.slots[k] < 0) continue;
    const double* const step = system.step.data() + 6 * system.slots[k];
    out.views[k] = {so3_exp(vec3(step)) * out.views[k].rotation, out.views[k].translation + vec3(step + 3)};
  }
  for (size_t n = 0; n < out.points.size(); ++n) out.points[n] = out.points[n] + system.shifts[n];
  return out;
}

}  // namespace

double adjust_window(MonoWindow& window, int iterations, double* squared) {
  NormalSystem system;
  size_t count = 0;
  for (const bool is_held : window.held) system.slots.push_back(is_held ? -1 : int64_t(count++));
  system.gradient.resize(6 * count);
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

}  // namespace fleetmap
