#include "pnp.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "dense.h"

namespace fleetmap {
namespace {

constexpr double kNearest = 0.05;  // metres before the camera
constexpr double kUnseen = 1e12;   // squared residual of points nearer, or behind
constexpr int kTrials = 5;         // of larger and larger damping in an iteration
constexpr double kEnough = 1e-6;   // share of the cost by which an iteration must lower it to be followed by another
constexpr size_t kLeastInliers = 4;
// A pivot of the information below this share of its diagonal is rounding: that motion is not seen, as of two points or three in a line.
constexpr double kUnseenShare = 1e-9;

// Robust cost, and the normal equations of a step.
struct Normal {
  double cost;
  Mat6 hessian;
  double gradient[6];
};

// At a camera; fills squared normalised residuals (count,) too.
void linearize(const Sightings& seen, const StereoLens& lens, double width, const SE3& cam_from_source, Normal& normal, double* squared) {
  normal = {};
  for (size_t n = 0; n < seen.count; ++n) {
    const Vec3 from_first = cam_from_source * seen.points[n];
    const SE3* const camera = seen.cameras_from_first == nullptr ? nullptr : seen.cameras_from_first + seen.cameras[n];
    const Vec3 point = camera == nullptr ? from_first : *camera * from_first;
    squared[n] = kUnseen;
    if (point[2] < kNearest) {
      normal.cost += 0.5 * width * width;
      continue;
    }
    const auto [residual, by_point] = residuals_of(point, seen.pixels[n], seen.weights[n], lens);
    double jacobian[3][6];  // by the step: the point moves by turn x point + shift
    for (int k = 0; k < 3; ++k) {
      const Vec3 by_first = camera == nullptr ? by_point[k] : transposed(camera->rotation) * by_point[k];
      store(cross(from_first, by_first), jacobian[k]), store(by_first, jacobian[k] + 3);
    }
    const double e2 = residual[0] * residual[0] + residual[1] * residual[1] + residual[2] * residual[2];
    squared[n] = e2;
    const double damped = width * width / (width * width + e2), robust = damped * damped;
    normal.cost += 0.5 * e2 * damped;
    for (int a = 0; a < 6; ++a) {
      normal.gradient[a] -= robust * (jacobian[0][a] * residual[0] + jacobian[1][a] * residual[1] + jacobian[2][a] * residual[2]);
      for (int b = 0; b < 6; ++b)
        normal.hessian[a][b] +=
            robust * (jacobian[0][a] * jacobian[0][b] + jacobian[1][a] * jacobian[1][b] + jacobian[2][a] * jacobian[2][b]);
    }
  }
}

// Levenberg-Marquardt in place; leaves the final normal equations and squared residuals. False if those are singular.
bool refine(const Sightings& seen, const StereoLens& lens, double width, const Mat6& prior, int iterations, SE3& cam_from_source,
            Normal& normal, double* squared) {
  double moved[6] = {}, damping = 1e-4;
  linearize(seen, lens, width, cam_from_source, normal, squared);
  for (int iteration = 0; iteration < iterations; ++iteration) {
    Normal trial;
    SE3 stepped;
    double moved_then[6];
    bool is_better = false;
    for (int k = 0; k < kTrials && !is_better; ++k) {
      Mat6 damped;
      double step[6];
      for (int a = 0; a < 6; ++a) {
        step[a] = normal.gradient[a];
        for (int b = 0; b < 6; ++b) {
          damped[a][b] = normal.hessian[a][b] + prior[a][b];
          step[a] -= prior[a][b] * moved[b];
        }
        damped[a][a] += damping * normal.hessian[a][a] + 1e-9;
      }
      if (!solve_spd(damped.at, step, 6, 6)) return false;
      const Mat3 turn = so3_exp(vec3(step));
      stepped.rotation = turn * cam_from_source.rotation;
      for (int a = 0; a < 3; ++a) {
        stepped.translation[a] = step[3 + a];
        for (int b = 0; b < 3; ++b) stepped.translation[a] += turn[a][b] * cam_from_source.translation[b];
      }
      linearize(seen, lens, width, stepped, trial, squared);
      for (int a = 0; a < 6; ++a) moved_then[a] = moved[a] + step[a];
      for (int a = 0; a < 6; ++a)
        for (int b = 0; b < 6; ++b) trial.cost += 0.5 * moved_then[a] * prior[a][b] * moved_then[b];
      is_better = trial.cost <= normal.cost;
      if (!is_better) damping *= 10.0;
    }
    if (!is_better) {  // the residuals are those of the last trial
      linearize(seen, lens, width, cam_from_source, normal, squared);
      break;
    }
    const double gain = normal.cost - trial.cost;
    cam_from_source = stepped;
    normal = trial;
    std::copy_n(moved_then, 6, moved);
    damping = std::max(0.1 * damping, 1e-9);
    if (gain < kEnough * (normal.cost + 1e-9)) break;
  }
  Mat6 factor = normal.hessian + prior;
  if (!cholesky_in_place(factor.at, 6, 6)) return false;
  for (int a = 0; a < 6; ++a)
    if (factor[a][a] * factor[a][a] < kUnseenShare * (normal.hessian[a][a] + prior[a][a])) return false;
  return true;
}

}  // namespace

bool refine_twice(const Sightings& seen, const StereoLens& lens, const Refinement& refinement, const Mat6& prior, SE3& cam_from_source,
                  Mat6& hessian, double* squared, ChosenSightings& inliers) {
  Normal normal;
  if (!refine(seen, lens, refinement.width, prior, refinement.iterations, cam_from_source, normal, squared)) return false;
  inliers.clear();
  for (size_t n = 0; n < seen.count; ++n)
    if (squared[n] < refinement.gate_squared) inliers.add(seen, n);
  const Sightings again = inliers.all();
  if (again.count >= kLeastInliers) {
    if (!refine(again, lens, refinement.width, prior, refinement.inlier_iterations, cam_from_source, normal, squared)) return false;
    Normal of_all;
    linearize(seen, lens, refinement.width, cam_from_source, of_all, squared);
  }
  hessian = normal.hessian;
  return true;
}

std::optional<Resection> refine_pnp(const Sightings& seen, const StereoLens& lens, const Refinement& refinement, const Mat6& prior,
                                    const SE3& start) {
  Resection found{start, {}, std::vector<double>(seen.count)};
  ChosenSightings inliers;
  if (!refine_twice(seen, lens, refinement, prior, found.cam_from_source, found.information, found.squared.data(), inliers)) return {};
  found.information = found.information + prior;
  return found;
}

}  // namespace fleetmap
