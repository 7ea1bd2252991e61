// The grid of a site: rays of one view through the cells of a window, and sums of views over a session.
//
// A cell is a square column of the map: below the floor margin it is floor, above it stand kSlices voxels. Within one view a voxel is
// hit, passed or not seen, so that a view counts once, however many of its pixels fall into a voxel.
#pragma once

#include <cstddef>
#include <cstdint>

#include "camera.h"
#include "lie.h"
#include "picture.h"

namespace fleetmap {

constexpr double kCellM = 0.05, kFloorM = 0.10, kSliceM = 0.25;  // as of the map's format, with what follows
constexpr int kSlices = 8;
constexpr double kHeightStepM = 0.01, kLowestM = -0.16;
constexpr ptrdiff_t kHitStride = 2, kRayStride = 4;  // pixels
constexpr double kClearSigmas = 3.0;                 // and a cell: so far before a point its ray no longer proves a voxel free
constexpr uint8_t kPassed = 1, kBehind = 2;

// Evidence of one view on a window of cells (rows, columns): pixels in each voxel (R, C, kSlices); looks (R, C, kSlices), kPassed where a
// ray went through, up to a clear distance before its point, and to the floor itself, kBehind behind points where nothing was before;
// heights (R, C, 2), codes of the lowest and the highest of the points in voxels that are hit and on the floor, 0 for none.
struct Window {
  ptrdiff_t rows, columns;
  uint16_t* points;
  uint8_t *looks, *heights;
};

// Fills a window, which comes as zeros, from disparities in px, NaN unknown, of standard deviation sigma_px; nearest: the largest around
// each pixel, beyond whose depth nothing is proved free. camera: its x and y in cells of the window, its height over the floor in
// metres. was_free (R, C): bits of the voxels that were free before this recording, and all around them. Cells of a ray: Amanatides and
// Woo 1987; a voxel is that of the ray's height in the middle of its way through a cell.
void cast_view(Picture<const float> disparity, Picture<const float> nearest, double sigma_px, StereoLens lens, const Mat3& map_from_cam,
               Vec3 camera, const uint8_t* was_free, Window window);

// A tile of `size` cells each way: views that hit, pass and would pass each voxel (N, N, kSlices), which stop at 255, and (N, N, 4) the
// two lowest and the two highest codes of all views; the second of each is used, as one view may err.
struct GridTile {
  ptrdiff_t size;
  uint8_t *hits, *passes, *hidden, *heights;
};

// Adds a window to a tile whose cell (0, 0) is the window's cell (first_row, first_column).
void add_view(Window window, ptrdiff_t first_row, ptrdiff_t first_column, GridTile tile);

}  // namespace fleetmap
