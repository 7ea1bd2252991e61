#include "images.h"  // first: Python's header comes before the system's

#include <nanobind/stl/vector.h>

#include <algorithm>
#include <numbers>

#include "refinement.h"
#include "relocalization.h"

using namespace fleetmap;

namespace {

using Packed = Array<uint64_t, -1, 4>;
using Floats = Array<float, -1>;
using Cones = std::tuple<Array<double, -1, 3>, Array<float, -1, 3>, Floats, Floats>;

using Rows = nb::ndarray<nb::numpy, int64_t, nb::ndim<1>>;
using Flags = nb::ndarray<nb::numpy, bool, nb::ndim<1>>;
using Reals2 = nb::ndarray<nb::numpy, double, nb::ndim<2>>;

ViewingCones cones_of(const Cones& cones) {
  const auto& [points, directions, half_angles, max_distances] = cones;
  const size_t count = points.shape(0);
  if (directions.shape(0) != count || half_angles.shape(0) != count || max_distances.shape(0) != count)
    throw nb::value_error("cones: a row for each landmark");
  return {points.data(), directions.data(), half_angles.data(), max_distances.data(), count};
}

auto visible_landmarks_of(const Cones& cones, const Array<double, 4, 4>& map_from_cam, const Array<double, 6>& pinhole,
                          float distance_scale, double margin_px, double max_view_angle_rad, double octave_scale) {
  const ViewingCones landmarks = cones_of(cones);
  auto visible = unlocked([&] {
    const StereoImage camera{{pinhole(0), pinhole(1), pinhole(2), pinhole(3)}, pinhole(4), pinhole(5)};
    return visible_landmarks(landmarks, se3(map_from_cam.data()), camera, distance_scale, margin_px, max_view_angle_rad, octave_scale);
  });
  const size_t found = visible.rows.size();
  return std::make_tuple(as_numpy<int64_t>(std::move(visible.rows)), as_numpy<double, 2>(std::move(visible.pixels), {found, 3}),
                         as_numpy<double>(std::move(visible.octaves)));
}

using Poses = Array<double, -1, 4, 4>;
using Indices = Array<int64_t, -1>;
using Features = std::tuple<Array<double, -1, 3>, Places, Array<int8_t, -1>, Packed>;
using Unmeasured = std::tuple<Image, Image, MutableArray<double, -1, 3>, MutableArray<bool, -1>>;
// Features, the pair of images, cam_from_query, and the sigmas of that motion: of rotation and position.
using EarlierFrame = std::tuple<Features, std::optional<Unmeasured>, Array<double, 4, 4>, double, double>;
constexpr size_t kMostEarlier = 16;

// Finds fixes in one map. The map's arrays are held as they are; the rows of places, which must stay in their bounds, are copied.
class FixFinder {
 public:
  FixFinder(const Cones& cones, const Floats& sigmas_m, const Packed& descriptors, const Poses& map_from_cam, const Indices& shown,
            const Indices& shown_from, const Array<double, 6>& pinhole, double distance_scale, double octave_scale, nb::object fix,
            nb::object stereo, double min_inlier_share, const Limits& refinement, const std::optional<Image>& clearance_px)
      : cones_(cones),
        sigmas_m_(sigmas_m),
        descriptors_(descriptors),
        map_from_cam_(map_from_cam),
        clearance_(clearance_px),
        camera_{{pinhole(0), pinhole(1), pinhole(2), pinhole(3)}, pinhole(4), pinhole(5), clearance(clearance_px)} {
    const size_t count = landmarks().count, places = map_from_cam.shape(0);
    if (sigmas_m.shape(0) != count || descriptors.shape(0) != count)
      throw nb::value_error("sigmas_m, descriptors: a row for each landmark");
    unlocked([&] {
      shown_.assign(shown.data(), shown.data() + shown.size());
      shown_from_.assign(shown_from.data(), shown_from.data() + shown_from.size());
      if (shown_from_.size() != places + 1 || shown_from_[0] != 0 || shown_from_[places] != int64_t(shown_.size()) ||
          !std::is_sorted(shown_from_.begin(), shown_from_.end()))
        throw nb::value_error("shown_from: one more than places, rising from 0 to all of shown");
      for (const int64_t row : shown_)
        if (row < 0 || row >= int64_t(count)) throw nb::value_error("shown: rows of landmarks");
    });
    auto real = [](const nb::object& from, const char* name) { return nb::cast<double>(from.attr(name)); };
    auto whole = [](const nb::object& from, const char* name) { return nb::cast<int>(from.attr(name)); };
    limits_.min_inliers = size_t(std::max(whole(fix, "min_inliers"), 0)), limits_.min_cells = whole(fix, "min_cells");
    limits_.min_inlier_share = min_inlier_share;
    limits_.guided_radius_px = real(fix, "guided_radius_px");
    limits_.max_view_angle_rad = real(fix, "max_view_angle_deg") * (std::numbers::pi / 180.0);
    limits_.guided_distance = whole(fix, "guided_distance"), limits_.guided_ratio = real(fix, "guided_ratio");
    limits_.feature_sigma_px = real(fix, "feature_sigma_px"), limits_.disparity_sigma_px = real(fix, "disparity_sigma_px");
    limits_.covariance_scale = real(fix, "covariance_scale");
    limits_.floor_rad = real(fix, "floor_rad"), limits_.floor_m = real(fix, "floor_m");
    limits_.octave_scale = octave_scale, limits_.distance_scale = distance_scale;
    limits_.min_disparity_px = real(stereo, "min_disparity_px");
    const double nearest = camera_.lens.focal_baseline / real(stereo, "min_depth_m");
    limits_.stereo = {std::min(nearest, 0.6 * camera_.width), real(stereo, "min_correlation"), real(stereo, "uniqueness"),
                      whole(stereo, "wide_half_px"),          whole(stereo, "narrow_half_px"), real(stereo, "agreement_px")};
    if (!(limits_.stereo.max_disparity_px >= 0.0 && limits_.stereo.max_disparity_px <= 1e5))
      throw nb::value_error("pinhole: disparities of 0 to 100,000 px");
    for (const int half : {limits_.stereo.wide_half, limits_.stereo.narrow_half})
      if (half < 1 || half > kMostStereoHalf) throw nb::value_error("stereo: windows of 1 to 7");
    limits_.refinement = refinement_of(refinement);
  }

  double median_distance_m(const Array<double, 4, 4>& map_from_cam) const {
    return unlocked([&] { return median_distance(map(), camera_, limits_, se3(map_from_cam.data())); });
  }

  auto by_projection(const Features& features, const std::optional<Unmeasured>& unmeasured, const Array<double, 4, 4>& map_from_cam,
                     double radius_px, const std::vector<EarlierFrame>& earlier) const {
    if (earlier.size() > kMostEarlier) throw nb::value_error("earlier: at most 16 frames");
    std::vector<QueryFrame> frames{frame_of(features, unmeasured)};
    for (const auto& [of_frame, of_pair, cam_from_query, sigma_rad, sigma_m] : earlier) {
      frames.push_back(frame_of(of_frame, of_pair));
      frames.back().cam_from_query = se3(cam_from_query.data());
      frames.back().sigma_rad = sigma_rad, frames.back().sigma_m = sigma_m;
    }
    auto fix = unlocked([&] { return fix_by_projection(map(), frames, camera_, limits_, se3(map_from_cam.data()), radius_px); });
    using Fix = decltype(as_python(std::move(*fix)));
    return fix ? std::optional<Fix>(as_python(std::move(*fix))) : std::nullopt;
  }

 private:
  static QueryFrame frame_of(const Features& features, const std::optional<Unmeasured>& unmeasured) {
    const auto& [pixels, left_pixels, octaves, descriptors] = features;
    const size_t count = pixels.shape(0);
    if (left_pixels.shape(0) != count || octaves.shape(0) != count || descriptors.shape(0) != count)
      throw nb::value_error("features: a row for each");
    QueryFrame frame{{left_pixels.data(), octaves.data(), {descriptors.data(), count}}, pixels.data(), {}};
    if (unmeasured) {
      const auto& [left, right, to, is_tried] = *unmeasured;
      if (!same_size(left, right)) throw nb::value_error("unmeasured: images of one size");
      if (to.shape(0) != count || is_tried.shape(0) != count) throw nb::value_error("unmeasured: a row for each feature");
      frame.unmeasured = {{grey(left), grey(right)}, to.data(), is_tried.data()};
    }
    return frame;
  }

  static std::tuple<Reals2, Reals2, int, size_t, Rows, Rows, Flags, std::tuple<Reals2, Reals2, Reals2>, Rows, Flags, bool> as_python(
      MapFix&& fix) {
    std::vector<double> place(16);
    store(fix.map_from_cam, place.data());
    const size_t matched = fix.rows.size();
    return {as_numpy<double, 2>(std::move(place), {4, 4}),
            copied<2>(fix.covariance, {6, 6}),
            fix.cells,
            fix.landmarks,
            as_numpy<int64_t>(std::move(fix.features)),
            as_numpy<int64_t>(std::move(fix.rows)),
            as_numpy<bool>(std::move(fix.inliers)),
            {as_numpy<double, 2>(std::move(fix.points_map), {matched, 3}), as_numpy<double, 2>(std::move(fix.pixels), {matched, 3}),
             as_numpy<double, 2>(std::move(fix.sigmas_px), {matched, 2})},
            as_numpy<int64_t>(std::move(fix.covisible)),
            as_numpy<bool>(std::move(fix.is_found)),
            fix.is_passed};
  }

  ViewingCones landmarks() const { return cones_of(cones_); }
  MapLandmarks map() const {
    const Descriptors descriptors{descriptors_.data(), descriptors_.shape(0)};
    return {landmarks(), sigmas_m_.data(), descriptors, map_from_cam_.data(), shown_.data(), shown_from_.data(), map_from_cam_.shape(0)};
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

size_t checked_cells(int cells) {
  if (cells < 1 || cells > 1024) throw nb::value_error("cells: 1 to 1024");
  return size_t(cells);
}

auto nearest_cells_of(const Packed& descriptors, const Packed& centres, int cells) {
  const size_t count = descriptors.shape(0), wanted = checked_cells(cells);
  auto found = zeros<int32_t>(count * wanted);
  unlocked([&] { nearest_cells({descriptors.data(), count}, {centres.data(), centres.shape(0)}, wanted, found.data()); });
  return as_numpy<int32_t, 2>(std::move(found), {count, wanted});
}

auto near_descriptors_of(const Packed& descriptors, const Packed& centres, int cells, const Packed& held, const Array<int64_t, -1>& starts,
                         int max_bits) {
  const size_t asked = checked_cells(cells), count = held.shape(0);
  if (starts.shape(0) != centres.shape(0) + 1) throw nb::value_error("starts: one more than centres");
  for (size_t c = 0; c < starts.shape(0); ++c)
    if (starts(c) < (c ? starts(c - 1) : 0) || starts(c) > int64_t(count)) throw nb::value_error("starts: rising, of held");
  auto is_near = zeros<uint8_t>(count);
  unlocked([&] {
    mark_near({descriptors.data(), descriptors.shape(0)}, {centres.data(), centres.shape(0)}, asked, {held.data(), count}, starts.data(),
              max_bits, is_near.data());
  });
  return as_numpy<bool>(std::move(is_near));
}

}  // namespace

void bind_relocalization(nb::module_& module) {
  nb::class_<FixFinder>(module, "FixFinder")
      .def(nb::init<const Cones&, const Floats&, const Packed&, const Poses&, const Indices&, const Indices&, const Array<double, 6>&,
                    double, double, nb::object, nb::object, double, const Limits&, const std::optional<Image>&>(),
           "cones"_a.noconvert(), "sigmas_m"_a.noconvert(), "descriptors"_a.noconvert(), "map_from_cam"_a.noconvert(),
           "shown"_a.noconvert(), "shown_from"_a.noconvert(), "pinhole"_a.noconvert(), "distance_scale"_a, "octave_scale"_a, "fix"_a,
           "stereo"_a, "min_inlier_share"_a, "refinement"_a, "clearance_px"_a.noconvert().none() = nb::none())
      .def("median_distance_m", &FixFinder::median_distance_m, "map_from_cam"_a.noconvert())
      .def("by_projection", &FixFinder::by_projection, "features"_a.noconvert(), "unmeasured"_a.noconvert().none(),
           "map_from_cam"_a.noconvert(), "radius_px"_a, "earlier"_a = std::vector<EarlierFrame>());
  const auto descriptors = "descriptors"_a.noconvert(), centres = "centres"_a.noconvert();
  module.def("visible_landmarks", &visible_landmarks_of, "cones"_a.noconvert(), "map_from_cam"_a.noconvert(), "pinhole"_a.noconvert(),
             "distance_scale"_a, "margin_px"_a, "max_view_angle_rad"_a, "octave_scale"_a);
  module.def("nearest_cells", &nearest_cells_of, descriptors, centres, "cells"_a);
  module.def("near_descriptors", &near_descriptors_of, descriptors, centres, "cells"_a, "held"_a.noconvert(), "starts"_a.noconvert(),
             "max_bits"_a);
}
