// The simulator's pictures: faces projected, painted by a 1/z test and shaded, and radiance developed to grey levels.
//
// Nothing here calls the maths library (square roots apart) or reorders sums, so that the same bits come out on every machine.
#include "bindings/in_turn.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>

namespace fleetmap {
namespace {

constexpr double kNearM = 0.05;
constexpr double kNever = 1e30;
constexpr double kWrap = 1048575.5;   // a multiple of every texture size, less half a texel: coordinates are positive, truncation is floor
constexpr double kMostTexels = 1e15;  // farther out than this a surface is black
constexpr double kGloss = 9.0;        // footprint area of a reflection: the polish is not perfect
constexpr double kJointM = 4.4, kTexelM = 0.0025;
constexpr int kMostSamples = 16;  // of a pixel

// An undistorted image plane in pixels.
struct Plane {
  double fx, fy, cx, cy;
  ptrdiff_t width, height;

  explicit Plane(const Array<double, 6>& plane)
      : fx(plane(0)), fy(plane(1)), cx(plane(2)), cy(plane(3)), width(whole(plane(4))), height(whole(plane(5))) {
    constexpr double kMostPx = 8192;
    if (!(plane(4) >= 1 && plane(4) <= kMostPx && plane(5) >= 1 && plane(5) <= kMostPx))
      throw nb::value_error("plane: 1 to 8192 px each way");
  }
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
constexpr int32_t kFloor = 1, kLamp = 2;  // materials; 0 is plain

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
// filter, reflectance of the floor seen from above, whether depth is filled. Shadows (M, 3): x, y, 1 / radius^2 of soft
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

using Lit = std::tuple<Array<double, -1, 9>, Array<double, -1, 6>, Array<int32_t, -1, 6>, Array<float, -1>, Reals>;
using Chunks = std::tuple<Array<int32_t, -1, 2>, Array<double, -1, 6>>;
using Atlas = std::tuple<Array<uint8_t, -1>, Array<int32_t, -1, -1>, Array<int32_t, -1, -1>, Array<int32_t, 2>>;

Textures textures_of(const Atlas& atlas) {
  const auto& [texels, table, decals, floor] = atlas;
  const int64_t count = int64_t(table.shape(0)), bytes = int64_t(texels.shape(0));
  if (table.shape(1) < 2 + kMostLevels) throw nb::value_error("textures: a row for each, of two sizes and where 12 levels begin");
  for (size_t t = 0; t < table.shape(0); ++t)
    for (int level = 0; level < kMostLevels; ++level) {
      const int32_t width = table(t, 0), height = table(t, 1), first = table(t, size_t(2 + level));
      if (width < 0 || width > 15 || height < 0 || height > 15) throw nb::value_error("textures: sides of 1 to 2^15 texels");
      const int64_t size = int64_t(1) << (std::max(width - level, 0) + std::max(height - level, 0));
      if (first < 0 || first + size > bytes) throw nb::value_error("textures: levels of the texels");
    }
  if (decals.size() == 0 || std::any_of(decals.data(), decals.data() + decals.size(), [&](int32_t decal) { return decal >> 2 >= count; }))
    throw nb::value_error("textures: decals are textures, on at least one cell");
  if (floor(0) < 0 || floor(0) >= count || floor(1) < 0 || floor(1) >= count || table(size_t(floor(0)), 2) + (1 << 18) > bytes)
    throw nb::value_error("textures: those of the floor, of which the first has 512 x 512 texels");
  return {texels.data(), table.data(), ptrdiff_t(table.shape(1)), decals.data(), ptrdiff_t(decals.shape(0)), ptrdiff_t(decals.shape(1)),
          floor(0),      floor(1)};
}

Surfaces surfaces_of(const Lit& lit, const Chunks& chunks, int64_t textures) {
  const auto& [quads, values, numbers, light, groups] = lit;
  const auto& [ranges, bounds] = chunks;
  const size_t count = quads.shape(0);
  const int64_t samples = int64_t(light.shape(0));
  check_rows(count, "faces: columns of one length", values, numbers);
  for (size_t f = 0; f < count; ++f) {
    if (numbers(f, 2) < 0 || size_t(numbers(f, 2)) >= groups.shape(0)) throw nb::value_error("faces: lamp groups that have a strength");
    if (numbers(f, 0) == kLamp) continue;
    if (numbers(f, 1) < 0 || numbers(f, 1) >= textures) throw nb::value_error("faces: textures of the table");
    const int64_t first = numbers(f, 3), columns = numbers(f, 4), rows = numbers(f, 5);
    if (first < 0 || columns < 2 || rows < 2 || first + columns * rows > samples)
      throw nb::value_error("faces: 2 x 2 light samples or more");
  }
  check_rows(ranges.shape(0), "chunks: a range and bounds of each", bounds);
  for (size_t c = 0; c < ranges.shape(0); ++c)
    if (ranges(c, 0) < 0 || ranges(c, 1) > int64_t(count)) throw nb::value_error("chunks: ranges of faces");
  return {quads.data(), values.data(), numbers.data(), light.data(), groups.data(), ranges.data(), bounds.data(), ranges.shape(0)};
}

// Bounds of x/z and y/z in a plane.
struct Limits {
  double left, right, above, below;
};

// True if all corners lie outside one side of the view pyramid; the number of those behind the near plane.
struct Outside {
  int behind = 0, left = 0, right = 0, above = 0, below = 0, count = 0;
  void add(Vec3 corner, const Limits& limits) {
    const double z = corner[2];
    behind += z < kNearM;
    left += corner[0] < limits.left * z;
    right += corner[0] > limits.right * z;
    above += corner[1] < limits.above * z;
    below += corner[1] > limits.below * z;
    ++count;
  }
  bool wholly() const { return behind == count || left == count || right == count || above == count || below == count; }
};

bool is_box_outside(const double* bounds, double sign_z, const Mat3& cam_from_map, Vec3 centre, const Limits& limits) {
  Outside outside;
  for (int corner = 0; corner < 8; ++corner)
    outside.add(cam_from_map * (Vec3{bounds[corner & 1 ? 3 : 0], bounds[corner & 2 ? 4 : 1], sign_z * bounds[corner & 4 ? 5 : 2]} - centre),
                limits);
  return outside.wholly();
}

// A pixel's footprint on a texture: shift in texels per pixel to the right and down.
struct Footprint {
  double ax, ay, bx, by;
};

// Bilinear look-up with wrap-around in the level of the given size that starts at `level`; x, y in its texels.
[[gnu::always_inline]] inline double bilinear(const uint8_t* level, int log_width, int log_height, double x, double y) {
  x += kWrap, y += kWrap;
  const int64_t column = int64_t(x), row = int64_t(y);
  const double share_x = x - double(column), share_y = y - double(row);
  const int64_t mask_x = (int64_t(1) << log_width) - 1, mask_y = (int64_t(1) << log_height) - 1;
  const int64_t x0 = column & mask_x, x1 = (column + 1) & mask_x;
  const uint8_t *row0 = level + ((row & mask_y) << log_width), *row1 = level + (((row + 1) & mask_y) << log_width);
  double upper = row0[x0], lower = row1[x0];
  upper += (row0[x1] - upper) * share_x;
  lower += (row1[x1] - lower) * share_x;
  return upper + (lower - upper) * share_y;
}

// A texture at (x, y) filtered over the footprint, in texels of its finest level: up to most_taps taps along the long axis, each from the
// nearest level; with one tap two levels are blended. area: factor on the footprint's area.
double sample(const Textures& textures, int32_t texture, double x, double y, const Footprint& footprint, int most_taps, double area,
              bool is_trilinear) {
  auto [ax, ay, bx, by] = footprint;
  double longer = ax * ax + ay * ay, shorter = bx * bx + by * by;
  if (longer < shorter) ax = bx, ay = by, std::swap(longer, shorter);
  int taps = 1;
  double extent = longer;
  if (longer > 1.0 && most_taps > 1 && longer > 2.9 * shorter) {
    const double across = std::max(shorter, 1.0);
    taps = std::min(most_taps, 2 + (longer > 6.3 * across) + (longer > 12.0 * across));
    extent = std::max(shorter, longer * (1.0 / (taps * taps)));
  }
  extent *= 0.8 * area;
  int level = 0;
  double scale = 1.0;
  while (extent >= 4.0 && level < kMostLevels - 2) extent *= 0.25, ++level, scale *= 0.5;
  const bool is_blended = taps == 1 && is_trilinear;
  if (!is_blended && extent > 2.0) ++level, scale *= 0.5;
  const int32_t *row = textures.table + texture * textures.columns, full_width = row[0], full_height = row[1];
  const int log_width = std::max(full_width - level, 0), log_height = std::max(full_height - level, 0);
  double scale_x = level > full_width ? 1.0 / double(1 << full_width) : scale;
  double scale_y = level > full_height ? 1.0 / double(1 << full_height) : scale;
  const uint8_t* texels = textures.texels + row[2 + level];
  if (taps > 1) {
    const double share = 1.0 / taps;
    ax *= share, ay *= share;
    x -= 0.5 * (taps - 1) * ax, y -= 0.5 * (taps - 1) * ay;
    double total = 0.0;
    for (int tap = 0; tap < taps; ++tap, x += ax, y += ay) total += bilinear(texels, log_width, log_height, x * scale_x, y * scale_y);
    return total * share;
  }
  double value = bilinear(texels, log_width, log_height, x * scale_x, y * scale_y);
  if (is_blended && extent > 1.05) {
    const int coarse_width = std::max(full_width - level - 1, 0), coarse_height = std::max(full_height - level - 1, 0);
    if (coarse_width < log_width) scale_x *= 0.5;
    if (coarse_height < log_height) scale_y *= 0.5;
    const double coarse = bilinear(textures.texels + row[3 + level], coarse_width, coarse_height, x * scale_x, y * scale_y);
    value += (extent - 1.0) * (1.0 / 3.0) * (coarse - value);
  }
  return value;
}

// Darkening by a saw-cut joint 12 mm wide at a distance from its centre, filtered over the footprint's width in texels.
inline double joint_factor(double distance_m, double width) {
  const double blur_m = std::max(width, 1.0) * kTexelM;
  const double cover = std::min(1.0, std::max(0.0, (0.006 + 0.5 * blur_m - distance_m) / blur_m));
  return 1.0 - 0.6 * cover * std::min(1.0, 0.012 / blur_m);
}

// Factor of the concrete's grey at texel (x, y): a coarse second tiling, decals in cells of 1.28 m, joints.
double floor_pattern(const Textures& textures, double x, double y, const Footprint& footprint, int most_taps, double area) {
  const auto [ax, ay, bx, by] = footprint;
  constexpr double kShrink = 0.155;  // the second tiling is 6.5 times larger and turned by 31 degrees
  constexpr double kCosine = 0.857 * kShrink, kSine = 0.515 * kShrink;
  const Footprint shrunk = {ax * kShrink, ay * kShrink, bx * kShrink, by * kShrink};
  double factor =
      sample(textures, textures.concrete, x * kCosine - y * kSine, x * kSine + y * kCosine, shrunk, 1, area, false) * (1.0 / 128.0);
  const int64_t column = int64_t(x * (1.0 / 512.0)), row = int64_t(y * (1.0 / 512.0));
  const int32_t decal =
      textures.decals[(row & (textures.decal_rows - 1)) * textures.decal_columns + (column & (textures.decal_columns - 1))];
  if (decal >= 0) {
    double px = 0.5 * (x - double(column) * 512.0), py = 0.5 * (y - double(row) * 512.0);
    Footprint own = {0.5 * ax, 0.5 * ay, 0.5 * bx, 0.5 * by};
    if (decal & 1) {
      const double before = px;
      px = py, py = 256.0 - before;
      own = {own.ay, -own.ax, own.by, -own.bx};
    }
    if (decal & 2) px = 256.0 - px, py = 256.0 - py;
    factor *= sample(textures, decal >> 2, px, py, own, most_taps, area, true) * (1.0 / 128.0);
  }
  const double x_m = x * kTexelM, y_m = y * kTexelM;
  const double off_x = std::abs(x_m - kJointM * std::floor(x_m * (1.0 / kJointM) + 0.5));
  const double off_y = std::abs(y_m - kJointM * std::floor(y_m * (1.0 / kJointM) + 0.5));
  if (off_x < 0.3) factor *= joint_factor(off_x, std::abs(ax) + std::abs(bx));
  if (off_y < 0.3) factor *= joint_factor(off_y, std::abs(ay) + std::abs(by));
  return factor;
}

// Radiance of a surface, and u, v, 1/z there.
struct Shade {
  double value, u, v, w;
};

// Of a face along the ray (xn, yn, 1): filtered texture times dirt times baked light. per_px: change of xn and yn per pixel.
Shade shade(const Surfaces& surfaces, const Textures& textures, const double* h, int32_t face, double xn, double yn, double per_px_x,
            double per_px_y, int most_taps, double area) {
  const double* values = surfaces.values + 6 * size_t(face);
  const int32_t* numbers = surfaces.numbers + 6 * size_t(face);
  const double w = h[6] * xn + h[7] * yn + h[8], z = 1.0 / w;
  const double u = (h[0] * xn + h[1] * yn + h[2]) * z, v = (h[3] * xn + h[4] * yn + h[5]) * z;
  if (numbers[0] == kLamp) return {values[5] * surfaces.groups[numbers[2]], u, v, w};
  const double along_u = values[0], along_v = values[1], step_x = per_px_x * z, step_y = per_px_y * z;
  const Footprint footprint = {(h[0] - u * h[6]) * step_x * along_u, (h[3] - v * h[6]) * step_x * along_v,
                               (h[1] - u * h[7]) * step_y * along_u, (h[4] - v * h[7]) * step_y * along_v};
  double x = u * along_u, y = v * along_v;
  const auto [ax, ay, bx, by] = footprint;
  if (!(std::abs(x) + std::abs(y) + std::abs(values[3]) + std::abs(values[4]) + std::abs(ax) + std::abs(ay) + std::abs(bx) + std::abs(by) <
        kMostTexels))
    return {0.0, u, v, w};
  const bool is_floor = numbers[0] == kFloor;
  if (is_floor) x += values[3], y += values[4];
  double grey = sample(textures, numbers[1], x, y, footprint, most_taps, area, true);
  if (is_floor)
    grey *= floor_pattern(textures, x, y, footprint, most_taps, area);
  else if (area == 1.0)  // a reflection is too blurred to show the dirt
    grey *= sample(textures, textures.dirt, x + values[3], y + values[4], footprint, 1, area, false) * (1.0 / 128.0);
  const int32_t columns = numbers[4], rows = numbers[5];
  double p = std::min(std::max(0.0, u), 1.0) * (columns - 1), q = std::min(std::max(0.0, v), 1.0) * (rows - 1);
  const int32_t i = std::min(int32_t(p), columns - 2), j = std::min(int32_t(q), rows - 2);
  p -= i, q -= j;
  const float *above = surfaces.light + numbers[3] + ptrdiff_t(j) * columns + i, *below = above + columns;
  const double upper = above[0] * (1.0 - p) + above[1] * p, lower = below[0] * (1.0 - p) + below[1] * p;
  const double received = upper * (1.0 - q) + lower * q;
  return {grey * (1.0 / 255.0) * values[2] * received, u, v, w};
}

// Paints the image of one camera. Holds that camera's buffers.
class ScenePainter {
 public:
  // rays (H, W, 4): a lens' x/z, y/z and their change per pixel, whose samples are looked up in the plane; no rows for a pinhole.
  ScenePainter(const Array<double, 6>& plane, const Array<float, -1, -1, 4>& rays)
      : plane_(plane), rows_(plane_.height), columns_(plane_.width) {
    if (rays.size() == 0) return;
    rows_ = ptrdiff_t(rays.shape(0)), columns_ = ptrdiff_t(rays.shape(1));
    rays_.resize(size_t(rows_ * columns_));
    for (size_t i = 0; i < rays_.size(); ++i) std::copy_n(rays.data() + 4 * i, 4, rays_[i].begin());
  }

  // Adds an instant's weighted picture to pictures of the rays' size, or of the plane's. cam_from_map: rotation.
  void add(const Lit& lit, const Chunks& chunks, const Atlas& atlas, const Mat3& cam_from_map, const Vec3& centre_map, int samples,
           std::tuple<double, double> shift, double weight, int most_taps, double reflectance, const Points& shadows, bool wants_truth,
           const MutableArray<double, -1, -1>& radiance, const MutableArray<float, -1, -1>& depth_m) {
    if (samples < 1 || samples > 4) throw nb::value_error("samples: 1 to 4");
    const auto is_picture = [&](const auto& array) { return array.shape(0) == size_t(rows_) && array.shape(1) == size_t(columns_); };
    if (!is_picture(radiance) || !is_picture(depth_m)) throw nb::value_error("radiance, depth_m: of the picture's size");
    const Textures textures = textures_of(atlas);
    const Surfaces surfaces = surfaces_of(lit, chunks, int64_t(std::get<1>(atlas).shape(0)));
    const auto [shift_x, shift_y] = shift;
    const Instant instant{samples, shift_x, shift_y, weight, most_taps, reflectance, wants_truth, shadows.data(), shadows.shape(0)};
    project(surfaces, cam_from_map, centre_map, false, direct_.polygons);
    paint(direct_, samples, shift_x, shift_y, 0);
    const ptrdiff_t first_row = first_floor_row(surfaces, samples);
    mirrored_.polygons.clear();
    if (reflectance > 0.0 && first_row < plane_.height) project(surfaces, cam_from_map, centre_map, true, mirrored_.polygons);
    paint(mirrored_, 1, 0.0, 0.0, std::max<ptrdiff_t>(0, first_row - 6));  // all of one sample per pixel
    shade_image(surfaces, textures, through_lens(samples), centre_map[2], instant, radiance, depth_m.data());
  }

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

  // The faces that may be seen; is_mirrored: of the world reflected in the floor, z -> -z.
  void project(const Surfaces& surfaces, const Mat3& cam_from_map, Vec3 centre_map, bool is_mirrored,
               std::vector<Polygon>& polygons) const {
    const double sign_z = is_mirrored ? -1.0 : 1.0;
    const Limits limits = {(-0.5 - plane_.cx) / plane_.fx, (double(plane_.width) - 0.5 - plane_.cx) / plane_.fx,
                           (-0.5 - plane_.cy) / plane_.fy, (double(plane_.height) - 0.5 - plane_.cy) / plane_.fy};
    polygons.clear();
    for (size_t chunk = 0; chunk < surfaces.chunks; ++chunk) {
      if (is_box_outside(surfaces.bounds + 6 * chunk, sign_z, cam_from_map, centre_map, limits)) continue;
      for (int32_t f = surfaces.ranges[2 * chunk]; f < surfaces.ranges[2 * chunk + 1]; ++f) {
        const double* quad = surfaces.quads + 9 * size_t(f);
        const Vec3 origin = Vec3{quad[0], quad[1], sign_z * quad[2]} - centre_map;
        const Vec3 u = {quad[3], quad[4], sign_z * quad[5]}, v = {quad[6], quad[7], sign_z * quad[8]};
        // The outward normal against the direction to the face; a reflection turns the handedness.
        if (dot(cross(v, u), origin) * sign_z >= -1e-9) continue;
        const Vec3 a = cam_from_map * u, b = cam_from_map * v, c = cam_from_map * origin;
        const Vec3 corners[4] = {c, c + a, c + a + b, c + b};
        Outside outside;
        for (const Vec3& corner : corners) outside.add(corner, limits);
        if (outside.wholly()) continue;
        // Rows of the inverse of the matrix [U V O] in camera axes, by cross products.
        const Vec3 x = cross(b, c), y = cross(c, a), z = cross(a, b);
        const double determinant = dot(a, x);
        if (std::abs(determinant) < 1e-15) continue;
        const double scale = 1.0 / determinant;
        Polygon& polygon = polygons.emplace_back();
        store(scale * x, polygon.h), store(scale * y, polygon.h + 3), store(scale * z, polygon.h + 6);
        polygon.corner_count = clip_near(corners, outside.behind > 0, polygon);
        polygon.face = f;
      }
    }
  }

  // Number of corners of the part of a quad in front of the near plane; fills the polygon's, in pixels.
  int clip_near(const Vec3* corners, bool needs_clipping, Polygon& polygon) const {
    const auto [fx, fy, cx, cy, width, height] = plane_;
    if (!needs_clipping) {
      for (int i = 0; i < 4; ++i) {
        const double inverse = 1.0 / corners[i][2];
        polygon.corners[i][0] = fx * corners[i][0] * inverse + cx, polygon.corners[i][1] = fy * corners[i][1] * inverse + cy;
      }
      return 4;
    }
    int count = 0;
    const auto add = [&](double x, double y, double z) {
      polygon.corners[count][0] = fx * x / z + cx, polygon.corners[count][1] = fy * y / z + cy;
      ++count;
    };
    for (int i = 0; i < 4; ++i) {
      const Vec3 from = corners[i], to = corners[(i + 1) & 3];
      if (!(from[2] < kNearM)) add(from[0], from[1], from[2]);
      if ((from[2] < kNearM) != (to[2] < kNearM)) {
        const double share = (kNearM - from[2]) / (to[2] - from[2]);
        add(from[0] + share * (to[0] - from[0]), from[1] + share * (to[1] - from[1]), kNearM);
      }
    }
    return count;
  }

  // Paints the polygons, all convex, where they are nearest, from first_row on. Sample (i, j) lies at pixel
  // ((j + 0.5) / samples - 0.5 + shift x, same for i and y). Ends are inclusive, so that neighbours leave no crack.
  void paint(View& view, int samples, double shift_x, double shift_y, ptrdiff_t first_row) {
    const ptrdiff_t height = plane_.height * samples, width = plane_.width * samples;
    view.nearness.assign(size_t(height * width), 0.0f), view.owner.assign(size_t(height * width), -1);
    low_.resize(size_t(height)), high_.resize(size_t(height));
    double *const low = low_.data(), *const high = high_.data();
    const double step = 1.0 / samples, start_x = 0.5 * step - 0.5 + shift_x, start_y = 0.5 * step - 0.5 + shift_y;
    for (size_t k = 0; k < view.polygons.size(); ++k) {
      const Polygon& polygon = view.polygons[k];
      double y_min = kNever, y_max = -kNever;
      for (int i = 0; i < polygon.corner_count; ++i) {
        const double y = (polygon.corners[i][1] - start_y) * samples;
        y_min = std::min(y_min, y), y_max = std::max(y_max, y);
      }
      const ptrdiff_t top = std::max(first_row, whole(std::ceil(std::max(y_min, -1.0))));
      const ptrdiff_t bottom = std::min(height - 1, whole(std::floor(std::min(y_max, double(height) + 1.0))));
      for (ptrdiff_t row = top; row <= bottom; ++row) low[row] = kNever, high[row] = -kNever;
      for (int i = 0; top <= bottom && i < polygon.corner_count; ++i) {
        const int j = i + 1 < polygon.corner_count ? i + 1 : 0;
        double px = (polygon.corners[i][0] - start_x) * samples, py = (polygon.corners[i][1] - start_y) * samples;
        double qx = (polygon.corners[j][0] - start_x) * samples, qy = (polygon.corners[j][1] - start_y) * samples;
        if (py > qy) std::swap(px, qx), std::swap(py, qy);
        const ptrdiff_t first = std::max(top, whole(std::ceil(std::max(py, -1.0))));
        const ptrdiff_t last = std::min(bottom, whole(std::floor(std::min(qy, double(height) + 1.0))));
        if (first > last) continue;
        if (qy <= py) {  // a level edge on a row of samples
          low[first] = std::min(std::min(low[first], px), qx), high[first] = std::max(std::max(high[first], px), qx);
          continue;
        }
        const double slope = (qx - px) / (qy - py);
        for (ptrdiff_t row = first; row <= last; ++row) {
          const double x = px + (double(row) - py) * slope;
          low[row] = std::min(low[row], x), high[row] = std::max(high[row], x);
        }
      }
      const double* h = polygon.h + 6;
      const double w_x = h[0] / plane_.fx * step, w_y = h[1] / plane_.fy * step;
      double w_0 = h[2] + h[0] * (start_x - plane_.cx) / plane_.fx;
      w_0 += h[1] * (start_y - plane_.cy) / plane_.fy;
      for (ptrdiff_t row = top; row <= bottom; ++row) {
        if (high[row] < -0.5 || low[row] > double(width)) continue;
        const int32_t first = int32_t(std::max<ptrdiff_t>(0, whole(std::ceil(low[row]))));
        const int32_t last = int32_t(std::min(width - 1, whole(std::floor(std::min(high[row], double(width) + 1.0)))) + 1);
        const float start = float(w_0 + w_y * double(row)), slope = float(w_x);  // of 32 bits, so that the loop is one over wide registers
        float* __restrict nearness = view.nearness.data() + row * width;
        int32_t* __restrict owner = view.owner.data() + row * width;
        const int32_t number = int32_t(k);
        for (int32_t x = first; x < last; ++x) {
          const float w = start + slope * float(x);
          const bool is_nearer = w > nearness[x];
          nearness[x] = is_nearer ? w : nearness[x];
          owner[x] = is_nearer ? number : owner[x];
        }
      }
    }
  }

  // First row of pixels of the plane that shows floor in any eighth pixel, its height without one.
  ptrdiff_t first_floor_row(const Surfaces& surfaces, int samples) const {
    for (ptrdiff_t row = 0; row < plane_.height; ++row)
      for (ptrdiff_t x = 0; x < plane_.width; x += 8) {
        const int32_t k = direct_.owner[size_t(row * samples * plane_.width * samples + x * samples)];
        if (k >= 0 && surfaces.numbers[6 * size_t(direct_.polygons[size_t(k)].face)] == kFloor) return row;
      }
    return plane_.height;
  }

  // The owner of each sample of the picture (H S, W S): that of the plane, through the lens if there is one.
  const int32_t* through_lens(int samples) {
    if (rays_.empty()) return direct_.owner.data();
    std::vector<int32_t>& indices = indices_[size_t(samples)];
    const ptrdiff_t width = plane_.width * samples, height = plane_.height * samples;
    if (indices.empty()) {
      indices.reserve(size_t(rows_ * columns_ * samples * samples));
      for (ptrdiff_t y = 0; y < rows_ * samples; ++y)
        for (ptrdiff_t x = 0; x < columns_ * samples; ++x) {
          const auto [xn, yn, per_px_x, per_px_y] = rays_[size_t(y / samples * columns_ + x / samples)];
          const double off_x = (double(x % samples) + 0.5) / samples - 0.5, off_y = (double(y % samples) + 0.5) / samples - 0.5;
          const double column = std::floor(((xn + off_x * per_px_x) * plane_.fx + plane_.cx + 0.5) * samples);
          const double row = std::floor(((yn + off_y * per_px_y) * plane_.fy + plane_.cy + 0.5) * samples);
          const bool is_inside = column >= 0.0 && column < double(width) && row >= 0.0 && row < double(height);
          indices.push_back(is_inside ? int32_t(row) * int32_t(width) + int32_t(column) : -1);
        }
    }
    seen_.resize(indices.size());
    for (size_t i = 0; i < indices.size(); ++i) seen_[i] = indices[i] >= 0 ? direct_.owner[size_t(indices[i])] : -1;
    return seen_.data();
  }

  // Samples of one polygon in a pixel are shaded once, at their mean place; owner: that of each sample. depth_m: along the optical axis, 0
  // for nothing.
  void shade_image(const Surfaces& surfaces, const Textures& textures, const int32_t* owner, double height_m, const Instant& instant,
                   Picture<double> radiance, float* depth_m) const {
    const int samples = instant.samples;
    const double wide_x = 1.0 / plane_.fx, wide_y = 1.0 / plane_.fy, step = 1.0 / samples;
    double per_px_x = wide_x, per_px_y = wide_y;
    for (ptrdiff_t y = 0; y < rows_; ++y)
      for (ptrdiff_t x = 0; x < columns_; ++x) {
        // The polygons of the pixel's samples: number of samples of each, and the sums of their positions.
        int32_t seen[kMostSamples];
        int hits[kMostSamples], sum_x[kMostSamples], sum_y[kMostSamples], count = 0;
        const int32_t* const corner = owner + (y * columns_ * samples + x) * samples;
        for (int i = 0; i < samples; ++i)
          for (int j = 0; j < samples; ++j) {
            const int32_t polygon = corner[i * columns_ * samples + j];
            const int n = int(std::find(seen, seen + count, polygon) - seen);
            if (n == count) seen[n] = polygon, hits[n] = sum_x[n] = sum_y[n] = 0, ++count;
            ++hits[n], sum_x[n] += j, sum_y[n] += i;
          }
        double total = 0.0;
        for (int n = 0; n < count; ++n) {
          if (seen[n] < 0) continue;
          const Polygon& polygon = direct_.polygons[size_t(seen[n])];
          const double off_x = (double(sum_x[n]) / hits[n] + 0.5) * step - 0.5, off_y = (double(sum_y[n]) / hits[n] + 0.5) * step - 0.5;
          double xn, yn;
          if (rays_.empty()) {
            xn = (double(x) + off_x + instant.shift_x - plane_.cx) * per_px_x;
            yn = (double(y) + off_y + instant.shift_y - plane_.cy) * per_px_y;
          } else {
            const auto& ray = rays_[size_t(y * columns_ + x)];
            per_px_x = ray[2], per_px_y = ray[3];
            xn = ray[0] + off_x * per_px_x + instant.shift_x * wide_x;
            yn = ray[1] + off_y * per_px_y + instant.shift_y * wide_y;
          }
          auto [value, u, v, w] = shade(surfaces, textures, polygon.h, polygon.face, xn, yn, per_px_x, per_px_y, instant.most_taps, 1.0);
          if (surfaces.numbers[6 * size_t(polygon.face)] == kFloor) {
            const double* quad = surfaces.quads + 9 * size_t(polygon.face);
            const double x_map = quad[0] + u * quad[3], y_map = quad[1] + v * quad[7];
            for (const double* shadow = instant.shadows; shadow < instant.shadows + 3 * instant.shadow_count; shadow += 3) {
              const double dx = x_map - shadow[0], dy = y_map - shadow[1], inside = 1.0 - (dx * dx + dy * dy) * shadow[2];
              if (inside > 0.0) value *= 1.0 - 0.55 * inside * inside;
            }
            if (instant.reflectance > 0.0 && std::abs(x_map) + std::abs(y_map) < kMostTexels) {
              // Schlick's Fresnel term; the cosine of incidence is height over distance.
              const double lack = 1.0 - std::min(height_m * w / std::sqrt(1.0 + xn * xn + yn * yn), 1.0);
              const double fresnel = instant.reflectance + (1.0 - instant.reflectance) * lack * lack * lack * lack * lack;
              // A wavy floor: the mirrored pixel moves by a slope read from the coarse tiling.
              const uint8_t* waves = textures.texels + textures.table[textures.concrete * textures.columns + 2];
              const double slope_x = bilinear(waves, 9, 9, x_map * 25.0, y_map * 25.0) - 128.0;
              const double slope_y = bilinear(waves, 9, 9, y_map * 25.0 + 77.0, x_map * 25.0) - 128.0;
              const double px = xn * plane_.fx + plane_.cx + 0.03 * slope_x, py = yn * plane_.fy + plane_.cy + 0.10 * slope_y;
              const ptrdiff_t row = std::clamp<ptrdiff_t>(whole(std::floor(py + 0.5)), 0, plane_.height - 1);
              const ptrdiff_t column = std::clamp<ptrdiff_t>(whole(std::floor(px + 0.5)), 0, plane_.width - 1);
              const int32_t m = mirrored_.owner[size_t(row * plane_.width + column)];
              if (m >= 0) {
                const Polygon& mirrored = mirrored_.polygons[size_t(m)];
                const double mx = (px - plane_.cx) * wide_x, my = (py - plane_.cy) * wide_y;
                const Shade shown = shade(surfaces, textures, mirrored.h, mirrored.face, mx, my, per_px_x, per_px_y, 1, kGloss);
                value += fresnel * 0.75 * std::min(shown.value, 4.0);
              }
            }
          }
          total += value * hits[n];
          if (instant.wants_truth && n == 0) depth_m[y * columns_ + x] = float(1.0 / w);
        }
        if (instant.wants_truth && seen[0] < 0) depth_m[y * columns_ + x] = 0.0f;
        radiance.row(y)[x] += instant.weight * total * step * step;
      }
  }

  Plane plane_;
  std::vector<std::array<float, 4>> rays_;
  ptrdiff_t rows_, columns_;  // of the picture
  View direct_, mirrored_;
  std::vector<double> low_, high_;               // ends of a polygon in each row
  std::array<std::vector<int32_t>, 5> indices_;  // of each sample in the plane, -1 outside, by samples
  std::vector<int32_t> seen_;
};

// An image (H, W) of gain * vignetting * radiance plus noise, clipped: shot noise of variance `shot` * value, read noise of this
// standard deviation, from a table of standard normals, as long as a power of two, of which each row begins at a place mixed from key.
// Source of the mixing: splitmix64.
auto develop(const Array<double, -1, -1>& radiance, double gain, double shot, double read, const Array<float, -1>& normals, int64_t key,
             const Array<float, -1, -1>& vignetting) {
  const size_t rows = radiance.shape(0), columns = radiance.shape(1);
  if (!std::has_single_bit(normals.shape(0))) throw nb::value_error("normals: as many as a power of two");
  if (vignetting.shape(0) != rows || vignetting.shape(1) != columns) throw nb::value_error("vignetting: of the picture's size");
  auto image = zeros<uint8_t>(rows * columns);
  const double* const radiance_of = radiance.data();
  const float *const normal_of = normals.data(), *const vignetting_of = vignetting.data();
  unlocked([&] {
    const uint64_t mask = normals.shape(0) - 1;
    uint64_t state = uint64_t(key) * 0x9E3779B97F4A7C15 + 0x1234567;
    for (size_t y = 0; y < rows; ++y) {
      state = (state ^ (state >> 30)) * 0xBF58476D1CE4E5B9;
      state = (state ^ (state >> 27)) * 0x94D049BB133111EB;
      state = (state ^ (state >> 31)) + 0x9E3779B97F4A7C15;
      const uint64_t start = state >> 40;
      for (size_t x = 0; x < columns; ++x) {
        const size_t at = y * columns + x;
        double value = radiance_of[at] * gain * vignetting_of[at];
        value += normal_of[(start + x) & mask] * std::sqrt(read * read + shot * value);
        image[at] = uint8_t(std::min(std::max(0.0, value + 0.5), 255.0));
      }
    }
  });
  return as_numpy<uint8_t, 2>(std::move(image), {rows, columns});
}

}  // namespace

void bind_render(nb::module_& module) {
  nb::class_<Shared<ScenePainter>>(module, "ScenePainter")
      .def(nb::init<const Array<double, 6>&, const Array<float, -1, -1, 4>&>(), "plane"_a, "rays"_a)
      .def("add", in_turn<PythonLock::kReleased>(&ScenePainter::add), "faces"_a, "chunks"_a, "textures"_a, "cam_from_map"_a, "centre_map"_a,
           "samples"_a, "shift_px"_a, "weight"_a, "most_taps"_a, "reflectance"_a, "shadows"_a, "wants_truth"_a, "radiance"_a, "depth_m"_a);
  module.def("develop", &develop, "radiance"_a, "gain"_a, "shot"_a, "read"_a, "normals"_a, "key"_a, "vignetting"_a);
}

}  // namespace fleetmap
