// Surfels: points of views merged in voxels, checks of voxels against free space in views, discs drawn into a picture for any lens, and
// Gaussians blended into one. Lengths are metres; cam_from_map (4, 4) row by row; pictures row by row.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "camera.h"
#include "lie.h"
#include "picture.h"

namespace fleetmap {

// A voxel's edge is a power of two times kEdgeM, as fine as the pixel that falls into it: distant points are kept coarsely.
constexpr double kEdgeM = 0.01;
constexpr int kLevels = 5;
constexpr double kMinRangeM = 0.3, kMaxRangeM = 12.0;

// One of so many pixels in a row or column is merged, so that a surface at a metre has voxels of kEdgeM: finer ones cost as the square.
int stride_px(double focal);

// The voxel of a point at a level, in 63 bits: 5 km each way at the finest level. Points farther out are clamped to that border.
int64_t voxel_key(double x, double y, double z, int level);

// Voxels of one recording, extended view by view.
class VoxelTable {
 public:
  // Adds the points of a view that lie in the box from low to high (x, y) of the map. disparity: of every stride_px-th pixel, NaN unknown,
  // of standard deviation sigma_px. Points and normals are means by the inverse variance of the depth.
  void add(Picture<const float> disparity, double sigma_px, StereoLens lens, const double* map_from_cam, const double* low,
           const double* high);
  // Fills mean points (N, 3) in map, unit normals (N, 3), levels (N,), and numbers of views, of those voxels whose normals do
  // not cancel out; returns their number.
  size_t surfels(float* points, float* normals, uint8_t* levels, int64_t* views) const;
  size_t size() const { return voxels_.size(); }

 private:
  struct Voxel {
    int64_t key;
    float weight, offset[3], normal[3];  // sums; offsets are from the voxel's corner
    int32_t last_view, views;
  };
  size_t slot_of(int64_t key) const;
  void make_room(size_t more);

  std::vector<Voxel> voxels_;
  std::vector<int32_t> slots_;  // of a power of two, at most half of them taken: numbers of voxels, -1 none
  int32_t views_ = 0;
  std::vector<float> around_;  // of the view that is added
};

enum Mark : uint8_t { kUnseen, kSeen, kSeenThrough };

// Depths of a view. nearest_px: of every step_px-th pixel the largest disparity around it, 0 where its own is unknown. A point must lie
// clear_sigmas standard deviations of the depth, and clear_m, before the pixel's depth to be seen through.
struct DepthPicture {
  Picture<const float> nearest_px;
  double step_px, sigma_px;
  StereoLens lens;
  const double* cam_from_map;
  double clear_sigmas, clear_m;
};

// Evidence of a view on `count` points (N, 3) in map of voxels of these levels (N,): marks (N,), and pixels (N, 2) of points in range, else
// 0.
void look_at(const float* points, const uint8_t* levels, size_t count, const DepthPicture& view, uint8_t* marks, float* pixels);

// Adds what a view says of points, as of `look_at`, to sums (N, 4): 1 if it sees the point; its weight in views if it sees through it, as
// a view that sees more finely than the voxel was seen counts more; and, of seen points, the grey level of the picture relative to the
// exposure and to the lens, of these coefficients by powers of the squared tangent, over distance^4, and 1 over distance^4.
void weigh(const float* points, const uint8_t* levels, size_t count, const DepthPicture& view, Picture<const uint8_t> picture, Vec3 falloff,
           double log_exposure, double* sums);

// A lens that bends nothing, in pixels; fx is 0 for any other.
struct Pinhole {
  double fx, fy, cx, cy;
};

// Discs of a picture: numbers of surfels, their points in the camera and their pixels.
struct Discs {
  std::vector<int32_t> numbers;
  std::vector<Vec3> points;
  std::vector<std::array<double, 2>> pixels;
};

// Of `count` discs (N, 3) with normals (N, 3), in map, those that face the camera within a cone, of this cosine of the half angle and
// this length: near the picture of width x height where the lens is a pinhole, for which alone pixels are filled.
Discs discs_before(const float* points_map, const float* normals_map, size_t count, const double* cam_from_map, double cosine, double far_m,
                   Pinhole pinhole, double width, double height);

// A view of H x W pixels: their unit rays (H, W, 3) in the camera, NaN for none, and the finest pixels per radian around each (H, W).
struct Rays {
  const double* at;
  const float* pixels_per_rad;
  ptrdiff_t height, width;
};

// Draws discs (M, 3) in the camera, pixels (M, 2) of their centres, of surfels of these numbers (M,), whose normals in map (N, 3),
// levels and colours (N,) follow: each pixel's ray is cut with the disc's plane, and what lies close behind the nearest disc is one
// surface with it. Radii are in edges. Fills weight, colour and depth along the ray (H, W), which come as 0: the last two are sums that
// the weight divides, 0 where nothing is known. Source: Zwicker et al. 2001, surface splatting.
void draw_discs(const int32_t* numbers, const double* points_cam, const double* pixels, size_t count, const double* cam_from_map,
                const float* normals_map, const uint8_t* levels, const uint8_t* colours, double far_m, double radius_edges, Rays rays,
                float* weight, float* colour, float* depth);

constexpr double kLeastAlpha = 1.0 / 255.0;  // smaller coverage of a pixel is not drawn

// `count` Gaussians in a picture, front to back: pixels (M, 2) of their centres, conics (M, 3) xx, xy, yy of the inverse covariances,
// reaches (M, 2) in px beyond which the least alpha is not reached, peaks (M,) of alpha and greys (M,).
struct Gaussians {
  const double *pixels, *conics, *reaches_px, *peaks, *greys;
  size_t count;
};

// Blends them: through (H, W), which comes as 1, is the share of light that passes all, picture (H, W) comes as 0.
// Source: Kerbl et al. 2023.
void blend(const Gaussians& gaussians, Picture<double> through, double* picture);

// Fills gradients (M, 3) of a loss, whose slopes by the picture are (H, W), by grey, logarithm of the size and logit of the opacity
// (M,). whole: the picture as `blend` made it. The pixels' own blur_px2 is on the diagonal of the covariances.
// Source: Kerbl et al. 2023; Mip-Splatting, Yu et al. 2024.
void blend_backward(const Gaussians& gaussians, const double* opacities, double blur_px2, const double* slopes, const double* whole,
                    ptrdiff_t height, ptrdiff_t width, double* gradients);

}  // namespace fleetmap
