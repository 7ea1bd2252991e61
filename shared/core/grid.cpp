// The grid of a site: rays of one view through the cells of a window, and sums of views over a session.
//
// A cell is a square column of the map: below the floor margin it is floor, above it stand kSlices voxels. Within one view a voxel is
// hit, passed or not seen, so that a view counts once, however many of its pixels fall into a voxel.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <limits>

namespace fleetmap {
namespace {

constexpr double kCellM = 0.05, kFloorM = 0.10, kSliceM = 0.25;  // as of the map's format, with what follows
constexpr int kSlices = 8;
constexpr double kHeightStepM = 0.01, kLowestM = -0.16;
constexpr ptrdiff_t kHitStride = 2, kRayStride = 4;  // pixels
constexpr double kClearSigmas = 3.0;                 // and a cell: so far before a point its ray no longer proves a voxel free
constexpr uint8_t kPassed = 1, kBehind = 2;
constexpr double kBelowM = 0.15;        // deeper points are mirror images in the floor, or wrong disparities
constexpr double kMaxHitSigmaM = 0.08;  // of the depth: beyond, points only prove free space before them
constexpr uint16_t kMinPoints = 6;      // of a view in a voxel that it hits
constexpr uint8_t kMost = 255;

// Evidence of one view on a window of cells (rows, columns): pixels in each voxel (R, C, kSlices); looks (R, C, kSlices), kPassed where a
// ray went through, up to a clear distance before its point, and to the floor itself, kBehind behind points where nothing was before;
// heights (R, C, 2), codes of the lowest and the highest of the points in voxels that are hit and on the floor, 0 for none.
struct Window {
  ptrdiff_t rows, columns;
  uint16_t* points;
  uint8_t *looks, *heights;
};

// The voxel at a height over the floor margin, kSlices above the top.
inline int level_at(double height) {
  const double level = (height - kFloorM) / kSliceM;
  return level < kSlices ? int(level) : kSlices;
}

// Marks the voxels of a ray from camera to end between these shares of its length, which may lie behind its end.
void walk(Vec3 camera, Vec3 end, double first, double until, uint8_t mark, const Window& window) {
  constexpr double kNever = std::numeric_limits<double>::infinity();
  if (!(camera[0] >= 0.0 && camera[0] < double(window.columns) && camera[1] >= 0.0 && camera[1] < double(window.rows))) return;
  const Vec3 along = end - camera;
  // Along an axis: the cell, the share of the ray at which it ends, and the share of the ray per cell.
  struct Axis {
    ptrdiff_t cell, step;
    double next, each;
    Axis(double from, double along)
        : cell(ptrdiff_t(from)),
          step(along > 0.0 ? 1 : -1),
          next(along != 0.0 ? (double(cell + (step > 0)) - from) / along : kNever),
          each(along != 0.0 ? std::abs(1.0 / along) : kNever) {}
  };
  Axis x(camera[0], along[0]), y(camera[1], along[1]);
  double begun = 0.0;
  while (begun < until && x.cell >= 0 && x.cell < window.columns && y.cell >= 0 && y.cell < window.rows) {
    const double ended = std::min(std::min(x.next, y.next), until);
    const double height = camera[2] + 0.5 * (begun + ended) * along[2];
    if (begun > 1.0 && height < 0.0) return;
    const int level = height >= kFloorM ? level_at(height) : 0;
    if (level < kSlices && begun >= first) window.looks[(y.cell * window.columns + x.cell) * kSlices + level] |= mark;
    if (x.next < y.next)
      begun = x.next, x.cell += x.step, x.next += x.each;
    else
      begun = y.next, y.cell += y.step, y.next += y.each;
  }
}

using Image32 = Array<float, -1, -1>;

// Fills a window, which comes as zeros, from disparities in px, NaN unknown, of standard deviation sigma_px; nearest: the largest around
// each pixel, beyond whose depth nothing is proved free. camera: its x and y in cells of the window, its height over the floor in
// metres. was_free (R, C): bits of the voxels that were free before this recording, and all around them. Cells of a ray: Amanatides and
// Woo 1987; a voxel is that of the ray's height in the middle of its way through a cell.
void fill_window(Picture<const float> disparity, Picture<const float> nearest, double sigma_px, StereoLens lens, const Mat3& map_from_cam,
                 Vec3 camera, const uint8_t* was_free, Window window) {
  // Calls visit(u, v, depth, its standard deviation, the point as `camera`, its cell or -1) for each pixel that has a point, but those
  // below the floor.
  const auto for_each_point = [&](const auto& visit) {
    for (ptrdiff_t v = 0; v < disparity.height; v += kHitStride)
      for (ptrdiff_t u = 0; u < disparity.width; u += kHitStride) {
        const float px = disparity.row(v)[u];
        if (!(px > 0.0f)) continue;
        const double z = lens.focal_baseline / px;
        const Vec3 moved = map_from_cam * Vec3{(double(u) - lens.cx) * z / lens.focal, (double(v) - lens.cy) * z / lens.focal, z};
        const Vec3 end = {camera[0] + moved[0] / kCellM, camera[1] + moved[1] / kCellM, camera[2] + moved[2]};
        if (!(end[2] >= -kBelowM)) continue;
        const bool is_inside = end[0] >= 0.0 && end[0] < double(window.columns) && end[1] >= 0.0 && end[1] < double(window.rows);
        visit(u, v, z, z * z / lens.focal_baseline * sigma_px, end,
              is_inside ? ptrdiff_t(end[1]) * window.columns + ptrdiff_t(end[0]) : -1);
      }
  };
  for_each_point([&](ptrdiff_t u, ptrdiff_t v, double depth, double sigma, Vec3 end, ptrdiff_t cell) {
    const bool is_near = sigma <= kMaxHitSigmaM, is_floor = end[2] < kFloorM, has_ray = v % kRayStride == 0 && u % kRayStride == 0;
    if (is_near && !is_floor && cell >= 0) {
      const int level = level_at(end[2]);
      if (level < kSlices) {
        uint16_t& points = window.points[cell * kSlices + level];
        points = uint16_t(points + (points < std::numeric_limits<uint16_t>::max()));
        if (has_ray && was_free[cell] >> level & 1) walk(camera, end, 1.0, std::numeric_limits<double>::infinity(), kBehind, window);
      }
    }
    if (!has_ray) return;
    const double clear = is_near && is_floor ? 0.0 : kClearSigmas * sigma + kCellM;
    const double free = std::min(depth - clear, lens.focal_baseline / nearest.row(v)[u]);
    if (free > 0.0) walk(camera, end, 0.0, free / depth, kPassed, window);
  });
  for_each_point([&](ptrdiff_t, ptrdiff_t, double, double sigma, Vec3 end, ptrdiff_t cell) {
    if (sigma > kMaxHitSigmaM || cell < 0) return;
    const int level = end[2] >= kFloorM ? level_at(end[2]) : -1;
    if (level >= kSlices || (level >= 0 && window.points[cell * kSlices + level] < kMinPoints)) return;
    const uint8_t code = uint8_t(1 + int((end[2] - kLowestM) / kHeightStepM));
    uint8_t *lowest = window.heights + 2 * cell, *highest = lowest + 1;
    if (*lowest == 0 || code < *lowest) *lowest = code;
    *highest = std::max(*highest, code);
  });
}

auto cast_view(const Image32& disparity_px, const Image32& nearest_px, double sigma_px, const StereoLens& lens, const Mat3& map_from_cam,
               const Vec3& camera, const Image& was_free) {
  if (!same_size(nearest_px, disparity_px)) throw nb::value_error("nearest_px: of the size of disparity_px");
  const size_t rows = was_free.shape(0), columns = was_free.shape(1), slices = kSlices;
  auto points = zeros<uint16_t>(rows * columns * slices);
  auto looks = zeros<uint8_t>(rows * columns * slices), heights = zeros<uint8_t>(2 * rows * columns);
  unlocked([&] {
    fill_window(disparity_px, nearest_px, sigma_px, lens, map_from_cam, camera, was_free.data(),
                {ptrdiff_t(rows), ptrdiff_t(columns), points.data(), looks.data(), heights.data()});
  });
  return std::tuple(as_numpy<uint16_t, 3>(std::move(points), {rows, columns, slices}),
                    as_numpy<uint8_t, 3>(std::move(looks), {rows, columns, slices}),
                    as_numpy<uint8_t, 3>(std::move(heights), {rows, columns, 2}));
}

using Voxels = MutableArray<uint8_t, -1, -1, kSlices>;

// Adds a window to a tile whose cell (0, 0) is the window's cell (row, column). A tile of N cells each way: views that hit, pass and would
// pass each voxel (N, N, kSlices), which stop at 255, and (N, N, 4) the two lowest and the two highest codes of all views; the second of
// each is used, as one view may err.
void add_view(const MutableArray<uint16_t, -1, -1, kSlices>& points, const Voxels& looks, const MutableArray<uint8_t, -1, -1, 2>& heights,
              int at_row, int at_column, const Voxels& hits, const Voxels& passes, const Voxels& hidden,
              const MutableArray<uint8_t, -1, -1, 4>& tile_heights) {
  const ptrdiff_t first_row = at_row, first_column = at_column;
  const ptrdiff_t rows = ptrdiff_t(points.shape(0)), columns = ptrdiff_t(points.shape(1)), size = ptrdiff_t(hits.shape(0));
  if (!same_size(looks, points) || !same_size(heights, points)) throw nb::value_error("looks, heights: of the size of points");
  if (hits.shape(0) != hits.shape(1) || !same_size(passes, hits) || !same_size(hidden, hits))
    throw nb::value_error("hits, passes, hidden: of one square tile");
  if (!same_size(tile_heights, hits)) throw nb::value_error("tile_heights: of the tile's size");
  const Window window{rows, columns, points.data(), looks.data(), heights.data()};
  uint8_t *const views[] = {hits.data(), passes.data(), hidden.data()}, *const codes = tile_heights.data();
  const auto count = [](uint8_t& seen) { seen = uint8_t(seen + (seen < kMost)); };
  const nb::gil_scoped_release others_run;
  for (ptrdiff_t row = std::max<ptrdiff_t>(0, -first_row); row < std::min(size, rows - first_row); ++row)
    for (ptrdiff_t column = std::max<ptrdiff_t>(0, -first_column); column < std::min(size, columns - first_column); ++column) {
      const ptrdiff_t from = (row + first_row) * columns + column + first_column, to = row * size + column;
      for (int level = 0; level < kSlices; ++level) {
        const uint8_t looked = window.looks[from * kSlices + level];
        const bool is_hit = window.points[from * kSlices + level] >= kMinPoints;
        if (is_hit || looked & (kPassed | kBehind)) count(views[is_hit ? 0 : looked & kPassed ? 1 : 2][to * kSlices + level]);
      }
      const uint8_t low = window.heights[2 * from], high = window.heights[2 * from + 1];
      if (low == 0) continue;
      uint8_t* const known = codes + 4 * to;
      if (known[0] == 0 || low < known[0])
        known[1] = std::exchange(known[0], low);
      else if (known[1] == 0 || low < known[1])
        known[1] = low;
      if (high > known[2])
        known[3] = std::exchange(known[2], high);
      else if (high > known[3])
        known[3] = high;
    }
}

}  // namespace

void bind_grid(nb::module_& module) {
  module.attr("GRID_RAY_STRIDE_PX") = kRayStride;
  module.attr("GRID_CLEAR_SIGMAS") = kClearSigmas;
  module.def("cast_view", &cast_view, "disparity_px"_a, "nearest_px"_a, "sigma_px"_a, "lens"_a, "map_from_cam"_a, "camera"_a, "was_free"_a);
  module.def("add_view", &add_view, "points"_a, "looks"_a, "heights"_a, "row"_a, "column"_a, "hits"_a, "passes"_a, "hidden"_a,
             "tile_heights"_a);
}

}  // namespace fleetmap
