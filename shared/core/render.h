// The simulator's pictures: faces projected, painted by a 1/z test and shaded, and radiance developed to grey levels.
//
// Nothing here calls the maths library (square roots apart) or reorders sums, so that the same bits come out on every machine.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "lie.h"
#include "picture.h"

namespace fleetmap {

// An undistorted image plane in pixels.
struct Plane {
  double fx, fy, cx, cy;
  ptrdiff_t width, height;
};

// Parallelograms, in columns of F rows: quads (F, 9), origin, edge U and edge V in map, metres, whose outward normal is V x U; values
// (F, 6), texels along U and V, tint, offset of the dirt (of a floor: of the concrete) in texels, emission; numbers (F, 6), material,
// texture, lamp group, first light sample, light samples along U and V. light: of each sample at this moment; groups: strengths of lamps.
// Chunks: ranges (C, 2) of faces, and bounds (C, 6), the least and largest x, y, z of their corners.
struct Surfaces {
  const double *quads, *values;
  const int32_t* numbers;
  const float* light;
  const double* groups;
  const int32_t* ranges;
  const double* bounds;
  size_t chunks;
};
constexpr int32_t kPlain = 0, kFloor = 1, kLamp = 2;  // materials

// Textures with all their coarser levels, one after the other. table (T, columns): logarithms of width and height, where each level
// begins. decals: texture * 4 + quarter turns for each cell of the floor, -1 for none. The last two: the textures of concrete and dirt.
struct Textures {
  const uint8_t* texels;
  const int32_t* table;
  ptrdiff_t columns;
  const int32_t* decals;
  ptrdiff_t decal_rows, decal_columns;
  int32_t concrete, dirt;
};
constexpr int kMostLevels = 12;  // that are read

// One instant of an exposure: samples per pixel side, shift of the samples in pixels, weight in the picture, most taps of a texture's
// filter, reflectance of the floor seen from above, whether depth and faces are filled. Shadows (M, 3): x, y, 1 / radius^2 of soft
// contact shadows on the floor.
struct Instant {
  int samples;
  double shift_x, shift_y, weight;
  int most_taps;
  double reflectance;
  bool wants_truth;
  const double* shadows;
  size_t shadow_count;
};

// A picture in the making (H, W): radiance, depth along the optical axis, 0 for nothing, face of each pixel, -1 for nothing.
struct Canvas {
  Picture<double> radiance;
  float* depth_m;
  int32_t* faces;
};

// Paints the image of one camera. Holds that camera's buffers.
class ScenePainter {
 public:
  // rays (H, W, 4): a lens' x/z, y/z and their change per pixel, whose samples are looked up in the plane; no rows for a pinhole.
  ScenePainter(Plane plane, Picture<const float> rays);
  // Adds an instant's weighted picture to the canvas, which is of the rays' size, or of the plane's. cam_from_map: rotation.
  void add(const Surfaces& surfaces, const Textures& textures, const Mat3& cam_from_map, Vec3 centre_map, const Instant& instant,
           const Canvas& canvas);

 private:
  struct Polygon {  // of a visible face: (u', v', 1/z) = h (x/z, y/z, 1), u = u' z; its outline in pixels, clipped
    double h[9], corners[8][2];
    int corner_count;
    int32_t face;
  };
  struct View {
    std::vector<Polygon> polygons;
    std::vector<float> nearness;  // 1/z and visible polygon of each sample
    std::vector<int32_t> owner;
  };

  void project(const Surfaces& surfaces, const Mat3& cam_from_map, Vec3 centre_map, bool is_mirrored, std::vector<Polygon>& polygons) const;
  int clip_near(const Vec3* corners, bool needs_clipping, Polygon& polygon) const;
  void paint(View& view, int samples, double shift_x, double shift_y, ptrdiff_t first_row);
  ptrdiff_t first_floor_row(const Surfaces& surfaces, int samples) const;
  const int32_t* through_lens(int samples);
  void shade_image(const Surfaces& surfaces, const Textures& textures, const int32_t* owner, double height_m, const Instant& instant,
                   const Canvas& canvas) const;

  Plane plane_;
  std::vector<std::array<float, 4>> rays_;
  ptrdiff_t rows_, columns_;  // of the picture
  View direct_, mirrored_;
  std::vector<double> low_, high_;               // ends of a polygon in each row
  std::array<std::vector<int32_t>, 5> indices_;  // of each sample in the plane, -1 outside, by samples
  std::vector<int32_t> seen_;
};

// Fills image (H, W) with gain * vignetting * radiance plus noise, clipped: shot noise of variance `shot` * value, read noise of this
// standard deviation, from a table of standard normals, as long as a power of two, of which each row begins at a place mixed from key.
// Source of the mixing: splitmix64.
void develop(Picture<const double> radiance, double gain, double shot, double read, const float* normals, size_t normal_count, uint64_t key,
             const float* vignetting, uint8_t* image);

}  // namespace fleetmap
