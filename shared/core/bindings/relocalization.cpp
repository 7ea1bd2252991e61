#include "arrays.h"  // first: Python's header comes before the system's

#include "relocalization.h"

using namespace fleetmap;

namespace {

using Packed = Array<uint64_t, -1, 4>;
using Floats = Array<float, -1>;
using Cones = std::tuple<Array<double, -1, 3>, Array<float, -1, 3>, Floats, Floats>;

auto visible_landmarks_of(const Cones& cones, const Array<double, 4, 4>& map_from_cam, const Array<double, 6>& pinhole,
                          float distance_scale, double margin_px, double max_view_angle_rad, double octave_scale) {
  const auto& [points, directions, half_angles, max_distances] = cones;
  const size_t count = points.shape(0);
  if (directions.shape(0) != count || half_angles.shape(0) != count || max_distances.shape(0) != count)
    throw nb::value_error("cones: a row for each landmark");
  auto visible = unlocked([&] {
    const StereoImage camera{{pinhole(0), pinhole(1), pinhole(2), pinhole(3)}, pinhole(4), pinhole(5)};
    return visible_landmarks({points.data(), directions.data(), half_angles.data(), max_distances.data(), count}, se3(map_from_cam.data()),
                             camera, distance_scale, margin_px, max_view_angle_rad, octave_scale);
  });
  const size_t found = visible.rows.size();
  return std::make_tuple(as_numpy<int64_t, 1>(std::move(visible.rows), {found}), as_numpy<double, 2>(std::move(visible.pixels), {found, 3}),
                         as_numpy<double, 1>(std::move(visible.octaves), {found}));
}

size_t checked_cells(int cells) {
  if (cells < 1 || cells > 1024) throw nb::value_error("cells: 1 to 1024");
  return size_t(cells);
}

auto nearest_cells_of(const Packed& descriptors, const Packed& centres, int cells) {
  const size_t count = descriptors.shape(0), wanted = checked_cells(cells);
  std::vector<int32_t> found(count * wanted);
  unlocked([&] { nearest_cells({descriptors.data(), count}, {centres.data(), centres.shape(0)}, wanted, found.data()); });
  return as_numpy<int32_t, 2>(std::move(found), {count, wanted});
}

auto near_descriptors_of(const Packed& descriptors, const Packed& centres, int cells, const Packed& held, const Array<int64_t, -1>& starts,
                         int max_bits) {
  const size_t asked = checked_cells(cells), count = held.shape(0);
  if (starts.shape(0) != centres.shape(0) + 1) throw nb::value_error("starts: one more than centres");
  for (size_t c = 0; c < starts.shape(0); ++c)
    if (starts(c) < (c ? starts(c - 1) : 0) || starts(c) > int64_t(count)) throw nb::value_error("starts: rising, of held");
  std::vector<uint8_t> is_near(count);
  unlocked([&] {
    mark_near({descriptors.data(), descriptors.shape(0)}, {centres.data(), centres.shape(0)}, asked, {held.data(), count}, starts.data(),
              max_bits, is_near.data());
  });
  return as_numpy<bool, 1>(std::move(is_near), {count});
}

}  // namespace

void bind_relocalization(nb::module_& module) {
  const auto descriptors = "descriptors"_a.noconvert(), centres = "centres"_a.noconvert();
  module.def("visible_landmarks", &visible_landmarks_of, "cones"_a.noconvert(), "map_from_cam"_a.noconvert(), "pinhole"_a.noconvert(),
             "distance_scale"_a, "margin_px"_a, "max_view_angle_rad"_a, "octave_scale"_a);
  module.def("nearest_cells", &nearest_cells_of, descriptors, centres, "cells"_a);
  module.def("near_descriptors", &near_descriptors_of, descriptors, centres, "cells"_a, "held"_a.noconvert(), "starts"_a.noconvert(),
             "max_bits"_a);
}
