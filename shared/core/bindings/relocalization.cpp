#include "arguments.h"  // first: Python's header comes before the system's

#include <nanobind/stl/vector.h>

#include <algorithm>
#include <numbers>

#include "relocalization.h"

namespace fleetmap {
namespace {

using Floats = Array<float, -1>;
using Cones = std::tuple<Points, Array<float, -1, 3>, Floats, Floats>;

ViewingCones cones_of(const Cones& cones) {
  const auto& [points, directions, half_angles, max_distances] = cones;
  const size_t count = points.shape(0);
  check_rows(count, "cones: a row for each landmark", directions, half_angles, max_distances);
  return {points.data(), directions.data(), half_angles.data(), max_distances.data(), count};
}

StereoImage image_of(const Array<double, 6>& pinhole, Clearance clearance = {}) {
  return {stereo_lens(pinhole.data()), pinhole(4), pinhole(5), clearance};
}

auto visible_landmarks_of(const Cones& cones, const SE3& map_from_cam, const Array<double, 6>& pinhole, float distance_scale,
                          double margin_px, double max_view_angle_rad, double octave_scale) {
  const ViewingCones landmarks = cones_of(cones);
  auto visible = unlocked([&] {
    return visible_landmarks(landmarks, map_from_cam, image_of(pinhole), distance_scale, margin_px, max_view_angle_rad, octave_scale);
  });
  const size_t found = visible.rows.size();
  return std::tuple(as_numpy<int64_t>(std::move(visible.rows)), as_numpy<double, 2>(std::move(visible.pixels), {found, 3}),
                    as_numpy<double>(std::move(visible.octaves)));
}

using Poses = Array<double, -1, 4, 4>;
using Features = std::tuple<Points, Places, Array<int8_t, -1>, Packed>;
using Unmeasured = std::tuple<Image, Image, MutableArray<double, -1, 3>, Flags>;
// Features, the pair of images, cam_from_query, and the sigmas of that motion: of rotation and position.
using EarlierFrame = std::tuple<Features, std::optional<Unmeasured>, SE3, double, double>;
constexpr size_t kMostEarlier = 16;

FixLimits limits_of(const Settings& fix, const Settings& stereo, double min_inlier_share, double octave_scale, double distance_scale,
                    const StereoImage& camera, const Limits& refinement) {
  const double nearest_px = camera.lens.focal_baseline / double(stereo["min_depth_m"]);
  return {.min_inliers = size_t(std::max(int(fix["min_inliers"]), 0)),
          .min_cells = fix["min_cells"],
          .min_inlier_share = min_inlier_share,
          .guided_radius_px = fix["guided_radius_px"],
          .max_view_angle_rad = double(fix["max_view_angle_deg"]) * (std::numbers::pi / 180.0),
          .guided_distance = fix["guided_distance"],
          .guided_ratio = fix["guided_ratio"],
          .feature_sigma_px = fix["feature_sigma_px"],
          .disparity_sigma_px = fix["disparity_sigma_px"],
          .covariance_scale = fix["covariance_scale"],
          .floor_rad = fix["floor_rad"],
          .floor_m = fix["floor_m"],
          .octave_scale = octave_scale,
          .distance_scale = distance_scale,
          .min_disparity_px = stereo["min_disparity_px"],
          .stereo = stereo_limits(stereo, std::min(nearest_px, 0.6 * camera.width)),
          .refinement = refinement_of(refinement)};
}

auto as_python(MapFix&& fix) {
  const size_t matched = fix.rows.size();
  const auto rows = [&](std::vector<double>&& values, size_t width) { return as_numpy<double, 2>(std::move(values), {matched, width}); };
  return std::tuple(fix.map_from_cam, copied<2>(fix.covariance, {6, 6}), fix.cells, fix.landmarks,
                    as_numpy<int64_t>(std::move(fix.features)), as_numpy<int64_t>(std::move(fix.rows)),
                    as_numpy<bool>(std::move(fix.inliers)),
                    std::tuple(rows(std::move(fix.points_map), 3), rows(std::move(fix.pixels), 3), rows(std::move(fix.sigmas_px), 2)),
                    as_numpy<int64_t>(std::move(fix.covisible)), as_numpy<bool>(std::move(fix.is_found)), fix.is_passed);
}

// Finds fixes in one map. The map's arrays are held as they are; the rows of places, which must stay in their bounds, are copied.
class FixFinder {
 public:
  FixFinder(const Cones& cones, const Floats& sigmas_m, const Packed& descriptors, const Poses& map_from_cam, const Indices& shown,
            const Indices& shown_from, const Array<double, 6>& pinhole, double distance_scale, double octave_scale, const nb::object& fix,
            const nb::object& stereo, double min_inlier_share, const Limits& refinement, const std::optional<Image>& clearance_px)
      : cones_(cones),
        sigmas_m_(sigmas_m),
        descriptors_(descriptors),
        map_from_cam_(map_from_cam),
        clearance_(clearance_px),
        camera_(image_of(pinhole, clearance(clearance_px))),
        limits_(limits_of({fix}, {stereo}, min_inlier_share, octave_scale, distance_scale, camera_, refinement)) {
    const size_t count = landmarks().count, places = map_from_cam.shape(0);
    check_rows(count, "sigmas_m, descriptors: a row for each landmark", sigmas_m, descriptors);
    unlocked([&] {
      shown_.assign(shown.begin(), shown.end());
      shown_from_.assign(shown_from.begin(), shown_from.end());
      if (shown_from_.size() != places + 1 || shown_from_[0] != 0 || shown_from_[places] != int64_t(shown_.size()) ||
          !std::is_sorted(shown_from_.begin(), shown_from_.end()))
        throw nb::value_error("shown_from: one more than places, rising from 0 to all of shown");
      check_below(count, "shown: rows of landmarks", shown_);
    });
  }

  auto by_projection(const Features& features, const std::optional<Unmeasured>& unmeasured, const SE3& map_from_cam, double radius_px,
                     const std::vector<EarlierFrame>& earlier) const {
    if (earlier.size() > kMostEarlier) throw nb::value_error("earlier: at most 16 frames");
    std::vector<QueryFrame> frames{frame_of(features, unmeasured)};
    for (const auto& [of_frame, of_pair, cam_from_query, sigma_rad, sigma_m] : earlier) {
      frames.push_back(frame_of(of_frame, of_pair));
      frames.back().cam_from_query = cam_from_query;
      frames.back().sigma_rad = sigma_rad, frames.back().sigma_m = sigma_m;
    }
    auto fix = unlocked([&] { return fix_by_projection(map(), frames, camera_, limits_, map_from_cam, radius_px); });
    return fix ? std::optional(as_python(std::move(*fix))) : std::nullopt;
  }

 private:
  static QueryFrame frame_of(const Features& features, const std::optional<Unmeasured>& unmeasured) {
    const auto& [pixels, left_pixels, octaves, descriptors] = features;
    const size_t count = pixels.shape(0);
    check_rows(count, "features: a row for each", left_pixels, octaves, descriptors);
    QueryFrame frame{{left_pixels.data(), octaves.data(), descriptors}, pixels.data(), {}};
    if (unmeasured) {
      const auto& [left, right, to, is_tried] = *unmeasured;
      if (!same_size(left, right)) throw nb::value_error("unmeasured: images of one size");
      check_rows(count, "unmeasured: a row for each feature", to, is_tried);
      frame.unmeasured = {{left, right}, to.data(), is_tried.data()};
    }
    return frame;
  }

  ViewingCones landmarks() const { return cones_of(cones_); }
  MapLandmarks map() const {
    return {landmarks(), sigmas_m_.data(), descriptors_, map_from_cam_.data(), shown_.data(), shown_from_.data(), map_from_cam_.shape(0)};
  }

  Cones cones_;
  Floats sigmas_m_;
  Packed descriptors_;
  Poses map_from_cam_;
  std::vector<int64_t> shown_, shown_from_;
  std::optional<Image> clearance_;
  StereoImage camera_;
  FixLimits limits_;
};

}  // namespace

void bind_relocalization(nb::module_& module) {
  nb::class_<FixFinder>(module, "FixFinder")
      .def(nb::init<const Cones&, const Floats&, const Packed&, const Poses&, const Indices&, const Indices&, const Array<double, 6>&,
                    double, double, const nb::object&, const nb::object&, double, const Limits&, const std::optional<Image>&>(),
           "cones"_a, "sigmas_m"_a, "descriptors"_a, "map_from_cam"_a, "shown"_a, "shown_from"_a, "pinhole"_a, "distance_scale"_a,
           "octave_scale"_a, "fix"_a, "stereo"_a, "min_inlier_share"_a, "refinement"_a, "clearance_px"_a = nb::none())
      .def("by_projection", &FixFinder::by_projection, "features"_a, "unmeasured"_a, "map_from_cam"_a, "radius_px"_a,
           "earlier"_a = nb::tuple());
  module.def("visible_landmarks", &visible_landmarks_of, "cones"_a, "map_from_cam"_a, "pinhole"_a, "distance_scale"_a, "margin_px"_a,
             "max_view_angle_rad"_a, "octave_scale"_a);
}

}  // namespace fleetmap
