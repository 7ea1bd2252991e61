// The right-invariant multi-state constraint filter: a state that inertial samples move, a window of past bodies (clones), and two
// covariances of both. Source: Mourikis and Roumeliotis 2007 for the filter, Barrau and Bonnabel 2017 for the error, which
// track_constraints.h states.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <tuple>
#include <utility>
#include <vector>

#include "dense.h"
#include "lie.h"
#include "preintegration.h"
#include "track_constraints.h"

namespace fleetmap {

// In `odom`; m, s, rad.
struct NavState {
  Mat3 rotation;
  Vec3 velocity, position, gyro_bias, accel_bias;
  SE3 body() const { return {rotation, position}; }
};

// Sigmas are those of FilterSettings in Python.
struct FilterModel {
  PixelModel pixels;
  std::vector<RigCamera> cameras;
  double gravity;  // m/s^2, downwards
  double time_offset_sigma_s;
  double disparity_offset_sigma_px, depth_scale_sigma, pair_memory_s;  // errors of all pairs, and for how long they stay
  double wheel_speed_scale_sigma, wheel_yaw_scale_sigma;               // of one robot's wheels
  double wheel_slip_mps, wheel_sigma_scale;                            // sideways and upwards; factor on sigmas, for weighing
  double still_sigma_mps;
};

// Two covariances are kept. `covariance` weighs and gates measurements: its noise is white, the same for all pixels, and wide, so that
// errors without a model do no harm. `true_error_cov` is the covariance of the true error after the same corrections, from a full error
// model: points that slip along their way, disparities that stay wrong, a pair that is slightly off. Only this one is reported. Its
// first four errors are considered, never estimated: the pair's disparity offset and depth scale, the scales of the wheels' speed and
// yaw rate. Source: covariance analysis of suboptimal filters, Maybeck 1979, chapter 6.
//
// A clone is named by its id; std::invalid_argument for one that is not held.
class Filter {
 public:
  // Numbers of the errors: the state's, the clock's, then six for each clone, rotation and position.
  static constexpr size_t kRotation = 0, kVelocity = 3, kPosition = 6, kGyroBias = 9, kAccelBias = 12, kNav = 15, kOffset = 15,
                          kClones = 16;
  static constexpr size_t kPair = 2, kConsidered = 4;

  // nav_covariance and nav_true_error (15, 15).
  Filter(const NavState& start, const double* nav_covariance, const double* nav_true_error, const FilterModel& model);

  // Moves the state from start to end; the last angular rate, bias removed. noise weighs the prediction, true_noise is real.
  Vec3 propagate(const ImuSamples& imu, int64_t start_ns, int64_t end_ns, const ImuNoise& noise, const ImuNoise& true_noise);

  // Moves the state by a relative transform, uncertain by the sigmas. measured, in the next body's axes, is added information if given.
  void predict_random_walk(const SE3& body_from_next, double rotation_sigma, double translation_sigma, double duration_s,
                           const std::optional<Mat6>& measured);

  // Keeps the current body in the window; its rate (rad/s) ties it to the time offset.
  void add_clone(int64_t id, Vec3 rate_body);
  // Forgets a clone: marginalises it.
  void remove_clone(int64_t id);
  // Resets rotation and position of the state to a clone's, with its covariance; the motion since is forgotten.
  void return_to_clone(int64_t id);
  // Moves the frame's origin to the newest clone, from which errors count; new_from_old. Motions between clones, and
  // their covariances, stay. Only the absolute error of the old frame is forgotten, which no motion shows.
  // It grows without bound with the distance from the origin, until the motion between two clones is a difference of
  // numbers so large that rounding leaves no covariance. Velocity and biases must be unused.
  SE3 begin_frame_anew();

  // Adds one camera's observations in a frame: ids (count,), pixels (count, 3) u left, v, u right, NaN if that is unknown.
  void observe(int64_t frame, size_t camera, const int64_t* ids, const double* pixels, size_t count) {
    observations_.add(frame, camera, ids, pixels, count);
  }
  // Uses the observations of ended and due tracks, each once; used (T,) as of TrackConstraints, by ascending ids, valid
  // until the next. For first_depth_m see Observations. More than one iteration relinearises (iterated Kalman filter), for large
  // corrections; newest_odom_from_body is then the first linearisation point of the newest clone, if vision is better than the
  // prediction. It adds no information. sigma_scale widens the noise, for matches less accurate than flow. Nothing is changed, and
  // no track counts as used, if the result would not be finite.
  const std::vector<int8_t>& update(const LivingPoints& living, double first_depth_m, int iterations,
                                    const std::optional<SE3>& newest_odom_from_body, double sigma_scale);

  // By the motion of `base` on its wheels: forward speed, no other, and yaw rate; gyro measured at the same time. Each returns the
  // squared Mahalanobis distance by true_error_cov, infinity if it or the correction is not a number; nothing is changed if that
  // exceeds the gate.
  double correct_by_wheels(Vec3 velocity_base, double yaw_rate, double sigma_mps, double sigma_radps, Vec3 gyro, const SE3& base_from_body,
                           double gate);
  // By standstill: zero speed and rotation, the gyro's mean shows only its bias (ZUPT).
  double correct_by_rest(Vec3 gyro_mean, double gyro_sigma, double gate);

  // By the speed (3,) that images show, in the state's axes; no prior speed makes it an outlier.
  void correct_by_speed(Vec3 velocity, double sigma_mps);

  // Inflates position and velocity if vision contradicts the prediction since a clone beyond its covariance; true if it did.
  // Values that are not finite contradict nothing.
  // After seconds without images an IMU's error can exceed its noise figures; a filter that then rejects every image never recovers.
  bool inflate(int64_t id, const SE3& seen_odom_from_body, double gap_s);
  void inflate_velocity(double sigma_mps);

  // earlier_from_later between two clones.
  SE3 motion_between(int64_t earlier, int64_t later) const { return inverse(clone(earlier)) * clone(later); }
  // The motion from a clone to the newest one, and its covariance, of a left perturbation in axes of the earlier body: from the joint
  // covariance of both, so that common errors cancel.
  std::tuple<SE3, Mat6> motion_since(int64_t id) const;
  // From a camera of a clone to one on the state's body.
  SE3 cam_from_earlier(int64_t id, const SE3& cam_from_body, size_t camera) const;
  // Of odom_from_body: rotation error in odom axes, then position error.
  Mat6 body_covariance() const;

  const std::vector<int64_t>& clone_ids() const { return clone_ids_; }
  const SE3& clone(int64_t id) const { return clones_[index_of(id)]; }
  const std::vector<RigCamera>& cameras() const { return model_.cameras; }

  NavState state;
  double imu_minus_cam_s = 0.0;
  Matrix covariance, true_error_cov;

 private:
  size_t index_of(int64_t id) const;
  bool is_finite() const;
  // A covariance, and the number of the state's first error in it.
  using Errors = std::pair<Matrix*, size_t>;
  std::array<Errors, 2> both() { return {Errors{&covariance, 0}, Errors{&true_error_cov, kConsidered}}; }

  // residual = jacobian error + noise, for the state's errors. The covariances, of uncorrelated rows: noise weighs the measurement;
  // true_noise and by_considered, derivatives by the considered errors, go into the true error's covariance.
  struct Measurement {
    size_t rows;
    double jacobian[6][kNav] = {}, by_considered[6][kConsidered] = {}, residual[6] = {}, noise[6] = {}, true_noise[6] = {};
  };
  double correct_with(const Measurement& measurement, double gate);

  void move_origin(Vec3 by);
  void forget_pair(double duration_s);
  void apply(const double* error);
  void remove_common_motion(Matrix& gain_turned);
  void learn(const Matrix& gain_turned);

  FilterModel model_;
  std::vector<int64_t> clone_ids_;
  std::vector<SE3> clones_;
  Observations observations_;
  TrackConstraints constraints_;
  // Kept so that nothing is allocated in a frame.
  std::vector<PlacedCamera> cameras_;
  std::vector<SE3> prior_clones_, clones_before_;
  std::vector<ImuInterval> intervals_;
  std::vector<int8_t> used_;
  std::vector<double> moved_, correction_;
  std::vector<size_t> group_, members_;
  Matrix covariance_before_, true_error_cov_before_, spare_, inner_, by_clones_, weighing_, gain_turned_, gain_, seen_, spread_, taken_,
      part_, turned_;
};

}  // namespace fleetmap
