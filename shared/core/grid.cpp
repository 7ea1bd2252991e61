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
constexpr ptrdiff_t kStepPx = 2;      // from one disparity to the next
constexpr ptrdiff_t kRayStride = 2;   // disparities from ray to ray
constexpr double kClearSigmas = 3.0;  // and a cell: so far before a point its ray no longer proves a voxel free
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

// Marks the voxels of a ray from camera to end between these shares of its length. Behind its end, but not those in the end's own cell.
void walk(Vec3 camera, Vec3 end, double first, double until, uint8_t mark, const Window& window) {
  constexpr double kNever = std::numeric_limits<double>::infinity();
  const Vec3 along = end - camera, from = camera + first * along;
  if (!(from[0] >= 0.0 && from[0] < double(window.columns) && from[1] >= 0.0 && from[1] < double(window.rows))) return;
  const double half_rise = 0.5 * along[2];
  // Along an axis: cells to the window's end, steps in memory to the next, the share of the ray at which its cell ends, and that per cell.
  struct Axis {
    ptrdiff_t left, step;
    double next, each;
    Axis(double first, double from, double along, ptrdiff_t size, ptrdiff_t stride)
        : left(along > 0.0 ? size - ptrdiff_t(from) : ptrdiff_t(from) + 1),
          step(along > 0.0 ? stride : -stride),
          next(along != 0.0 ? first + (double(ptrdiff_t(from) + (along > 0.0)) - from) / along : kNever),
          each(along != 0.0 ? std::abs(1.0 / along) : kNever) {}
  };
  Axis x(first, from[0], along[0], window.columns, kSlices), y(first, from[1], along[1], window.rows, window.columns * kSlices);
  ptrdiff_t at = (ptrdiff_t(from[1]) * window.columns + ptrdiff_t(from[0])) * kSlices;
  double begun = first;
  while (begun < until && x.left > 0 && y.left > 0) {
    const bool is_x = x.next < y.next;  // chosen without branches, which could not be foreseen
    const double crossed = is_x ? x.next : y.next, ended = std::min(crossed, until);
    const double height = camera[2] + (begun + ended) * half_rise;
    if (begun > 1.0 && height < 0.0) return;
    const int level = height >= kFloorM ? level_at(height) : 0;
    if (level < kSlices && (begun > first || mark == kPassed)) window.looks[at + level] |= mark;
    begun = crossed, at += is_x ? x.step : y.step;
    x.next += is_x ? x.each : 0.0, y.next += is_x ? 0.0 : y.each;
    x.left -= is_x, y.left -= !is_x;
  }
}

using Image32 = Array<float, -1, -1>;

// Fills a window, which comes as zeros, from disparities in px, NaN unknown, of standard deviation sigma_px; nearest: the largest around
// each pixel, beyond whose depth nothing is proved free. camera: its x and y in cells of the window, its height over the floor in
// metres. was_free (R, C): bits of the voxels that were free before this recording, and all around them. Cells of a ray: Amanatides and
// Woo 1987; a voxel is that of the ray's height in the middle of its way through a cell.
void fill_window(Picture<const float> disparity, Picture<const float> nearest, double sigma_px, StereoLens lens, const Mat3& map_from_cam,
                 Vec3 camera, const uint8_t* was_free, Window window) {
  struct Surface {
    ptrdiff_t cell;
    int level;  // -1 for the floor
    uint8_t code;
  };
  std::vector<Surface> surfaces;
  for (ptrdiff_t u = 0; u < disparity.width; ++u)  // by columns: rays above each other cross the same cells
    for (ptrdiff_t v = 0; v < disparity.height; ++v) {
      const float px = disparity.row(v)[u];
      if (!(px > 0.0f)) continue;
      const double z = lens.focal_baseline / px, sigma = z * z / lens.focal_baseline * sigma_px;
      const double off_u = double(kStepPx * u) - lens.cx, off_v = double(kStepPx * v) - lens.cy;
      const Vec3 moved = map_from_cam * Vec3{off_u * z / lens.focal, off_v * z / lens.focal, z};
      const Vec3 end = {camera[0] + moved[0] / kCellM, camera[1] + moved[1] / kCellM, camera[2] + moved[2]};
      if (!(end[2] >= -kBelowM)) continue;
      const bool is_inside = end[0] >= 0.0 && end[0] < double(window.columns) && end[1] >= 0.0 && end[1] < double(window.rows);
      const bool is_near = sigma <= kMaxHitSigmaM, is_floor = end[2] < kFloorM, has_ray = v % kRayStride == 0 && u % kRayStride == 0;
      const ptrdiff_t cell = is_inside ? ptrdiff_t(end[1]) * window.columns + ptrdiff_t(end[0]) : -1;
      const int level = is_floor ? -1 : level_at(end[2]);
      if (is_near && cell >= 0 && level < kSlices) {
        surfaces.push_back({cell, level, uint8_t(1 + int((end[2] - kLowestM) / kHeightStepM))});
        if (level >= 0) {
          uint16_t& points = window.points[cell * kSlices + level];
          points = uint16_t(points + (points < std::numeric_limits<uint16_t>::max()));
          if (has_ray && was_free[cell] >> level & 1) walk(camera, end, 1.0, std::numeric_limits<double>::infinity(), kBehind, window);
        }
      }
      if (!has_ray) continue;
      const double clear = is_near && is_floor ? 0.0 : kClearSigmas * sigma + kCellM;
      const double free = std::min(z - clear, lens.focal_baseline / nearest.row(v)[u]);
      if (free > 0.0) walk(camera, end, 0.0, free / z, kPassed, window);
    }
  for (const Surface& surface : surfaces) {
    if (surface.level >= 0 && window.points[surface.cell * kSlices + surface.level] < kMinPoints) continue;
    uint8_t *const lowest = window.heights + 2 * surface.cell, *const highest = lowest + 1;
    if (*lowest == 0 || surface.code < *lowest) *lowest = surface.code;
    *highest = std::max(*highest, surface.code);
  }
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
// each is used, as one view may err. True if there was anything to add.
bool add_view(const MutableArray<uint16_t, -1, -1, kSlices>& points, const Voxels& looks, const MutableArray<uint8_t, -1, -1, 2>& heights,
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
  bool is_added = false;
  for (ptrdiff_t row = std::max<ptrdiff_t>(0, -first_row); row < std::min(size, rows - first_row); ++row)
    for (ptrdiff_t column = std::max<ptrdiff_t>(0, -first_column); column < std::min(size, columns - first_column); ++column) {
      const ptrdiff_t from = (row + first_row) * columns + column + first_column, to = row * size + column;
      for (int level = 0; level < kSlices; ++level) {
        const uint8_t looked = window.looks[from * kSlices + level];
        const bool is_hit = window.points[from * kSlices + level] >= kMinPoints;
        is_added |= is_hit || looked != 0;
        if (is_hit || looked != 0) count(views[is_hit ? 0 : looked & kPassed ? 1 : 2][to * kSlices + level]);
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
  return is_added;
}

}  // namespace

void bind_grid(nb::module_& module) {
  module.attr("GRID_RAY_STRIDE_PX") = kStepPx * kRayStride;
  module.attr("GRID_CLEAR_SIGMAS") = kClearSigmas;
  module.def("cast_view", &cast_view, "disparity_px"_a, "nearest_px"_a, "sigma_px"_a, "lens"_a, "map_from_cam"_a, "camera"_a, "was_free"_a);
  module.def("add_view", &add_view, "points"_a, "looks"_a, "heights"_a, "row"_a, "column"_a, "hits"_a, "passes"_a, "hidden"_a,
             "tile_heights"_a);
}

}  // namespace fleetmap
