// The pose of one camera from points with known positions (PnP), or of several that are held together: a generalised camera.
#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "camera.h"
#include "lie.h"

namespace fleetmap {

// Points with known positions, and the pixels where a camera sees them.
struct Sightings {
  const Vec3 *points, *pixels;           // in the source frame, metres; u left, v, u right (NaN none)
  const std::array<double, 2>* weights;  // 1 / sigma of u and v, of the disparity; 1 / pixels
  size_t count;
  // Where several cameras see them: the number of each sighting's camera, and those cameras from the first one, whose pose is sought.
  // Source: Pless 2003 (generalised cameras).
  const uint8_t* cameras = nullptr;  // (count,)
  const SE3* cameras_from_first = nullptr;
};

// What a camera's pixels of a point before it (camera axes) are off by, of u, v and the disparity, times their weights, and the derivatives
// by the point. Zero for a disparity that is not known.
struct Residuals {
  std::array<double, 3> residual;
  std::array<Vec3, 3> by_point;
};
inline Residuals residuals_of(Vec3 point, Vec3 pixel, const std::array<double, 2>& weights, const StereoLens& lens) {
  const double x = point[0], y = point[1], inverse = 1.0 / point[2];
  const bool is_stereo = !std::isnan(pixel[2]) && lens.focal_baseline > 0.0;
  const double w = weights[0], w_disparity = is_stereo ? weights[1] : 0.0;
  return {{(lens.focal * x * inverse + lens.cx - pixel[0]) * w, (lens.focal * y * inverse + lens.cy - pixel[1]) * w,
           is_stereo ? (lens.focal_baseline * inverse - (pixel[0] - pixel[2])) * w_disparity : 0.0},
          {{{lens.focal * inverse * w, 0.0, -lens.focal * x * inverse * inverse * w},
            {0.0, lens.focal * inverse * w, -lens.focal * y * inverse * inverse * w},
            {0.0, 0.0, -lens.focal_baseline * inverse * inverse * w_disparity}}}};
}

// Sightings that are chosen one by one.
struct ChosenSightings {
  std::vector<Vec3> points, pixels;
  std::vector<std::array<double, 2>> weights;
  std::vector<uint8_t> cameras;
  const SE3* cameras_from_first = nullptr;

  void add(const Sightings& from, size_t n) {
    points.push_back(from.points[n]), pixels.push_back(from.pixels[n]), weights.push_back(from.weights[n]);
    cameras.push_back(from.cameras == nullptr ? 0 : from.cameras[n]);
    cameras_from_first = from.cameras_from_first;
  }
  void clear() { points.clear(), pixels.clear(), weights.clear(), cameras.clear(); }
  Sightings all() const { return {points.data(), pixels.data(), weights.data(), points.size(), cameras.data(), cameras_from_first}; }
};

// The redescending weight of Geman and McClure has this width, in sigmas: gross outliers have no weight. Inliers are those whose squared
// normalised residual is under the gate. Iterations: on all points, and on the inliers.
struct Refinement {
  double width, gate_squared;
  int iterations, inlier_iterations;
};

// Robust least squares from a start, cam_from_source, in place: Levenberg-Marquardt on all points, and once more on the inliers alone, so
// that no outlier biases the result. False where the points do not determine the camera.
// The step is rotation first, applied from the left in camera axes; prior: information on the start. Fills the last Hessian, without the
// prior, and the squared normalised residuals (count,) of all points; inliers are memory to reuse.
// Source: Geman and McClure 1987 for the weight, Marquardt 1963 for the damping.
bool refine_twice(const Sightings& seen, const StereoLens& lens, const Refinement& refinement, const Mat6& prior, SE3& cam_from_source,
                  Mat6& hessian, double* squared, ChosenSightings& inliers);

// A solved camera: the information, with the prior, on a perturbation as that of the steps, and the squared normalised residuals.
struct Resection {
  SE3 cam_from_source;
  Mat6 information;
  std::vector<double> squared;
};

// As refine_twice.
std::optional<Resection> refine_pnp(const Sightings& seen, const StereoLens& lens, const Refinement& refinement, const Mat6& prior,
                                    const SE3& start);

// A proposed camera must see a minimum of points within a limit in pixels of their measurements, and keep as many inliers
// after its refinement, by those points and then by all.
struct Agreement {
  double threshold_px;
  size_t min_inliers;
};

// The camera that most points agree with, of those that three of them allow: draws in [0, 1) say which three propose. Fewer
// are tried once the best camera is the best of all with that confidence.
// Source: Fischler and Bolles 1981; Grunert 1841, as in Haralick et al. 1994, for the three points.
std::optional<Resection> ransac_pnp(const Sightings& seen, const StereoLens& lens, const Refinement& refinement, const Agreement& agreement,
                                    const Vec3* draws, size_t draw_count, double confidence);

}  // namespace fleetmap
