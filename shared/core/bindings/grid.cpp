#include "arrays.h"  // first: Python's header comes before the system's

#include "grid.h"

using namespace fleetmap;

namespace {

using Image32 = Array<float, -1, -1>;
using Voxels = MutableArray<uint8_t, -1, -1, kSlices>;

auto cast_view_of(const Image32& disparity_px, const Image32& nearest_px, double sigma_px, const Lens& lens,
                  const Array<double, 3, 3>& map_from_cam, const Array<double, 3>& camera, const Array<uint8_t, -1, -1>& was_free) {
  if (nearest_px.shape(0) != disparity_px.shape(0) || nearest_px.shape(1) != disparity_px.shape(1))
    throw nb::value_error("nearest_px: of the size of disparity_px");
  const size_t rows = was_free.shape(0), columns = was_free.shape(1), slices = kSlices;
  auto points = zeros<uint16_t>(rows * columns * slices);
  auto looks = zeros<uint8_t>(rows * columns * slices), heights = zeros<uint8_t>(2 * rows * columns);
  const ptrdiff_t height = ptrdiff_t(disparity_px.shape(0)), width = ptrdiff_t(disparity_px.shape(1));
  unlocked([&] {
    cast_view({disparity_px.data(), height, width}, {nearest_px.data(), height, width}, sigma_px, lens_of(lens), mat3(map_from_cam.data()),
              vec3(camera.data()), was_free.data(), {ptrdiff_t(rows), ptrdiff_t(columns), points.data(), looks.data(), heights.data()});
  });
  return std::tuple(as_numpy<uint16_t, 3>(std::move(points), {rows, columns, slices}),
                    as_numpy<uint8_t, 3>(std::move(looks), {rows, columns, slices}),
                    as_numpy<uint8_t, 3>(std::move(heights), {rows, columns, 2}));
}

void add_view_of(const MutableArray<uint16_t, -1, -1, kSlices>& points, const Voxels& looks,
                 const MutableArray<uint8_t, -1, -1, 2>& heights, int row, int column, const Voxels& hits, const Voxels& passes,
                 const Voxels& hidden, const MutableArray<uint8_t, -1, -1, 4>& tile_heights) {
  const size_t rows = points.shape(0), columns = points.shape(1), size = hits.shape(0);
  if (looks.shape(0) != rows || looks.shape(1) != columns || heights.shape(0) != rows || heights.shape(1) != columns)
    throw nb::value_error("looks, heights: of the size of points");
  for (const Voxels* each : {&hits, &passes, &hidden})
    if (each->shape(0) != size || each->shape(1) != size) throw nb::value_error("hits, passes, hidden: of one square tile");
  if (tile_heights.shape(0) != size || tile_heights.shape(1) != size) throw nb::value_error("tile_heights: of the tile's size");
  unlocked([&] {
    add_view({ptrdiff_t(rows), ptrdiff_t(columns), points.data(), looks.data(), heights.data()}, row, column,
             {ptrdiff_t(size), hits.data(), passes.data(), hidden.data(), tile_heights.data()});
  });
}

}  // namespace

void bind_grid(nb::module_& module) {
  module.attr("GRID_RAY_STRIDE_PX") = kRayStride;
  module.attr("GRID_CLEAR_SIGMAS") = kClearSigmas;
  module.def("cast_view", &cast_view_of, "disparity_px"_a.noconvert(), "nearest_px"_a.noconvert(), "sigma_px"_a, "lens"_a.noconvert(),
             "map_from_cam"_a.noconvert(), "camera"_a.noconvert(), "was_free"_a.noconvert());
  module.def("add_view", &add_view_of, "points"_a.noconvert(), "looks"_a.noconvert(), "heights"_a.noconvert(), "row"_a, "column"_a,
             "hits"_a.noconvert(), "passes"_a.noconvert(), "hidden"_a.noconvert(), "tile_heights"_a.noconvert());
}
