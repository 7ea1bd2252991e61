#include "arguments.h"  // first: Python's header comes before the system's

#include <nanobind/stl/vector.h>

#include <algorithm>

#include "in_turn.h"
#include "tracking.h"

namespace fleetmap {
namespace {

using Images = std::vector<nb::ndarray<nb::numpy, uint8_t, nb::ndim<2>>>;
using SharedTracker = Shared<Tracker>;
constexpr int kMostLevels = 30;

int checked_half(int half) {
  if (half < 1 || half > kMostFlowHalf) throw nb::value_error("half: 1 to 7");
  return half;
}

size_t checked_levels(int levels) {
  if (levels < 0 || levels > kMostLevels) throw nb::value_error("levels: 0 to 30");
  return size_t(levels);
}

GreyImage pictured(const Image& image) {
  if (image.size() == 0) throw nb::value_error("images: not empty");
  return image;
}

Images halvings(const Image& image, int count) {
  Pyramid pyramid;
  const size_t levels = checked_levels(count);
  unlocked([&] { pyramid.set(pictured(image)), pyramid.level(levels); });
  Images halved;
  for (size_t level = 1; level <= levels; ++level) {
    const GreyImage of = pyramid.level(level);
    const size_t height = size_t(of.height), width = size_t(of.width);
    auto pixels = unlocked([&] { return std::vector<uint8_t>(of.at, of.at + height * width); });
    halved.push_back(as_numpy<uint8_t, 2>(std::move(pixels), {height, width}));
  }
  return halved;
}

auto follow_pixels_of(const Image& before, const Image& now, const Places& pixels, const Places& predicted, int half, int levels,
                      double within_px, double margin_px) {
  const size_t count = pixels.shape(0);
  check_rows(count, "predicted: one for each pixel", predicted);
  Pyramid first, second;
  std::vector<double> places(predicted.data(), predicted.data() + 2 * count), back(2 * count);
  std::vector<uint8_t> found(count);
  const size_t down_from = checked_levels(levels);
  checked_half(half);
  unlocked([&] {
    first.set(pictured(before)), second.set(pictured(now));
    bool* const held = reinterpret_cast<bool*>(found.data());
    follow_down(first, second, down_from, half, pixels.data(), places.data(), held, count);
    check_back(first.level(0), second.level(0), half, pixels.data(), places.data(), within_px, margin_px, held, back.data(), count);
  });
  return std::tuple(as_numpy<double, 2>(std::move(places), {count, 2}), as_numpy<bool>(std::move(found)));
}

void make_tracker(SharedTracker* tracker, const StereoLens& lens, const nb::object& section, const nb::object& stereo,
                  double max_disparity_px, const Limits& refinement) {
  constexpr int kThreshold = 12, kBorderPx = 8;
  constexpr int64_t kMostPoints = 100'000;
  const Settings settings{section}, of_pair{stereo};
  const StereoLimits limits = stereo_limits(of_pair, max_disparity_px);
  new (tracker) SharedTracker(TrackerModel{lens,
                                           checked_half(int(settings["window_px"]) / 2),
                                           checked_levels(settings["pyramid_levels"]),
                                           settings["back_check_px"],
                                           settings["ransac_px"],
                                           size_t(std::clamp<int64_t>(settings["max_points"], 0, kMostPoints)),
                                           size_t(std::max(int(settings["min_inliers"]), 1)),
                                           {kThreshold, kBorderPx, settings["min_distance_px"]},
                                           refinement_of(refinement),
                                           limits,
                                           of_pair["min_disparity_px"]});
}

// Images that a frame can lack: the right one, and both at half size.
using RightAndHalves = std::tuple<Image, Image, Image>;

auto track_of(SharedTracker& tracker, const Image& left, const std::optional<RightAndHalves>& pair,
              const std::optional<Array<float, -1, -1>>& disparity_px, const std::optional<SE3>& cam_from_previous, bool is_predicted,
              const std::optional<Points>& points_cam, const std::optional<Image>& clearance_px) {
  const GreyImage image = pictured(left);
  if (clearance_px && !same_size(left, *clearance_px)) throw nb::value_error("clearance_px: of the image's size");
  TrackerFrame frame{{image, {}}, {}, {}, clearance(clearance_px)};
  if (pair) {
    const auto& [right, left_half, right_half] = *pair;
    if (!same_size(left, right) || !same_size(left_half, right_half)) throw nb::value_error("pair: right images of the left ones' size");
    frame.whole.right = pictured(right), frame.halved = {pictured(left_half), pictured(right_half)};
  }
  if (disparity_px && !same_size(left, *disparity_px)) throw nb::value_error("disparity_px: of the image's size");
  if (disparity_px) frame.disparity_px = *disparity_px;
  if (points_cam && points_cam->shape(0) != tracker.ids().size()) throw nb::value_error("points_cam: one for each point");
  if (cam_from_previous && !tracker.has_begun()) throw nb::value_error("cam_from_previous: there is none, begin with a frame");
  check_corners(tracker.model().corners.distance, double(image.width), double(image.height));
  TrackedMotion found;
  unlocked([&] {
    if (cam_from_previous) found = tracker.follow(image, *cam_from_previous, is_predicted, points_cam ? points_cam->data() : nullptr);
    tracker.renew(frame);
  });
  std::optional<std::tuple<SE3, nb::ndarray<nb::numpy, double, nb::ndim<2>>>> motion;
  if (found.is_known) motion.emplace(found.cam_from_previous, copied<2>(found.information, {6, 6}));
  return std::tuple(motion, found.kept_share);
}

auto common_ways_px_of(const Indices& old_ids, const Points& old_pixels, const Indices& ids, const Points& pixels) {
  if (old_ids.shape(0) != old_pixels.shape(0) || ids.shape(0) != pixels.shape(0)) throw nb::value_error("pixels: one for each id");
  return as_numpy<double>(common_ways_px(old_ids.data(), old_pixels.data(), old_ids.shape(0), ids.data(), pixels.data(), ids.shape(0)));
}

}  // namespace

void bind_tracking(nb::module_& module) {
  module.def("halvings", &halvings, "image"_a, "count"_a);
  module.def("follow_pixels", &follow_pixels_of, "before"_a, "now"_a, "pixels"_a, "predicted"_a, "half"_a, "levels"_a, "within_px"_a,
             "margin_px"_a);
  nb::class_<SharedTracker>(module, "Tracker")
      .def("__init__", &make_tracker, "lens"_a, "settings"_a, "stereo"_a, "max_disparity_px"_a, "refinement"_a)
      .def("begin", in_turn(+[](SharedTracker& tracker, const Image& image) { unlocked([&] { tracker.begin(pictured(image)); }); }),
           "left"_a)
      .def("add", in_turn(+[](SharedTracker& tracker, const Points& of) { return tracker.add(of.data(), of.shape(0)); }), "pixels"_a)
      .def("track", in_turn(&track_of), "left"_a, "pair"_a, "disparity_px"_a, "cam_from_previous"_a, "is_predicted"_a, "points_cam"_a,
           "clearance_px"_a = nb::none())
      .def_prop_ro("ids", in_turn(+[](SharedTracker& tracker) { return as_numpy<int64_t>(std::vector(tracker.ids())); }),
                   nb::rv_policy::automatic)
      .def_prop_ro("pixels", in_turn(+[](SharedTracker& tracker) { return copied<2>(tracker.pixels().data(), {tracker.ids().size(), 3}); }),
                   nb::rv_policy::automatic);
  module.def("common_ways_px", &common_ways_px_of, "old_ids"_a, "old_pixels"_a, "ids"_a, "pixels"_a);
}

}  // namespace fleetmap
