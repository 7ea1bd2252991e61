// Constraints of point tracks on the filter's clones that observed them, with the points projected out.
//
// Error convention: true = Exp(error) * estimate, in `odom` axes. For a rotation R, a velocity v and a position p and the error
// (r, nu, rho): R = Exp(r) R^, v = Exp(r) v^ + nu, p = Exp(r) p^ + rho, to first order. Source: Barrau and Bonnabel 2017.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "camera.h"
#include "dense.h"
#include "lie.h"

namespace fleetmap {

// A camera of a clone.
struct PlacedCamera {
  StereoLens lens;
  SE3 odom_from_cam;
};

// A row of a track: the clone whose camera saw the point, that camera's number among those of all clones, and where: left pixel, and
// column in the right image, NaN where that is unknown.
struct Sighting {
  size_t clone, view;
  double u, v, u_right;
  bool has_disparity() const { return u_right == u_right; }
};

// Each is 1 / sigma of a measurement.
struct PixelWeights {
  double pixel, disparity;
};

// The point (in place, `odom`) of one track, by least squares; false unless it converges in front of every camera. point must
// hold a start.
bool triangulate(const PlacedCamera* cameras, const Sighting* track, size_t count, const PixelWeights& weights, Vec3& point);

// Remaining share of a normal error's variance if squares beyond the limit are rejected: of a truncated normal.
double share_that_passes(double limit, double mean_square);

// Model of pixel errors. The weights are wide and treat all as white noise; the rest describes the true errors.
struct PixelModel {
  PixelWeights weights;
  double noise_variance;           // true one of the weighted rows
  double slip_along, slip_across;  // sigmas of one track's own errors: shares of its way by which it slips along it
  double track_disparity;          // and across it, and its disparity's offset in pixels
  double gate_quantile;            // of the normal distribution, at the share of right tracks that pass the gate
};

// The rows of one track and their derivatives: by the point, the clones' errors (rotation and position each, in the track's order), the
// rig's disparity offset and depth scale, the track's own errors (slips along and across, disparity's offset); last the residual.
struct TrackRows {
  Matrix values;
  size_t rows, clone_columns;
  size_t pair_column() const { return 3 + clone_columns; }
  size_t own_column() const { return pair_column() + 2; }
  size_t residual_column() const { return own_column() + 3; }
};

void linearise_track(Vec3 point, const PlacedCamera* cameras, const Sighting* track, size_t count, const PixelWeights& weights,
                     TrackRows& out);

// T tracks, one after the other; where each begins among the sightings, (T + 1,). first_points: where triangulation starts, in the
// cameras that are the anchors.
struct Tracks {
  std::vector<size_t> starts;
  std::vector<Sighting> sightings;
  std::vector<size_t> anchors;
  std::vector<Vec3> first_points;
  size_t count() const { return anchors.size(); }
};

// Points in the newest frame, and those of them to use now.
struct LivingPoints {
  const int64_t* ids;
  const bool* due;
  size_t count;
};

// Observations of points from frame to frame, kept as one table until the filter uses them.
class Observations {
 public:
  void add(int64_t frame, size_t camera, const int64_t* ids, const double* pixels, size_t count);

  // Removes the tracks that ended, or are due, with two observations or more in the clones, frames in the window's order. Due tracks with
  // one observation stay, ended ones are forgotten. View clone * C + camera is one of C cameras. The first guess of a point is the stereo
  // point of the nearest view, or first_depth_m along the last ray if no view has a disparity. The result is valid until the next call.
  const Tracks& take(const LivingPoints& living, const std::vector<int64_t>& clones, const std::vector<RigCamera>& cameras,
                     double first_depth_m);

 private:
  struct Observation {
    int64_t id, frame;
    size_t camera;
    double pixels[3];
  };
  std::vector<Observation> seen_;  // in order of arrival
  // Kept so that nothing is allocated in a frame.
  Tracks tracks_;
  std::vector<size_t> order_, living_, rows_;
  std::vector<char> stays_;
};

// vector (6 M,) = information (6 M, 2 + 6 M) (disparity offset, depth scale, clones' errors) + noise of covariance scatter (6 M, 6 M).
struct NormalEquations {
  Matrix information, scatter;
  std::vector<double> vector;
};

// Adds up tracks that pass their gates. It keeps its memory.
class TrackConstraints {
 public:
  // From the tracks and the cameras of M clones; covariance (6 M, 6 M) of the clones' errors, rotation then position. moved (6 M,): how far
  // the clones stand from the prior mean, when an iterated filter relinearises. used (T,) becomes 1 for a track that was used, 0 for one
  // that could not be triangulated and -1 for one that failed its gate. Source: Mourikis and Roumeliotis 2007, equations 23 to 26 (null
  // space of the point).
  void accumulate(const std::vector<PlacedCamera>& cameras, const Tracks& tracks, const PixelModel& model, const Matrix& covariance,
                  const std::vector<double>& moved, int8_t* used);

  NormalEquations equations;

 private:
  int8_t add(const std::vector<PlacedCamera>& cameras, const Sighting* track, size_t count, Vec3 point, const PixelModel& model,
             const Matrix& covariance, const std::vector<double>& moved);

  TrackRows rows_;
  Matrix by_clone_, by_clone_turned_, by_state_, own_, prior_, spread_, innovation_, gained_, carried_;
  std::vector<double> left_, whitened_;
};

}  // namespace fleetmap
