
#include <nanobind/stl/vector.h>

#include <algorithm>

#include "flow.h"
#include "images.h"  // first: Python's header comes before the system's
#include "observations.h"
#include "refinement.h"
#include "tracking.h"

using namespace fleetmap;

namespace {

using Levels = std::vector<Image>;  // of a pyramid

void check_window(int half) {
  if (half < 1 || half > kMostFlowHalf) throw nb::value_error("half: 1 to 7");
}

std::vector<GreyImage> greys(const Levels& levels) {
  std::vector<GreyImage> images;
  for (const Image& level : levels) images.push_back(grey(level));
  if (images.empty() || std::any_of(levels.begin(), levels.end(), [](const Image& level) { return level.size() == 0; }))
    throw nb::value_error("before, now: images that are not empty");
  return images;
}

auto follow_pixels_of(const Levels& before, const Levels& now, const Places& pixels, const Places& predicted, int half) {
  const size_t count = pixels.shape(0);
  if (predicted.shape(0) != count) throw nb::value_error("predicted: one for each pixel");
  check_window(half);
  const std::vector<GreyImage> first = greys(before), second = greys(now);
  std::vector<double> places(predicted.data(), predicted.data() + 2 * count);
  std::vector<uint8_t> found(count);
  unlocked([&] { follow_down(first, second, half, pixels.data(), places.data(), reinterpret_cast<bool*>(found.data()), count); });
  return std::make_tuple(as_numpy<double, 2>(std::move(places), {count, 2}), as_numpy<bool, 1>(std::move(found), {count}));
}

auto check_back_of(const Image& before, const Image& now, const Places& pixels, const Places& places, const Array<bool, -1>& found,
                   int half, double within_px, double margin_px) {
  const size_t count = pixels.shape(0);
  if (places.shape(0) != count || found.shape(0) != count) throw nb::value_error("places, found: one for each pixel");
  check_window(half);
  const GreyImage first = greys({before})[0], second = greys({now})[0];
  std::vector<uint8_t> held(found.data(), found.data() + count);
  unlocked([&] {
    check_back(first, second, half, pixels.data(), places.data(), within_px, margin_px, reinterpret_cast<bool*>(held.data()), count);
  });
  return as_numpy<bool, 1>(std::move(held), {count});
}

using Lens = Array<double, 4>;
using Motion = Array<double, 4, 4>;
using Points = Array<double, -1, 3>;
StereoLens lens_of(const Lens& lens) { return {lens(0), lens(1), lens(2), lens(3)}; }

auto track_points_of(const Levels& before, const Levels& now, const Points& pixels, const Motion& cam_from_previous, const Lens& lens,
                     int half, double within_px, double margin_px, int least, const Limits& refinement) {
  check_window(half);
  const TrackLimits limits{half, within_px, margin_px, size_t(std::max(least, 1)), refinement_of(refinement)};
  const std::vector<GreyImage> first = greys(before), second = greys(now);
  const size_t count = pixels.shape(0);
  PointTracks found =
      unlocked([&] { return track_points(first, second, pixels.data(), count, se3(cam_from_previous.data()), lens_of(lens), limits); });
  std::vector<double> motion(16), information(found.information, found.information + 36);
  store(found.cam_from_previous, motion.data());
  const size_t known = found.squared.size();
  return std::make_tuple(as_numpy<double, 2>(std::move(found.places), {count, 2}), as_numpy<bool, 1>(std::move(found.kept), {count}),
                         as_numpy<double, 2>(std::move(found.points_cam), {count, 3}), found.agree,
                         as_numpy<double, 2>(std::move(motion), {4, 4}), as_numpy<double, 2>(std::move(information), {6, 6}),
                         as_numpy<double, 1>(std::move(found.squared), {known}));
}

auto carry_points_of(const Points& pixels, const Points& points_cam, const Places& places, const Array<bool, -1>& kept,
                     const Motion& cam_from_previous, const Lens& lens, double limit_px) {
  const size_t count = points_cam.shape(0);
  if (pixels.shape(0) != count || places.shape(0) != count || kept.shape(0) != count)
    throw nb::value_error("pixels, places, kept: one for each point");
  std::vector<double> carried(3 * count);
  std::vector<uint8_t> stays(kept.data(), kept.data() + count);
  carry_points(pixels.data(), points_cam.data(), places.data(), count, se3(cam_from_previous.data()), lens_of(lens), limit_px,
               reinterpret_cast<bool*>(stays.data()), carried.data());
  return std::make_tuple(as_numpy<bool, 1>(std::move(stays), {count}), as_numpy<double, 2>(std::move(carried), {count, 3}));
}

auto common_ways_px_of(const Array<int64_t, -1>& old_ids, const Points& old_pixels, const Array<int64_t, -1>& ids, const Points& pixels) {
  if (old_ids.shape(0) != old_pixels.shape(0) || ids.shape(0) != pixels.shape(0)) throw nb::value_error("pixels: one for each id");
  auto ways = common_ways_px(old_ids.data(), old_pixels.data(), old_ids.shape(0), ids.data(), pixels.data(), ids.shape(0));
  const size_t count = ways.size();
  return as_numpy<double, 1>(std::move(ways), {count});
}

auto take_of(Observations& table, const Array<int64_t, -1>& alive, const Array<bool, -1>& due, const Array<int64_t, -1>& held,
             const Lens& lens, double far_px) {
  if (due.shape(0) != alive.shape(0)) throw nb::value_error("due: one for each alive");
  TrackBatch batch =
      table.take(alive.data(), due.data(), alive.shape(0), {held.data(), held.data() + held.shape(0)}, lens_of(lens), far_px);
  const size_t tracks = batch.anchors.size(), rows = batch.clones.size();
  return std::make_tuple(as_numpy<int64_t, 1>(std::move(batch.starts), {tracks + 1}), as_numpy<int64_t, 1>(std::move(batch.clones), {rows}),
                         as_numpy<double, 2>(std::move(batch.pixels), {rows, 3}), as_numpy<int64_t, 1>(std::move(batch.anchors), {tracks}),
                         as_numpy<double, 2>(std::move(batch.points_cam), {tracks, 3}));
}

}  // namespace

void bind_tracking(nb::module_& module) {
  const auto before = "before"_a.noconvert(), now = "now"_a.noconvert(), pixels = "pixels"_a.noconvert(), lens = "lens"_a.noconvert();
  const auto motion = "cam_from_previous"_a.noconvert();
  const auto half = "half"_a, within = "within_px"_a, margin = "margin_px"_a;
  module.def("follow_pixels", &follow_pixels_of, before, now, pixels, "predicted"_a.noconvert(), half);
  module.def("check_back", &check_back_of, before, now, pixels, "places"_a.noconvert(), "found"_a.noconvert(), half, within, margin);
  module.def("track_points", &track_points_of, before, now, pixels, motion, lens, half, within, margin, "least"_a, "refinement"_a);
  module.def("carry_points", &carry_points_of, pixels, "points_cam"_a.noconvert(), "places"_a.noconvert(), "kept"_a.noconvert(), motion,
             lens, "limit_px"_a);
  module.def("common_ways_px", &common_ways_px_of, "old_ids"_a.noconvert(), "old_pixels"_a.noconvert(), "ids"_a.noconvert(), pixels);
  nb::class_<Observations>(module, "Observations")
      .def(nb::init<>())
      .def(
          "add",
          [](Observations& table, int64_t frame_index, const Array<int64_t, -1>& ids, const Points& pixels) {
            if (ids.shape(0) != pixels.shape(0)) throw nb::value_error("pixels: one for each id");
            table.add(frame_index, ids.data(), pixels.data(), ids.shape(0));
          },
          "frame_index"_a, "ids"_a.noconvert(), pixels)
      .def("clear", &Observations::clear)
      .def("take", &take_of, "alive"_a.noconvert(), "due"_a.noconvert(), "held"_a.noconvert(), lens, "far_px"_a);
}
