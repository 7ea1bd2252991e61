#include "arguments.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <string>

#include "filter.h"
#include "in_turn.h"

namespace fleetmap {
namespace {

using Transforms = Array<double, -1, 4, 4>;
using Lenses = Array<double, -1, 4>;
using Noise = std::tuple<double, double, double, double>;

using SharedFilter = Shared<Filter>;

// Cameras, each of a lens and a pose.
template <typename Camera>
std::vector<Camera> cameras_of(const Lenses& lenses, const Transforms& poses) {
  std::vector<Camera> cameras;
  for (size_t c = 0; c < lenses.shape(0); ++c) cameras.push_back({stereo_lens(&lenses(c, 0)), se3(poses.data() + 16 * c)});
  return cameras;
}

FilterModel model_of(const Lenses& lenses, const Transforms& body_from_cams, const Settings& settings, double gate_quantile,
                     double gravity_mps2) {
  if (lenses.shape(0) == 0 || body_from_cams.shape(0) != lenses.shape(0))
    throw nb::value_error("lenses, body_from_cams: of the same cameras, at least one");
  const double noise_share = settings["noise_share"];
  const PixelModel pixels{{1.0 / double(settings["pixel_sigma_px"]), 1.0 / double(settings["disparity_sigma_px"])},
                          noise_share * noise_share,
                          settings["slip_along_share"],
                          settings["slip_across_share"],
                          settings["track_disparity_sigma_px"],
                          gate_quantile};
  return {pixels,
          cameras_of<RigCamera>(lenses, body_from_cams),
          gravity_mps2,
          settings["time_offset_sigma_s"],
          settings["disparity_offset_sigma_px"],
          settings["depth_scale_sigma"],
          settings["pair_error_memory_s"],
          settings["wheel_speed_scale_sigma"],
          settings["wheel_yaw_scale_sigma"],
          settings["wheel_slip_mps"],
          settings["wheel_sigma_scale"],
          settings["still_sigma_mps"]};
}

void make(SharedFilter* filter, const Mat3& rotation, const Vec3& velocity, const Vec3& position, const Vec3& gyro_bias,
          const Vec3& accel_bias, const Array<double, 15, 15>& nav_covariance, const Array<double, 15, 15>& nav_true_error,
          const Lenses& lenses, const Transforms& body_from_cams, const nb::object& settings, double gate_quantile, double gravity_mps2) {
  new (filter) SharedFilter(NavState{rotation, velocity, position, gyro_bias, accel_bias}, nav_covariance.data(), nav_true_error.data(),
                            model_of(lenses, body_from_cams, {settings}, gate_quantile, gravity_mps2));
}

Vec3 predict_inertial(SharedFilter& filter, const Indices& stamps_ns, const Points& gyro_radps, const Points& accel_mps2, int64_t start_ns,
                      int64_t end_ns, const Noise& noise, const Noise& true_noise) {
  const ImuSamples imu = imu_samples(stamps_ns, gyro_radps, accel_mps2);
  return unlocked([&] {
    return filter.propagate(imu, start_ns, end_ns, std::make_from_tuple<ImuNoise>(noise), std::make_from_tuple<ImuNoise>(true_noise));
  });
}

void observe(SharedFilter& filter, int64_t frame_index, int64_t camera, const Indices& ids, const Points& pixels) {
  const size_t cameras = filter.cameras().size();
  if (size_t(camera) >= cameras)
    throw nb::value_error(
        ("camera: " + std::to_string(camera) + ", but the rig has " + std::to_string(cameras) + ", counted from 0").c_str());
  check_rows(pixels.shape(0), "pixels: one for each id", ids);
  const CountedStep counted;
  filter.observe(frame_index, size_t(camera), ids.data(), pixels.data(), ids.shape(0));
}

auto update(SharedFilter& filter, const Indices& alive, const Array<bool, -1>& due, double first_depth_m, int iterations,
            const std::optional<SE3>& newest_odom_from_body, double sigma_scale) {
  check_rows(alive.shape(0), "due: one for each alive", due);
  if (iterations < 1 || iterations > 1000) throw nb::value_error("iterations: 1 to 1000");
  const LivingPoints living{alive.data(), due.data(), alive.shape(0)};
  const std::vector<int8_t>* const used =
      unlocked([&] { return &filter.update(living, first_depth_m, iterations, newest_odom_from_body, sigma_scale); });
  return as_numpy<int8_t>(std::vector(*used));
}

nb::list clone_ids(SharedFilter& filter) {
  nb::list ids;
  for (const int64_t id : filter.clone_ids()) ids.append(id);
  return ids;
}

auto nav_state(SharedFilter& filter) {
  const NavState& s = filter.state;
  return std::tuple(s.rotation, s.velocity, s.position, s.gyro_bias, s.accel_bias);
}

auto matrix(const Matrix& values) { return copied<2>(values[0], {values.rows, values.columns}); }

// Views and pixels of a track, and the cameras, placed in odom.
struct Track {
  std::vector<PlacedCamera> cameras;
  std::vector<Sighting> sightings;

  Track(const Transforms& odom_from_cam, const Lenses& lenses, const Indices& views, const Points& pixels) {
    check_rows(odom_from_cam.shape(0), "lenses: one for each of odom_from_cam", lenses);
    check_rows(views.shape(0), "pixels: one for each of views", pixels);
    cameras = cameras_of<PlacedCamera>(lenses, odom_from_cam);
    for (size_t n = 0; n < views.shape(0); ++n) {
      if (size_t(views(n)) >= cameras.size()) throw nb::value_error("views: numbers of cameras");
      sightings.push_back({0, size_t(views(n)), pixels(n, 0), pixels(n, 1), pixels(n, 2)});
    }
  }
};

Vec3 triangulate_of(const Transforms& odom_from_cam, const Indices& views, const Points& pixels, const Lenses& lenses, double pixel_weight,
                    double disparity_weight, Vec3 point) {
  const Track track(odom_from_cam, lenses, views, pixels);
  const PixelWeights weights{pixel_weight, disparity_weight};
  if (triangulate(track.cameras.data(), track.sightings.data(), track.sightings.size(), weights, point)) return point;
  return {NAN, NAN, NAN};
}

auto linearise_track_of(const Vec3& point, const Transforms& odom_from_cam, const Indices& views, const Points& pixels,
                        const Lenses& lenses, double pixel_weight, double disparity_weight) {
  const Track track(odom_from_cam, lenses, views, pixels);
  TrackRows rows;
  linearise_track(point, track.cameras.data(), track.sightings.data(), track.sightings.size(), {pixel_weight, disparity_weight}, rows);
  return copied<2>(rows.values.values.data(), {rows.rows, rows.values.columns});
}

// map_from_next and its covariance (6, 6): rotation first, in map axes, about the body, rotation on the left and position shifted
// independently of each other, SO(3) x R^3, as the given one; cov_step (6, 6) is a left perturbation of the step in the body's axes about
// the body. Source: Barfoot and Furgale 2014.
std::tuple<SE3, Mat6> compose_pose(const SE3& map_from_body, const Mat6& covariance, const SE3& body_from_next, const Mat6& cov_step) {
  const Mat3& turn = map_from_body.rotation;
  const Mat6 total = covariance + carried(cov_step, turn, {});
  return {map_from_body * body_from_next, carried(total, kIdentity, -1.0 * skew(turn * body_from_next.translation))};
}

}  // namespace

void bind_filter(nb::module_& module) {
  constexpr PythonLock kReleased = PythonLock::kReleased;
  nb::class_<SharedFilter>(module, "Filter")
      .def("__init__", &make, "rotation"_a, "velocity"_a, "position"_a, "gyro_bias"_a, "accel_bias"_a, "nav_covariance"_a,
           "nav_true_error"_a, "lenses"_a, "body_from_cams"_a, "settings"_a, "gate_quantile"_a, "gravity_mps2"_a)
      .def("predict_inertial", in_turn(&predict_inertial), "stamps_ns"_a, "gyro_radps"_a, "accel_mps2"_a, "start_ns"_a, "end_ns"_a,
           "noise"_a, "true_noise"_a)
      .def("predict_random_walk", in_turn(&Filter::predict_random_walk), "body_from_next"_a, "rotation_sigma_rad"_a,
           "translation_sigma_m"_a, "duration_s"_a = 0.0, "measured_cov"_a = nb::none())
      .def("add_clone", in_turn(&Filter::add_clone), "clone_id"_a, "rate_body_radps"_a)
      .def("remove_clone", in_turn(&Filter::remove_clone), "clone_id"_a)
      .def("return_to_clone", in_turn(&Filter::return_to_clone), "clone_id"_a)
      .def("begin_frame_anew", in_turn<kReleased>(&Filter::begin_frame_anew))
      .def("observe", in_turn(&observe), "frame_index"_a, "camera"_a, "ids"_a, "pixels"_a)
      .def("update", in_turn(&update), "alive"_a, "due"_a, "first_depth_m"_a, "iterations"_a = 1, "newest_odom_from_body"_a = nb::none(),
           "sigma_scale"_a = 1.0)
      .def("correct_by_wheels", in_turn<kReleased>(&Filter::correct_by_wheels), "velocity_base_mps"_a, "yaw_rate_radps"_a, "sigma_mps"_a,
           "sigma_radps"_a, "gyro_radps"_a, "base_from_body"_a, "gate"_a)
      .def("correct_by_rest", in_turn<kReleased>(&Filter::correct_by_rest), "gyro_mean_radps"_a, "gyro_sigma_radps"_a, "gate"_a)
      .def("correct_by_speed", in_turn(&Filter::correct_by_speed), "velocity_odom_mps"_a, "sigma_mps"_a)
      .def("inflate", in_turn(&Filter::inflate), "clone_id"_a, "seen_odom_from_body"_a, "gap_s"_a)
      .def("inflate_velocity", in_turn(&Filter::inflate_velocity), "sigma_mps"_a)
      .def("motion_between", in_turn(&Filter::motion_between), "earlier_id"_a, "later_id"_a)
      .def("motion_since", in_turn(&Filter::motion_since), "clone_id"_a)
      .def("cam_from_earlier", in_turn(&Filter::cam_from_earlier), "clone_id"_a, "cam_from_body"_a, "camera"_a = 0)
      .def("odom_from_clone", in_turn(&Filter::clone), "clone_id"_a)
      .def("odom_from_body", in_turn(+[](SharedFilter& filter) { return filter.state.body(); }))
      .def("body_covariance", in_turn(&Filter::body_covariance))
      .def("nav_state", in_turn(&nav_state))
      .def_prop_ro("clone_ids", in_turn(&clone_ids))
      .def_prop_ro("velocity_covariance", in_turn(+[](SharedFilter& filter) {
                     Mat3 block;
                     for (size_t a = 0; a < 3; ++a) std::copy_n(filter.covariance[Filter::kVelocity + a] + Filter::kVelocity, 3, block[a]);
                     return block;
                   }))
      .def_prop_ro("covariance", in_turn(+[](SharedFilter& filter) { return matrix(filter.covariance); }), nb::rv_policy::automatic)
      .def_prop_ro("true_error_cov", in_turn(+[](SharedFilter& filter) { return matrix(filter.true_error_cov); }), nb::rv_policy::automatic)
      .def_prop_ro("offset_sigma_s", in_turn(+[](SharedFilter& filter) {
                     constexpr size_t offset = Filter::kConsidered + Filter::kOffset;
                     return std::sqrt(filter.true_error_cov[offset][offset]);
                   }))
      .def_prop_rw("imu_minus_cam_s", in_turn(+[](SharedFilter& filter) { return filter.imu_minus_cam_s; }),
                   in_turn(+[](SharedFilter& filter, double seconds) { filter.imu_minus_cam_s = seconds; }));
  module.def("compose_pose", &compose_pose, "map_from_body"_a, "covariance"_a, "body_from_next"_a, "cov_step"_a);
  module.def("share_that_passes", &share_that_passes, "limit"_a, "mean_square"_a);
  module.def("linearise_track", &linearise_track_of, "point"_a, "odom_from_cam"_a, "views"_a, "pixels"_a, "lenses"_a, "pixel_weight"_a,
             "disparity_weight"_a);
  module.def("triangulate", &triangulate_of, "odom_from_cam"_a, "views"_a, "pixels"_a, "lenses"_a, "pixel_weight"_a, "disparity_weight"_a,
             "start"_a);
}

}  // namespace fleetmap
