#include "grid.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace fleetmap {
namespace {

constexpr double kBelowM = 0.15;        // deeper points are mirror images in the floor, or wrong disparities
constexpr double kMaxHitSigmaM = 0.08;  // of the depth: beyond, points only prove free space before them
constexpr uint16_t kMinPoints = 6;      // of a view in a voxel that it hits
constexpr uint8_t kMost = 255;

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

}  // namespace

void cast_view(Picture<const float> disparity, Picture<const float> nearest, double sigma_px, StereoLens lens, const Mat3& map_from_cam,
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

void add_view(Window window, ptrdiff_t first_row, ptrdiff_t first_column, GridTile tile) {
  const auto count = [](uint8_t& views) { views = uint8_t(views + (views < kMost)); };
  for (ptrdiff_t row = std::max<ptrdiff_t>(0, -first_row); row < std::min(tile.size, window.rows - first_row); ++row)
    for (ptrdiff_t column = std::max<ptrdiff_t>(0, -first_column); column < std::min(tile.size, window.columns - first_column); ++column) {
      const ptrdiff_t from = (row + first_row) * window.columns + column + first_column, to = row * tile.size + column;
      for (int level = 0; level < kSlices; ++level) {
        const uint8_t looks = window.looks[from * kSlices + level];
        if (window.points[from * kSlices + level] >= kMinPoints)
          count(tile.hits[to * kSlices + level]);
        else if (looks & kPassed)
          count(tile.passes[to * kSlices + level]);
        else if (looks & kBehind)
          count(tile.hidden[to * kSlices + level]);
      }
      const uint8_t low = window.heights[2 * from], high = window.heights[2 * from + 1];
      if (low == 0) continue;
      uint8_t* known = tile.heights + 4 * to;
      if (known[0] == 0 || low < known[0])
        known[1] = known[0], known[0] = low;
      else if (known[1] == 0 || low < known[1])
        known[1] = low;
      if (high > known[2])
        known[3] = known[2], known[2] = high;
      else if (high > known[3])
        known[3] = high;
    }
}

}  // namespace fleetmap
