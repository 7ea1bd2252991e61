#include "imu_samples.h"  // first: Python's header comes before the system's

#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <string>

#include "filter.h"
#include "in_turn.h"
#include "pose_covariance.h"

using namespace fleetmap;

namespace {

using Vector = Array<double, 3>;
using Transform = Array<double, 4, 4>;
using Transforms = Array<double, -1, 4, 4>;
using Lenses = Array<double, -1, 4>;
using Indices = Array<int64_t, -1>;
using Noise = std::tuple<double, double, double, double>;

using SharedFilter = Shared<Filter>;

constexpr size_t kMostClones = 1000;

StereoLens lens_of(const Lenses& lenses, size_t n) { return {lenses(n, 0), lenses(n, 1), lenses(n, 2), lenses(n, 3)}; }

auto transform(const SE3& target_from_source) {
  double matrix[16];
  store(target_from_source, matrix);
  return copied<2>(matrix, {4, 4});
}

size_t index_of(const Filter& filter, int64_t clone_id) {
  const std::vector<int64_t>& ids = filter.clone_ids();
  const auto found = std::find(ids.begin(), ids.end(), clone_id);
  if (found == ids.end()) throw nb::value_error("clone_id: of a clone that is held");
  return size_t(found - ids.begin());
}

size_t newest(const Filter& filter) {
  if (filter.clone_ids().empty()) throw nb::value_error("a clone is needed");
  return filter.clone_ids().size() - 1;
}

FilterModel model_of(const Lenses& lenses, const Transforms& body_from_cams, const nb::object& settings, double gate_quantile,
                     double gravity_mps2) {
  if (lenses.shape(0) == 0 || body_from_cams.shape(0) != lenses.shape(0))
    throw nb::value_error("lenses, body_from_cams: of the same cameras, at least one");
  const auto set = [&](const char* name) { return nb::cast<double>(settings.attr(name)); };
  const double noise_share = set("noise_share");
  const PixelModel pixels{{1.0 / set("pixel_sigma_px"), 1.0 / set("disparity_sigma_px")},
                          noise_share * noise_share,
                          set("slip_along_share"),
                          set("slip_across_share"),
                          set("track_disparity_sigma_px"),
                          gate_quantile};
  std::vector<RigCamera> cameras;
  for (size_t c = 0; c < lenses.shape(0); ++c) cameras.push_back({lens_of(lenses, c), se3(body_from_cams.data() + 16 * c)});
  return {pixels,
          std::move(cameras),
          gravity_mps2,
          set("time_offset_sigma_s"),
          set("disparity_offset_sigma_px"),
          set("depth_scale_sigma"),
          set("pair_error_memory_s"),
          set("wheel_speed_scale_sigma"),
          set("wheel_yaw_scale_sigma"),
          set("wheel_slip_mps"),
          set("wheel_sigma_scale"),
          set("still_sigma_mps")};
}

void make(SharedFilter* filter, const Array<double, 3, 3>& rotation, const Vector& velocity, const Vector& position,
          const Vector& gyro_bias, const Vector& accel_bias, const Array<double, 15, 15>& nav_covariance,
          const Array<double, 15, 15>& nav_true_error, const Lenses& lenses, const Transforms& body_from_cams, const nb::object& settings,
          double gate_quantile, double gravity_mps2) {
  const NavState start{mat3(rotation.data()), vec3(velocity.data()), vec3(position.data()), vec3(gyro_bias.data()),
                       vec3(accel_bias.data())};
  const FilterModel model = model_of(lenses, body_from_cams, settings, gate_quantile, gravity_mps2);
  new (filter) SharedFilter(start, nav_covariance.data(), nav_true_error.data(), model);
}

auto predict_inertial(SharedFilter& filter, const Stamps& stamps_ns, const Rows3& gyro_radps, const Rows3& accel_mps2, int64_t start_ns,
                      int64_t end_ns, const Noise& noise, const Noise& true_noise) {
  const ImuSamples imu = imu_samples(stamps_ns, gyro_radps, accel_mps2);
  const Vec3 rate = unlocked([&] {
    return filter.propagate(imu, start_ns, end_ns, std::make_from_tuple<ImuNoise>(noise), std::make_from_tuple<ImuNoise>(true_noise));
  });
  return copied<1>(rate.at, {3});
}

void predict_random_walk(SharedFilter& filter, const Transform& body_from_next, double rotation_sigma_rad, double translation_sigma_m,
                         double duration_s, const std::optional<Array<double, 6, 6>>& measured_cov) {
  const CountedStep counted;
  filter.predict_random_walk(se3(body_from_next.data()), rotation_sigma_rad, translation_sigma_m, duration_s,
                             measured_cov ? measured_cov->data() : nullptr);
}

void add_clone(SharedFilter& filter, int64_t clone_id, const Vector& rate_body_radps) {
  if (filter.clone_ids().size() == kMostClones) throw nb::value_error("clone_id: at most 1000 clones are held");
  const CountedStep counted;
  filter.add_clone(clone_id, vec3(rate_body_radps.data()));
}

auto update(SharedFilter& filter, const Indices& alive, const Array<bool, -1>& due, double first_depth_m, int iterations,
            const std::optional<Transform>& newest_odom_from_body, double sigma_scale) {
  if (due.shape(0) != alive.shape(0)) throw nb::value_error("due: one for each alive");
  if (iterations < 1 || iterations > 1000) throw nb::value_error("iterations: 1 to 1000");
  std::optional<SE3> hint;
  if (newest_odom_from_body) hint = se3(newest_odom_from_body->data());
  const LivingPoints living{alive.data(), due.data(), alive.shape(0)};
  const std::vector<int8_t>* const used = unlocked([&] { return &filter.update(living, first_depth_m, iterations, hint, sigma_scale); });
  return as_numpy<int8_t>(std::vector<int8_t>(*used));
}

double correct_by_wheels(SharedFilter& filter, const Vector& velocity_base_mps, double yaw_rate_radps, double sigma_mps, double sigma_radps,
                         const Vector& gyro_radps, const Transform& base_from_body, double gate) {
  return unlocked([&] {
    return filter.correct_by_wheels(vec3(velocity_base_mps.data()), yaw_rate_radps, sigma_mps, sigma_radps, vec3(gyro_radps.data()),
                                    se3(base_from_body.data()), gate);
  });
}

auto motion_since(SharedFilter& filter, int64_t clone_id) {
  const size_t index = index_of(filter, clone_id);
  double covariance[36];
  filter.motion_covariance(index, covariance);
  return std::make_tuple(transform(filter.motion_between(index, newest(filter))), copied<2>(covariance, {6, 6}));
}

auto cam_from_earlier(SharedFilter& filter, int64_t clone_id, const Transform& cam_from_body, size_t camera) {
  if (camera >= filter.cameras().size()) throw nb::value_error("camera: its number");
  const SE3 body_from_earlier = inverse(filter.state.body()) * filter.clone(index_of(filter, clone_id));
  return transform(se3(cam_from_body.data()) * body_from_earlier * filter.cameras()[camera].body_from_cam);
}

auto body_covariance(SharedFilter& filter) {
  double covariance[36];
  filter.body_covariance(covariance);
  return copied<2>(covariance, {6, 6});
}

auto state_of(SharedFilter& filter) {
  const NavState& s = filter.state;
  return std::make_tuple(copied<2>(s.rotation[0], {3, 3}), copied<1>(s.velocity.at, {3}), copied<1>(s.position.at, {3}),
                         copied<1>(s.gyro_bias.at, {3}), copied<1>(s.accel_bias.at, {3}));
}

auto matrix(const Matrix& values) { return copied<2>(values[0], {values.rows, values.columns}); }

std::vector<PlacedCamera> placed(const Transforms& odom_from_cam, const Lenses& lenses) {
  if (lenses.shape(0) != odom_from_cam.shape(0)) throw nb::value_error("lenses: one for each of odom_from_cam");
  std::vector<PlacedCamera> cameras;
  for (size_t m = 0; m < lenses.shape(0); ++m) cameras.push_back({lens_of(lenses, m), se3(odom_from_cam.data() + 16 * m)});
  return cameras;
}

std::vector<Sighting> track_of(size_t cameras, const Indices& views, const Rows3& pixels) {
  if (pixels.shape(0) != views.shape(0)) throw nb::value_error("pixels: one for each of views");
  std::vector<Sighting> track;
  for (size_t n = 0; n < views.shape(0); ++n) {
    if (size_t(views(n)) >= cameras) throw nb::value_error("views: numbers of cameras");
    track.push_back({0, size_t(views(n)), pixels(n, 0), pixels(n, 1), pixels(n, 2)});
  }
  return track;
}

auto triangulate_of(const Transforms& odom_from_cam, const Indices& views, const Rows3& pixels, const Lenses& lenses, double pixel_weight,
                    double disparity_weight, const Vector& start) {
  const std::vector<PlacedCamera> cameras = placed(odom_from_cam, lenses);
  const std::vector<Sighting> track = track_of(cameras.size(), views, pixels);
  Vec3 point = vec3(start.data());
  if (!triangulate(cameras.data(), track.data(), track.size(), {pixel_weight, disparity_weight}, point)) point = {NAN, NAN, NAN};
  return copied<1>(point.at, {3});
}

auto linearise_track_of(const Vector& point, const Transforms& odom_from_cam, const Indices& views, const Rows3& pixels,
                        const Lenses& lenses, double pixel_weight, double disparity_weight) {
  const std::vector<PlacedCamera> cameras = placed(odom_from_cam, lenses);
  const std::vector<Sighting> track = track_of(cameras.size(), views, pixels);
  TrackRows rows;
  linearise_track(vec3(point.data()), cameras.data(), track.data(), track.size(), {pixel_weight, disparity_weight}, rows);
  return copied<2>(rows.values.values.data(), {rows.rows, rows.values.columns});
}

auto compose_pose(const Transform& map_from_body, const Array<double, 6, 6>& covariance, const Transform& body_from_next,
                  const Array<double, 6, 6>& cov_step) {
  const SE3 body = se3(map_from_body.data()), step = se3(body_from_next.data());
  double composed[36];
  compose_covariance(body, covariance.data(), step, cov_step.data(), composed);
  return std::make_tuple(transform(body * step), copied<2>(composed, {6, 6}));
}

}  // namespace

void bind_filter(nb::module_& module) {
  const auto clone_id = "clone_id"_a, gate = "gate"_a;
  nb::class_<SharedFilter>(module, "Filter")
      .def("__init__", &make, "rotation"_a.noconvert(), "velocity"_a.noconvert(), "position"_a.noconvert(), "gyro_bias"_a.noconvert(),
           "accel_bias"_a.noconvert(), "nav_covariance"_a.noconvert(), "nav_true_error"_a.noconvert(), "lenses"_a.noconvert(),
           "body_from_cams"_a.noconvert(), "settings"_a, "gate_quantile"_a, "gravity_mps2"_a)
      .def("predict_inertial", in_turn(&predict_inertial), "stamps_ns"_a.noconvert(), "gyro_radps"_a.noconvert(),
           "accel_mps2"_a.noconvert(), "start_ns"_a, "end_ns"_a, "noise"_a, "true_noise"_a)
      .def("predict_random_walk", in_turn(&predict_random_walk), "body_from_next"_a.noconvert(), "rotation_sigma_rad"_a,
           "translation_sigma_m"_a, "duration_s"_a = 0.0, "measured_cov"_a.noconvert() = nb::none())
      .def("add_clone", in_turn(&add_clone), clone_id, "rate_body_radps"_a.noconvert())
      .def("remove_clone", in_turn(+[](SharedFilter& filter, int64_t id) {
             const CountedStep counted;
             filter.remove_clone(index_of(filter, id));
           }),
           clone_id)
      .def("return_to_clone", in_turn(+[](SharedFilter& filter, int64_t id) { filter.return_to_clone(index_of(filter, id)); }), clone_id)
      .def("begin_frame_anew", in_turn(+[](SharedFilter& filter) {
             newest(filter);
             return transform({kIdentity, -unlocked([&] { return filter.begin_frame_anew(); })});
           }))
      .def("observe", in_turn(+[](SharedFilter& filter, int64_t frame_index, int64_t camera, const Indices& ids, const Rows3& pixels) {
             const size_t cameras = filter.cameras().size();
             if (size_t(camera) >= cameras)
               throw nb::value_error(
                   ("camera: " + std::to_string(camera) + ", but the rig has " + std::to_string(cameras) + ", counted from 0").c_str());
             if (ids.shape(0) != pixels.shape(0)) throw nb::value_error("pixels: one for each id");
             const CountedStep counted;
             filter.observe(frame_index, size_t(camera), ids.data(), pixels.data(), ids.shape(0));
           }),
           "frame_index"_a, "camera"_a, "ids"_a.noconvert(), "pixels"_a.noconvert())
      .def("update", in_turn(&update), "alive"_a.noconvert(), "due"_a.noconvert(), "first_depth_m"_a, "iterations"_a = 1,
           "newest_odom_from_body"_a.noconvert() = nb::none(), "sigma_scale"_a = 1.0)
      .def("correct_by_wheels", in_turn(&correct_by_wheels), "velocity_base_mps"_a.noconvert(), "yaw_rate_radps"_a, "sigma_mps"_a,
           "sigma_radps"_a, "gyro_radps"_a.noconvert(), "base_from_body"_a.noconvert(), gate)
      .def("correct_by_rest", in_turn(+[](SharedFilter& filter, const Vector& gyro, double sigma, double most) {
             return unlocked([&] { return filter.correct_by_rest(vec3(gyro.data()), sigma, most); });
           }),
           "gyro_mean_radps"_a.noconvert(), "gyro_sigma_radps"_a, gate)
      .def("correct_by_speed", in_turn(+[](SharedFilter& filter, const Vector& velocity, double sigma_mps) {
             filter.correct_by_speed(vec3(velocity.data()), sigma_mps);
           }),
           "velocity_odom_mps"_a.noconvert(), "sigma_mps"_a)
      .def("inflate", in_turn(+[](SharedFilter& filter, int64_t id, const Transform& seen, double gap_s) {
             return filter.inflate(index_of(filter, id), se3(seen.data()).translation, gap_s);
           }),
           clone_id, "seen_odom_from_body"_a.noconvert(), "gap_s"_a)
      .def("inflate_velocity", in_turn(+[](SharedFilter& filter, double sigma_mps) { filter.inflate_velocity(sigma_mps); }), "sigma_mps"_a)
      .def("motion_between", in_turn(+[](SharedFilter& filter, int64_t earlier, int64_t later) {
             return transform(filter.motion_between(index_of(filter, earlier), index_of(filter, later)));
           }),
           "earlier_id"_a, "later_id"_a)
      .def("body_since", in_turn(+[](SharedFilter& filter, int64_t id) {
             return transform(filter.motion_between(index_of(filter, id), newest(filter)));
           }),
           clone_id)
      .def("motion_since", in_turn(&motion_since), clone_id)
      .def("cam_from_earlier", in_turn(&cam_from_earlier), clone_id, "cam_from_body"_a.noconvert(), "camera"_a = 0)
      .def("odom_from_clone", in_turn(+[](SharedFilter& filter, int64_t id) { return transform(filter.clone(index_of(filter, id))); }),
           clone_id)
      .def("odom_from_body", in_turn(+[](SharedFilter& filter) { return transform(filter.state.body()); }))
      .def("body_covariance", in_turn(&body_covariance))
      .def("nav_state", in_turn(&state_of))
      .def_prop_ro("clone_ids", in_turn(+[](SharedFilter& filter) { return filter.clone_ids(); }))
      .def_prop_ro("covariance", in_turn(+[](SharedFilter& filter) { return matrix(filter.covariance); }), nb::rv_policy::automatic)
      .def_prop_ro("true_error_cov", in_turn(+[](SharedFilter& filter) { return matrix(filter.true_error_cov); }), nb::rv_policy::automatic)
      .def_prop_ro("offset_sigma_s", in_turn(+[](SharedFilter& filter) {
                     constexpr size_t offset = Filter::kConsidered + Filter::kOffset;
                     return std::sqrt(filter.true_error_cov[offset][offset]);
                   }))
      .def_prop_rw("imu_minus_cam_s", in_turn(+[](SharedFilter& filter) { return filter.imu_minus_cam_s; }),
                   in_turn(+[](SharedFilter& filter, double seconds) { filter.imu_minus_cam_s = seconds; }));
  module.def("compose_pose", &compose_pose, "map_from_body"_a.noconvert(), "covariance"_a.noconvert(), "body_from_next"_a.noconvert(),
             "cov_step"_a.noconvert());
  module.def("share_that_passes", &share_that_passes, "limit"_a, "mean_square"_a);
  module.def("linearise_track", &linearise_track_of, "point"_a.noconvert(), "odom_from_cam"_a.noconvert(), "views"_a.noconvert(),
             "pixels"_a.noconvert(), "lenses"_a.noconvert(), "pixel_weight"_a, "disparity_weight"_a);
  module.def("triangulate", &triangulate_of, "odom_from_cam"_a.noconvert(), "views"_a.noconvert(), "pixels"_a.noconvert(),
             "lenses"_a.noconvert(), "pixel_weight"_a, "disparity_weight"_a, "start"_a.noconvert());
}
