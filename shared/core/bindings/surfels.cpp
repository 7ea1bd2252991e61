#include "arrays.h"  // first: Python's header comes before the system's

#include "surfels.h"

#include <algorithm>
#include <mutex>

using namespace fleetmap;

namespace {

using Points = Array<float, -1, 3>;
using Doubles = Array<double, -1>;
using Pairs = Array<double, -1, 2>;
using Triples = Array<double, -1, 3>;
using Levels = Array<uint8_t, -1>;
using Image32 = Array<float, -1, -1>;
using Image64 = Array<double, -1, -1>;
using Pose = Array<double, 4, 4>;

constexpr int64_t kMostPixels = 1 << 25;

template <typename Numbers>
Picture<const typename Numbers::Scalar> picture(const Numbers& image) {
  return {image.data(), ptrdiff_t(image.shape(0)), ptrdiff_t(image.shape(1))};
}

void check_levels(const Levels& levels, size_t count) {
  if (levels.shape(0) != count) throw nb::value_error("levels: one for each point");
  if (unlocked([&] { return std::any_of(levels.data(), levels.data() + count, [](uint8_t level) { return level >= kLevels; }); }))
    throw nb::value_error("levels: numbers from 0 to 4");
}

auto voxel_keys_of(const Points& points_map, const Levels& levels) {
  const size_t count = points_map.shape(0);
  check_levels(levels, count);
  auto keys = zeros<int64_t>(count);
  unlocked([&] {
    for (size_t i = 0; i < count; ++i) keys[i] = voxel_key(points_map(i, 0), points_map(i, 1), points_map(i, 2), levels(i));
  });
  return as_numpy<int64_t>(std::move(keys));
}

// A table whose calls come one after the other, whichever threads they are from.
class Table {
 public:
  void add(const Image32& disparity_px, double sigma_px, const Lens& lens, const Pose& map_from_cam, const Array<double, 2, 2>& box_map) {
    unlocked([&] {
      const std::lock_guard alone(mutex_);
      table_.add(picture(disparity_px), sigma_px, lens_of(lens), map_from_cam.data(), box_map.data(), box_map.data() + 2);
    });
  }
  auto surfels() {
    std::vector<float> points, normals;
    std::vector<uint8_t> levels;
    std::vector<int64_t> views;
    const size_t found = unlocked([&] {
      const std::lock_guard alone(mutex_);
      const size_t count = table_.size();
      points.resize(3 * count), normals.resize(3 * count), levels.resize(count), views.resize(count);
      return table_.surfels(points.data(), normals.data(), levels.data(), views.data());
    });
    return std::tuple(as_numpy<float, 2>(std::move(points), {found, 3}), as_numpy<float, 2>(std::move(normals), {found, 3}),
                      as_numpy<uint8_t, 1>(std::move(levels), {found}), as_numpy<int64_t, 1>(std::move(views), {found}));
  }

 private:
  std::mutex mutex_;
  VoxelTable table_;
};

DepthPicture depth_picture(const Image32& nearest_px, int step_px, double sigma_px, const Lens& lens, const Pose& cam_from_map,
                           double clear_sigmas, double clear_m) {
  if (step_px < 1) throw nb::value_error("step_px: at least 1");
  return {picture(nearest_px), double(step_px), sigma_px, lens_of(lens), cam_from_map.data(), clear_sigmas, clear_m};
}

auto look_at_of(const Points& points_map, const Levels& levels, const Image32& nearest_px, int step_px, double sigma_px, const Lens& lens,
                const Pose& cam_from_map, double clear_sigmas, double clear_m) {
  const size_t count = points_map.shape(0);
  check_levels(levels, count);
  const DepthPicture view = depth_picture(nearest_px, step_px, sigma_px, lens, cam_from_map, clear_sigmas, clear_m);
  auto marks = zeros<uint8_t>(count);
  auto pixels = zeros<float>(2 * count);
  unlocked([&] { look_at(points_map.data(), levels.data(), count, view, marks.data(), pixels.data()); });
  return std::tuple(as_numpy<uint8_t>(std::move(marks)), as_numpy<float, 2>(std::move(pixels), {count, 2}));
}

void weigh_of(const Points& points_map, const Levels& levels, const Image32& nearest_px, int step_px, double sigma_px, const Lens& lens,
              const Pose& cam_from_map, double clear_sigmas, double clear_m, const Array<uint8_t, -1, -1>& seen,
              const Array<double, 3>& falloff, double log_exposure, const MutableArray<double, -1, 4>& sums) {
  const size_t count = points_map.shape(0);
  check_levels(levels, count);
  if (sums.shape(0) != count) throw nb::value_error("sums: a row for each point");
  const DepthPicture view = depth_picture(nearest_px, step_px, sigma_px, lens, cam_from_map, clear_sigmas, clear_m);
  unlocked([&] { weigh(points_map.data(), levels.data(), count, view, picture(seen), vec3(falloff.data()), log_exposure, sums.data()); });
}

auto discs_before_of(const Points& points_map, const Points& normals_map, const Pose& cam_from_map, double cosine, double far_m,
                     const Lens& pinhole, int width, int height) {
  const size_t count = points_map.shape(0);
  if (normals_map.shape(0) != count) throw nb::value_error("normals_map: one for each point");
  Discs found = unlocked([&] {
    return discs_before(points_map.data(), normals_map.data(), count, cam_from_map.data(), cosine, far_m,
                        {pinhole(0), pinhole(1), pinhole(2), pinhole(3)}, width, height);
  });
  const size_t kept = found.numbers.size();
  return std::tuple(as_numpy<int32_t>(std::move(found.numbers)), as_numpy<double, 2>(std::move(found.points), {kept, 3}),
                    as_numpy<double, 2>(std::move(found.pixels), {kept, 2}));
}

auto draw_discs_of(const Array<int32_t, -1>& numbers, const Triples& points_cam, const Pairs& pixels, const Pose& cam_from_map,
                   const Points& normals_map, const Levels& levels, const Levels& colours, double far_m, double radius_edges,
                   const Array<double, -1, -1, 3>& rays, const Image32& pixels_per_rad) {
  const size_t count = numbers.shape(0), surfels = normals_map.shape(0), rows = rays.shape(0), columns = rays.shape(1);
  if (points_cam.shape(0) != count || pixels.shape(0) != count) throw nb::value_error("points_cam, pixels: one for each of numbers");
  check_levels(levels, surfels);
  if (colours.shape(0) != surfels) throw nb::value_error("colours: one for each normal");
  const auto is_other = [&](int32_t n) { return n < 0 || size_t(n) >= surfels; };
  if (unlocked([&] { return std::any_of(numbers.data(), numbers.data() + count, is_other); }))
    throw nb::value_error("numbers: of normals_map's rows");
  if (pixels_per_rad.shape(0) != rows || pixels_per_rad.shape(1) != columns) throw nb::value_error("pixels_per_rad: one for each ray");
  auto weight = zeros<float>(rows * columns), colour = zeros<float>(rows * columns), depth = zeros<float>(rows * columns);
  unlocked([&] {
    draw_discs(numbers.data(), points_cam.data(), pixels.data(), count, cam_from_map.data(), normals_map.data(), levels.data(),
               colours.data(), far_m, radius_edges, {rays.data(), pixels_per_rad.data(), ptrdiff_t(rows), ptrdiff_t(columns)},
               weight.data(), colour.data(), depth.data());
  });
  return std::tuple(as_numpy<float, 2>(std::move(weight), {rows, columns}), as_numpy<float, 2>(std::move(colour), {rows, columns}),
                    as_numpy<float, 2>(std::move(depth), {rows, columns}));
}

Gaussians gaussians_of(const Pairs& pixels, const Triples& conics, const Pairs& reaches_px, const Doubles& peaks, const Doubles& greys) {
  const size_t count = pixels.shape(0);
  if (conics.shape(0) != count || reaches_px.shape(0) != count || peaks.shape(0) != count || greys.shape(0) != count)
    throw nb::value_error("conics, reaches_px, peaks, greys: one for each of pixels");
  return {pixels.data(), conics.data(), reaches_px.data(), peaks.data(), greys.data(), count};
}

auto blend_of(const Pairs& pixels, const Triples& conics, const Pairs& reaches_px, const Doubles& peaks, const Doubles& greys, int width,
              int height) {
  const Gaussians gaussians = gaussians_of(pixels, conics, reaches_px, peaks, greys);
  if (width < 0 || height < 0 || int64_t(width) * height > kMostPixels) throw nb::value_error("width, height: up to 2^25 pixels");
  const size_t rows = size_t(height), columns = size_t(width);
  std::vector<double> through, blended;
  unlocked([&] {
    through.assign(rows * columns, 1.0), blended.resize(rows * columns);
    blend(gaussians, {through.data(), height, width}, blended.data());
  });
  return std::tuple(as_numpy<double, 2>(std::move(through), {rows, columns}), as_numpy<double, 2>(std::move(blended), {rows, columns}));
}

auto blend_backward_of(const Pairs& pixels, const Triples& conics, const Pairs& reaches_px, const Doubles& peaks, const Doubles& greys,
                       const Doubles& opacities, double blur_px2, const Image64& slopes, const Image64& whole) {
  const Gaussians gaussians = gaussians_of(pixels, conics, reaches_px, peaks, greys);
  if (opacities.shape(0) != gaussians.count) throw nb::value_error("opacities: one for each of pixels");
  if (slopes.shape(0) != whole.shape(0) || slopes.shape(1) != whole.shape(1)) throw nb::value_error("slopes: of the picture's size");
  auto gradients = zeros<double>(3 * gaussians.count);
  unlocked([&] {
    blend_backward(gaussians, opacities.data(), blur_px2, slopes.data(), whole.data(), ptrdiff_t(whole.shape(0)), ptrdiff_t(whole.shape(1)),
                   gradients.data());
  });
  return as_numpy<double, 2>(std::move(gradients), {gaussians.count, 3});
}

}  // namespace

void bind_surfels(nb::module_& module) {
  module.attr("SURFEL_EDGE_M") = kEdgeM;
  module.attr("SURFEL_LEVELS") = kLevels;
  module.attr("SPLAT_LEAST_ALPHA") = kLeastAlpha;
  module.attr("SURFEL_RANGE_M") = std::tuple(kMinRangeM, kMaxRangeM);
  const auto points_map = "points_map"_a.noconvert(), levels = "levels"_a.noconvert(), lens = "lens"_a.noconvert();
  const auto normals_map = "normals_map"_a.noconvert(), cam_from_map = "cam_from_map"_a.noconvert(), pixels = "pixels"_a.noconvert();
  const auto conics = "conics"_a.noconvert(), reaches_px = "reaches_px"_a.noconvert(), peaks = "peaks"_a.noconvert(),
             greys = "greys"_a.noconvert();
  module.def("surfel_stride_px", &stride_px, "focal_px"_a);
  module.def("voxel_keys", &voxel_keys_of, points_map, levels);
  nb::class_<Table>(module, "VoxelTable")
      .def(nb::init<>())
      .def("add", &Table::add, "disparity_px"_a.noconvert(), "sigma_px"_a, lens, "map_from_cam"_a.noconvert(), "box_map"_a.noconvert())
      .def("surfels", &Table::surfels);
  module.def("look_at", &look_at_of, points_map, levels, "nearest_px"_a.noconvert(), "step_px"_a, "sigma_px"_a, lens, cam_from_map,
             "clear_sigmas"_a, "clear_m"_a);
  module.def("weigh", &weigh_of, points_map, levels, "nearest_px"_a.noconvert(), "step_px"_a, "sigma_px"_a, lens, cam_from_map,
             "clear_sigmas"_a, "clear_m"_a, "picture"_a.noconvert(), "falloff"_a.noconvert(), "log_exposure"_a, "sums"_a.noconvert());
  module.def("discs_before", &discs_before_of, points_map, normals_map, cam_from_map, "cosine"_a, "far_m"_a, "pinhole"_a.noconvert(),
             "width"_a, "height"_a);
  module.def("draw_discs", &draw_discs_of, "numbers"_a.noconvert(), "points_cam"_a.noconvert(), pixels, cam_from_map, normals_map, levels,
             "colours"_a.noconvert(), "far_m"_a, "radius_edges"_a, "rays"_a.noconvert(), "pixels_per_rad"_a.noconvert());
  module.def("blend", &blend_of, pixels, conics, reaches_px, peaks, greys, "width"_a, "height"_a);
  module.def("blend_backward", &blend_backward_of, pixels, conics, reaches_px, peaks, greys, "opacities"_a.noconvert(), "blur_px2"_a,
             "slopes"_a.noconvert(), "whole"_a.noconvert());
}
