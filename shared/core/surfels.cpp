// Surfels: points of views merged in voxels, checks of voxels against free space in views, discs drawn into a picture for any lens, and
// Gaussians blended into one. Lengths are metres; pictures row by row.
#include "bindings/in_turn.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace fleetmap {
namespace {

using FloatPoints = Array<float, -1, 3>;
using Levels = Array<uint8_t, -1>;
using Image32 = Array<float, -1, -1>;
using Image64 = Array<double, -1, -1>;

// A voxel's edge is a power of two times kEdgeM, as fine as the pixel that falls into it: distant points are kept coarsely.
constexpr double kEdgeM = 0.01;
constexpr int kLevels = 5;
constexpr double kMinRangeM = 0.3, kMaxRangeM = 12.0;

constexpr double kMaxSigmaShare = 0.06;  // standard deviation of a depth, as a share of it
constexpr double kFootprintShare = 1.5;  // least edge of a voxel, in steps from pixel to pixel that merge in it
// Square around a pixel whose disparities give the normal: half size in pixels and in samples, largest difference to its own, least number.
constexpr ptrdiff_t kFitPx = 6, kLeastReach = 2, kMostReach = 3, kFitLanes = 8;
constexpr float kFitApartPx = 1.0f;
constexpr double kMinFit = 12.0;
constexpr int kBits = 20;
constexpr double kHalfSpan = double(1 << (kBits - 1));

constexpr double kMinPixels = 0.75;  // least radius of a disc, so that no disc falls between the pixels
// What lies so far behind the nearest disc is one surface with it: edges, and what grows with their square. Depths err with the square
// of the distance from which a disc was seen, and its edge grows with that distance.
constexpr double kThickEdges = 3.0, kThickPerM = 100.0;
constexpr double kMargin = 1.15;      // pixels are finer on one side of a disc than in its middle
constexpr double kMostPixels = 96.0;  // of a disc that the camera touches
constexpr int kBins = 64;             // of distances
constexpr ptrdiff_t kBlockPx = 8;     // squares of pixels whose farthest surface is known,
constexpr size_t kLooks = 24;         // and largest number of probes

constexpr double kHidden = 1e-4;  // share of the light at which a pixel is full

// One of so many pixels in a row or column is merged, so that a surface at a metre has voxels of kEdgeM: finer ones cost as the square.
int stride_px(double focal) { return kEdgeM * focal / kFootprintShare < 2.5 ? 2 : 4; }

inline double edge_of(int level) { return kEdgeM * double(1 << level); }

// The edge of voxels for each metre of depth.
inline double edges_per_m(double focal) { return kFootprintShare * stride_px(focal) / focal; }

// Of a voxel that a camera sees at this depth.
inline int level_at(double depth, double per_m) {
  int level = 0;
  while (level < kLevels - 1 && edge_of(level) < per_m * depth) ++level;
  return level;
}

// The normal, in the camera and towards it, of the plane through the disparities around the pixel (u, v); false without one. corner: upper
// left one of the square around it, in a picture of every stride-th disparity with rows so far apart. A plane is affine in
// (u, v, disparity), so that its gradient is its normal: least squares over disparities like the middle one.
bool fit_normal(const float* corner, ptrdiff_t row_step, int stride, ptrdiff_t reach, double u, double v, StereoLens lens, Vec3& normal) {
  const float middle = corner[reach * row_step + reach];
  // Sums of a column each, to be made at once; the last ones are no part of the square.
  float ns[kFitLanes] = {}, ds[kFitLanes] = {}, yns[kFitLanes] = {}, yyns[kFitLanes] = {}, yds[kFitLanes] = {};
  for (ptrdiff_t row = 0; row <= 2 * reach; ++row) {
    const float y = float((row - reach) * stride);
    const float* const here = corner + row * row_step;
    for (ptrdiff_t lane = 0; lane < kFitLanes; ++lane) {
      const float apart = here[lane] - middle;
      const bool is_like = std::abs(apart) <= kFitApartPx;  // false for NaN
      const float one = is_like ? 1.0f : 0.0f, d = is_like ? apart : 0.0f;
      ns[lane] += one, ds[lane] += d, yns[lane] += y * one, yyns[lane] += y * y * one, yds[lane] += y * d;
    }
  }
  double n = 0, su = 0, sv = 0, sd = 0, suu = 0, svv = 0, suv = 0, sud = 0, svd = 0;
  for (ptrdiff_t lane = 0; lane <= 2 * reach; ++lane) {
    const double x = double((lane - reach) * stride);
    n += ns[lane], su += x * ns[lane], sv += yns[lane], sd += ds[lane];
    suu += x * x * ns[lane], svv += yyns[lane], suv += x * yns[lane];
    sud += x * ds[lane], svd += yds[lane];
  }
  if (n < kMinFit) return false;
  suu -= su * su / n, svv -= sv * sv / n, suv -= su * sv / n;
  sud -= su * sd / n, svd -= sv * sd / n;
  const double determinant = suu * svv - suv * suv;
  if (determinant <= 1e-6) return false;
  const double a = (sud * svv - svd * suv) / determinant, b = (svd * suu - sud * suv) / determinant;
  const double off_u = u - lens.cx, off_v = v - lens.cy;
  normal = {-a * lens.focal, -b * lens.focal, -(double(middle) - a * off_u - b * off_v)};
  const double length = norm(normal), towards = dot(normal, {off_u / lens.focal, off_v / lens.focal, 1.0});
  if (length <= 0.0 || towards >= 0.0) return false;
  normal = normal / length;
  return true;
}

// The voxel of a point at a level, in 63 bits: 5 km each way at the finest level. Points farther out are clamped to that border.
int64_t voxel_key(double x, double y, double z, int level) {
  const double edge = edge_of(level);
  uint64_t key = uint64_t(level);
  for (const double along : {x, y, z}) {
    const double cell = std::floor(along / edge) + kHalfSpan;
    key = key << kBits | uint64_t(int64_t(std::min(std::max(0.0, cell), 2.0 * kHalfSpan - 1.0)));  // 0 for NaN
  }
  return int64_t(key);
}

void check_levels(const Levels& levels, size_t count) {
  check_rows(count, "levels: one for each point", levels);
  unlocked([&] { check_below(kLevels, "levels: numbers from 0 to 4", levels); });
}

auto voxel_keys(const FloatPoints& points_map, const Levels& levels) {
  const size_t count = points_map.shape(0);
  check_levels(levels, count);
  auto keys = zeros<int64_t>(count);
  unlocked([&] {
    for (size_t i = 0; i < count; ++i) keys[i] = voxel_key(points_map(i, 0), points_map(i, 1), points_map(i, 2), levels(i));
  });
  return keys;
}

// Voxels of one recording, extended view by view.
class VoxelTable {
 public:
  // Adds the points of a view that lie in the box (2, 2) of the map, its low and its high (x, y). disparity: of every stride_px-th pixel,
  // NaN unknown, of standard deviation sigma_px. Points and normals are means by the inverse variance of the depth.
  void add(const Image32& disparity_px, double sigma_px, const StereoLens& lens, const SE3& map_from_cam,
           const Array<double, 2, 2>& box_map) {
    const Picture<const float> disparity = disparity_px;
    const double *const low = &box_map(0, 0), *const high = &box_map(1, 0);
    make_room(size_t(disparity.height) * size_t(disparity.width));
    const int stride = stride_px(lens.focal);
    const double per_m = edges_per_m(lens.focal);
    const ptrdiff_t reach = std::clamp<ptrdiff_t>(kFitPx / stride, kLeastReach, kMostReach);
    const ptrdiff_t row_step = disparity.width + kFitLanes;  // with unknown disparities all around
    around_.assign(size_t((disparity.height + 2 * reach) * row_step + kFitLanes), std::numeric_limits<float>::quiet_NaN());
    for (ptrdiff_t row = 0; row < disparity.height; ++row)
      std::copy_n(disparity.row(row), disparity.width, around_.begin() + (row + reach) * row_step + reach);
    for (ptrdiff_t row = 0; row < disparity.height; ++row)
      for (ptrdiff_t column = 0; column < disparity.width; ++column) {
        const float px = disparity.row(row)[column];
        if (!(px > 0.0f)) continue;
        const double z = lens.focal_baseline / px, sigma = z * z / lens.focal_baseline * sigma_px;
        if (!(z >= kMinRangeM && z <= kMaxRangeM) || sigma > kMaxSigmaShare * z) continue;
        const double u = double(column * stride), v = double(row * stride);
        const Vec3 point = map_from_cam * Vec3{(u - lens.cx) * z / lens.focal, (v - lens.cy) * z / lens.focal, z};
        if (!(point[0] >= low[0] && point[0] < high[0] && point[1] >= low[1] && point[1] < high[1])) continue;
        Vec3 normal;
        if (!fit_normal(around_.data() + row * row_step + column, row_step, stride, reach, u, v, lens, normal)) continue;
        const int level = level_at(z, per_m);
        const Vec3 turned = map_from_cam.rotation * normal;
        const int64_t key = voxel_key(point[0], point[1], point[2], level);
        int32_t& slot = slots_[slot_of(key)];
        if (slot < 0) {
          slot = int32_t(voxels_.size());
          voxels_.push_back({key, 0.0f, {}, {}, -1, 0});
        }
        Voxel& voxel = voxels_[size_t(slot)];
        const double edge = edge_of(level), weight = 1e-4 / (sigma * sigma);
        voxel.weight = float(voxel.weight + weight);
        for (int axis = 0; axis < 3; ++axis) {
          voxel.offset[axis] = float(voxel.offset[axis] + weight * (point[axis] - std::floor(point[axis] / edge) * edge));
          voxel.normal[axis] = float(voxel.normal[axis] + weight * turned[axis]);
        }
        if (voxel.last_view != views_) voxel.last_view = views_, ++voxel.views;
      }
    ++views_;
  }

  using Triple = std::array<float, 3>;
  // Mean points in map, unit normals, levels, and numbers of views, of those voxels whose normals do not cancel out.
  using Surfels = std::tuple<std::vector<Triple>, std::vector<Triple>, std::vector<uint8_t>, std::vector<int64_t>>;
  Surfels surfels() const {
    Surfels found;
    auto& [points, normals, levels, views] = found;
    const size_t most = voxels_.size();
    points.reserve(most), normals.reserve(most), levels.reserve(most), views.reserve(most);
    for (const Voxel& voxel : voxels_) {
      const Vec3 normal = {voxel.normal[0], voxel.normal[1], voxel.normal[2]};
      const double length = norm(normal);
      if (!(length > 1e-9)) continue;
      const int level = int(voxel.key >> 3 * kBits);
      Triple &point = points.emplace_back(), &unit = normals.emplace_back();
      for (int axis = 0; axis < 3; ++axis) {
        const double cell = double(voxel.key >> kBits * (2 - axis) & ((1 << kBits) - 1)) - kHalfSpan;
        point[size_t(axis)] = float(cell * edge_of(level) + double(voxel.offset[axis]) / double(voxel.weight));
        unit[size_t(axis)] = float(normal[axis] / length);
      }
      levels.push_back(uint8_t(level)), views.push_back(voxel.views);
    }
    return found;
  }

 private:
  struct Voxel {
    int64_t key;
    float weight, offset[3], normal[3];  // sums; offsets are from the voxel's corner
    int32_t last_view, views;
  };

  // Where the table has a key, or has room for it: voxels above each other are near in memory. Source: open addressing, Knuth vol. 3, 6.4;
  // the mixing of splitmix64.
  size_t slot_of(int64_t key) const {
    const uint64_t mask = slots_.size() - 1, mixed = uint64_t(key >> 3) * 0x9E3779B97F4A7C15;
    uint64_t place = ((mixed ^ (mixed >> 29)) << 3 | uint64_t(key & 7)) & mask;
    while (slots_[place] >= 0 && voxels_[size_t(slots_[place])].key != key) place = (place + 1) & mask;
    return place;
  }

  void make_room(size_t more) {
    const size_t needed = voxels_.size() + more;
    size_t slots = std::max<size_t>(slots_.size(), 1 << 16);
    while (slots < 2 * needed) slots *= 2;
    if (slots == slots_.size()) return;
    slots_.assign(slots, -1);
    for (size_t i = 0; i < voxels_.size(); ++i) slots_[slot_of(voxels_[i].key)] = int32_t(i);
  }

  std::vector<Voxel> voxels_;
  std::vector<int32_t> slots_;  // of a power of two, at most half of them taken: numbers of voxels, -1 none
  int32_t views_ = 0;
  std::vector<float> around_;  // of the view that is added
};

enum Mark : uint8_t { kUnseen, kSeen, kSeenThrough };

// Depths of a view: of every step_px-th pixel the largest disparity around it, 0 where its own is unknown, and the standard deviation of
// disparities; the lens; cam_from_map. A point must lie clear_sigmas standard deviations of the depth, and clear_m, before the pixel's
// depth to be seen through.
using Depths = std::tuple<Image32, int, double, StereoLens, SE3, double, double>;

struct Look {
  Mark mark = kUnseen;
  float weight = 0.0f;
  double u = 0.0, v = 0.0;
  Vec3 point_cam = {};
};

Look look(Vec3 point_map, int level, double per_m, const Depths& view) {
  Look found;
  const auto& [nearest_px, step_px, sigma_px, lens, cam_from_map, clear_sigmas, clear_m] = view;
  found.point_cam = cam_from_map * point_map;
  const double depth = found.point_cam[2];
  if (!(depth > kMinRangeM && depth < kMaxRangeM)) return found;
  const double per_depth = lens.focal / depth, per_step = 1.0 / step_px;
  found.u = found.point_cam[0] * per_depth + lens.cx, found.v = found.point_cam[1] * per_depth + lens.cy;
  const double column = found.u * per_step + 0.5, row = found.v * per_step + 0.5;
  const Picture<const float> nearest = nearest_px;
  if (!(column >= 0.0 && column < double(nearest.width) && row >= 0.0 && row < double(nearest.height))) return found;
  const float px = nearest.row(ptrdiff_t(row))[ptrdiff_t(column)];
  if (!(px > 0.0f)) return found;
  const double shown = lens.focal_baseline / px, clear = clear_sigmas * shown * sigma_px / px + clear_m;
  if (depth < shown - clear)
    found.mark = kSeenThrough, found.weight = float(1 << 2 * std::max(0, level - level_at(depth, per_m)));
  else if (depth < shown + clear)
    found.mark = kSeen;
  return found;
}

double bilinear(Picture<const uint8_t> picture, double u, double v) {
  const double right = std::clamp(u, 0.0, double(picture.width) - 1.001), below = std::clamp(v, 0.0, double(picture.height) - 1.001);
  const ptrdiff_t column = ptrdiff_t(right), row = ptrdiff_t(below);
  const double x = right - double(column), y = below - double(row);
  const uint8_t *const upper = picture.row(row) + column, *const lower = picture.row(row + 1) + column;
  return (upper[0] * (1.0 - x) + upper[1] * x) * (1.0 - y) + (lower[0] * (1.0 - x) + lower[1] * x) * y;
}

// Calls visit(i, look) for each point (N, 3) in map of a voxel of its level (N,).
template <typename Visit>
void for_each_look(const FloatPoints& points_map, const Levels& levels, const Depths& view, const Visit& visit) {
  check_levels(levels, points_map.shape(0));
  if (std::get<int>(view) < 1) throw nb::value_error("step_px: at least 1");
  const nb::gil_scoped_release others_run;
  const double per_m = edges_per_m(std::get<StereoLens>(view).focal);
  for (size_t i = 0; i < levels.shape(0); ++i) visit(i, look(vec3(points_map.data() + 3 * i), levels.data()[i], per_m, view));
}

// Evidence of a view on points (N, 3) in map of voxels of these levels (N,): marks (N,), and pixels (N, 2) of points in range, else 0.
auto look_at(const FloatPoints& points_map, const Levels& levels, const Depths& view) {
  auto marks = zeros<uint8_t>(points_map.shape(0));
  auto pixels = zeros<std::array<float, 2>>(marks.size());
  for_each_look(points_map, levels, view,
                [&](size_t i, const Look& found) { marks[i] = found.mark, pixels[i] = {float(found.u), float(found.v)}; });
  return std::tuple(std::move(marks), std::move(pixels));
}

// Adds what a view says of points, as of `look_at`, to sums (N, 4): 1 if it sees the point; its weight in views if it sees through it, as
// a view that sees more finely than the voxel was seen counts more; and, of seen points, the grey level of the picture relative to the
// exposure and to the lens, of these coefficients by powers of the squared tangent, over distance^4, and 1 over distance^4.
void weigh(const FloatPoints& points_map, const Levels& levels, const Depths& view, const Image& picture, const Vec3& falloff,
           double log_exposure, const MutableArray<double, -1, 4>& sums) {
  check_rows(points_map.shape(0), "sums: a row for each point", sums);
  if (picture.shape(0) < 2 || picture.shape(1) < 2) return;
  const StereoLens& lens = std::get<StereoLens>(view);
  const double per_squared = 1.0 / (lens.focal * lens.focal);
  for_each_look(points_map, levels, view, [&](size_t i, const Look& found) {
    double* const sum = &sums(i, 0);
    if (found.mark == kSeenThrough) sum[1] += found.weight;
    if (found.mark != kSeen) return;
    sum[0] += 1.0;
    const double off_u = found.u - lens.cx, off_v = found.v - lens.cy, squared = (off_u * off_u + off_v * off_v) * per_squared;
    const double light = std::exp(log_exposure + squared * (falloff[0] + squared * (falloff[1] + squared * falloff[2])));
    const double distance = dot(found.point_cam, found.point_cam), weight = 1.0 / (distance * distance);
    sum[2] += bilinear(picture, found.u, found.v) / light * weight;
    sum[3] += weight;
  });
}

// Of discs (N, 3) with normals (N, 3), in map, those that face the camera within a cone, of this cosine of the half angle and this length:
// near the picture of width x height where the lens is a pinhole fx fy cx cy, for which alone pixels are filled; fx is 0 for any other.
// Numbers of surfels, their points in the camera and their pixels.
auto discs_before(const FloatPoints& points_map, const FloatPoints& normals_map, const SE3& cam_from_map, double cosine, double far_m,
                  const Array<double, 4>& pinhole, int width, int height) {
  constexpr double kRim = 0.1;  // of the width: discs whose centre is so far outside may reach in
  const size_t count = points_map.shape(0);
  check_rows(count, "normals_map: one for each point", normals_map);
  std::vector<int32_t> numbers;
  std::vector<Vec3> points_cam;
  std::vector<std::array<double, 2>> pixels;
  unlocked([&] {
    const float *const points = points_map.data(), *const normals = normals_map.data();
    const double fx = pinhole(0), fy = pinhole(1), cx = pinhole(2), cy = pinhole(3);
    const Mat3& rotation = cam_from_map.rotation;
    const Vec3 centre = -(transposed(rotation) * cam_from_map.translation);
    const double rim = kRim * width;
    numbers.reserve(count), points_cam.reserve(count), pixels.reserve(count);
    for (size_t i = 0; i < count; ++i) {
      const Vec3 off = vec3(points + 3 * i) - centre;
      const double squared = dot(off, off);
      if (squared > far_m * far_m || squared < 1e-4) continue;
      if (dot(vec3(normals + 3 * i), off) >= 0.0) continue;
      const Vec3 point = rotation * off;
      const double depth = point[2];
      if (depth < cosine * std::sqrt(squared)) continue;
      double u = 0.0, v = 0.0;
      if (fx > 0.0) {
        if (depth < 1e-9) continue;
        u = fx * point[0] / depth + cx, v = fy * point[1] / depth + cy;
        if (!(u > -rim && u < width + rim && v > -rim && v < height + rim)) continue;
      }
      numbers.push_back(int32_t(i));
      points_cam.push_back(point);
      pixels.push_back({u, v});
    }
  });
  return std::tuple(std::move(numbers), std::move(points_cam), std::move(pixels));
}

// Indices of points (M, 3) by bins of distance, near to far.
std::vector<uint32_t> near_to_far(const double* points, size_t count, double far_m) {
  std::vector<uint8_t> bins(count);
  std::vector<size_t> starts(kBins + 1);
  for (size_t i = 0; i < count; ++i) {
    const double bin = kBins * std::sqrt(norm(vec3(points + 3 * i)) / far_m);
    bins[i] = bin < kBins ? uint8_t(bin) : kBins - 1;
    ++starts[bins[i] + 1u];
  }
  for (int b = 1; b <= kBins; ++b) starts[size_t(b)] += starts[size_t(b - 1)];
  std::vector<uint32_t> order(count);
  for (size_t i = 0; i < count; ++i) order[starts[bins[i]]++] = uint32_t(i);
  return order;
}

// Fills hidden with the farthest of nearest in each block: points behind it are hidden everywhere there.
void find_hidden(Picture<float> nearest, Picture<float> hidden) {
  std::fill_n(hidden.at, hidden.height * hidden.width, 0.0f);
  for (ptrdiff_t v = 0; v < nearest.height; ++v)
    for (ptrdiff_t u = 0; u < nearest.width; ++u) {
      float& farthest = hidden.row(v / kBlockPx)[u / kBlockPx];
      farthest = std::max(farthest, nearest.row(v)[u]);
    }
}

// What is drawn into a view of H x W pixels: sums of weights, and of colour and depth along the ray times them.
struct DiscImage {
  ptrdiff_t rows, columns;
  float *weight, *colour, *depth;
};

// Draws discs (M, 3) in the camera, pixels (M, 2) of their centres, of surfels of these numbers (M,), whose normals in map (N, 3),
// levels and colours (N,) follow: each pixel's ray is cut with the disc's plane, and what lies close behind the nearest disc is one
// surface with it. Radii are in edges. rays (H, W, 3) in the camera, NaN for none, and the finest pixels per radian around each (H, W).
// Sums come as 0, and are 0 where nothing is known. Source: Zwicker et al. 2001, surface splatting.
void draw(const Numbers& numbers_of, const Points& points, const Places& places, const Mat3& rotation, const FloatPoints& normals_of,
          const Levels& levels_of, const Levels& colours_of, double far_m, double radius_edges, const double* rays,
          const float* pixels_per_rad, const DiscImage& image) {
  const auto [rows, columns, weight, colour, depth] = image;
  const size_t count = numbers_of.size();
  const int32_t* const numbers = numbers_of.data();
  const double *const points_cam = points.data(), *const pixels = places.data();
  const float* const normals_map = normals_of.data();
  const uint8_t *const levels = levels_of.data(), *const colours = colours_of.data();
  const std::vector<uint32_t> order = near_to_far(points_cam, count, far_m);  // hidden discs then cost little
  const ptrdiff_t block_rows = (rows + kBlockPx - 1) / kBlockPx, block_columns = (columns + kBlockPx - 1) / kBlockPx;
  std::vector<float> nearest_m(size_t(rows * columns), std::numeric_limits<float>::infinity()),
      hidden_m(size_t(block_rows * block_columns));
  const Picture<float> nearest{nearest_m.data(), rows, columns}, hidden{hidden_m.data(), block_rows, block_columns};
  const size_t step = count / kLooks + 1;
  // Twice: first for the nearest surface of each pixel, then for all discs on it.
  for (const bool is_drawing : {false, true})
    for (size_t k = 0; k < count; ++k) {
      if (k % step == 0 && !(is_drawing && k)) find_hidden(nearest, hidden);
      const size_t i = order[k], n = size_t(numbers[i]);
      const Vec3 centre = vec3(points_cam + 3 * i);
      const double distance = norm(centre), middle_u = pixels[2 * i], middle_v = pixels[2 * i + 1];
      const ptrdiff_t at_u = std::clamp<ptrdiff_t>(whole(middle_u), 0, columns - 1),
                      at_v = std::clamp<ptrdiff_t>(whole(middle_v), 0, rows - 1);
      const double fine = pixels_per_rad[at_v * columns + at_u], edge = edge_of(levels[n]);
      const double radius = std::max(radius_edges * edge, kMinPixels * distance / fine);
      const double reach = std::min(kMargin * radius / distance * fine, kMostPixels);
      const ptrdiff_t first_u = std::max<ptrdiff_t>(0, whole(std::ceil(middle_u - reach)));
      const ptrdiff_t first_v = std::max<ptrdiff_t>(0, whole(std::ceil(middle_v - reach)));
      const ptrdiff_t last_u = std::min(columns, whole(std::floor(middle_u + reach)) + 1);
      const ptrdiff_t last_v = std::min(rows, whole(std::floor(middle_v + reach)) + 1);
      if (first_u >= last_u || first_v >= last_v) continue;
      const double thick = kThickEdges * edge + kThickPerM * edge * edge;
      // Nothing of the disc is nearer than this. What float32 rounds away is added.
      const double least = 0.99999 * (distance - radius + (is_drawing ? 0.0 : thick));
      bool is_hidden = true;
      for (ptrdiff_t row = first_v / kBlockPx; row <= (last_v - 1) / kBlockPx; ++row)
        for (ptrdiff_t column = first_u / kBlockPx; column <= (last_u - 1) / kBlockPx; ++column)
          is_hidden &= least > hidden.row(row)[column];
      if (is_hidden) continue;
      const Vec3 normal = rotation * vec3(normals_map + 3 * n);
      const double through = dot(normal, centre), per_squared = 1.0 / (radius * radius), factor = 1e-8 / (edge * edge * edge * edge);
      for (ptrdiff_t v = first_v; v < last_v; ++v)
        for (ptrdiff_t u = first_u; u < last_u; ++u) {
          const ptrdiff_t at = v * columns + u;
          const Vec3 ray = vec3(rays + 3 * at);
          const double slope = dot(normal, ray);
          if (!(slope < -1e-3)) continue;  // true for the NaN of pixels that no ray reaches
          const double t = through / slope;
          const Vec3 off = t * ray - centre;
          const double share = dot(off, off) * per_squared;
          if (t <= 0.0 || share >= 1.0) continue;
          if (!is_drawing) {
            nearest_m[size_t(at)] = float(std::min<double>(nearest_m[size_t(at)], t + thick));
          } else if (t <= nearest_m[size_t(at)]) {
            const double w = (1.0 - share) * (1.0 - share) * factor;
            weight[at] = float(weight[at] + w);
            colour[at] = float(colour[at] + w * colours[n]);
            depth[at] = float(depth[at] + w * t);
          }
        }
    }
}

auto draw_discs(const Numbers& numbers, const Points& points_cam, const Places& pixels, const SE3& cam_from_map,
                const FloatPoints& normals_map, const Levels& levels, const Levels& colours, double far_m, double radius_edges,
                const Array<double, -1, -1, 3>& rays, const Image32& pixels_per_rad) {
  const size_t count = numbers.shape(0), surfels = normals_map.shape(0), rows = rays.shape(0), columns = rays.shape(1);
  check_rows(count, "points_cam, pixels: one for each of numbers", points_cam, pixels);
  check_levels(levels, surfels);
  check_rows(surfels, "colours: one for each normal", colours);
  unlocked([&] { check_below(surfels, "numbers: of normals_map's rows", numbers); });
  if (!same_size(pixels_per_rad, rays)) throw nb::value_error("pixels_per_rad: one for each ray");
  auto weight = zeros<float>(rows * columns), colour = zeros<float>(rows * columns), depth = zeros<float>(rows * columns);
  const DiscImage image{ptrdiff_t(rows), ptrdiff_t(columns), weight.data(), colour.data(), depth.data()};
  if (rows > 0 && columns > 0)
    unlocked([&] {
      draw(numbers, points_cam, pixels, cam_from_map.rotation, normals_map, levels, colours, far_m, radius_edges, rays.data(),
           pixels_per_rad.data(), image);
    });
  return std::tuple(as_numpy<float, 2>(std::move(weight), {rows, columns}), as_numpy<float, 2>(std::move(colour), {rows, columns}),
                    as_numpy<float, 2>(std::move(depth), {rows, columns}));
}

constexpr double kLeastAlpha = 1.0 / 255.0;  // smaller coverage of a pixel is not drawn

// Gaussians in a picture, front to back: pixels (M, 2) of their centres, conics (M, 3) xx, xy, yy of the inverse covariances,
// reaches (M, 2) in px beyond which the least alpha is not reached, peaks (M,) of alpha and greys (M,).
using Gaussians = std::tuple<Places, Points, Places, Reals, Reals>;

size_t checked(const Gaussians& gaussians) {
  const size_t count = std::get<0>(gaussians).shape(0);
  std::apply([&](const auto&... columns) { check_rows(count, "gaussians: columns of one length", columns...); }, gaussians);
  return count;
}

// Calls visit(i, pixel's index, light before it, alpha, squared distance, (qu, qv) its derivatives) for each pixel of each Gaussian, and
// takes the light; done(i) after each.
template <typename Visit, typename Done>
[[gnu::always_inline]] inline void for_each_pixel(const Gaussians& gaussians, Picture<double> through, const Visit& visit,
                                                  const Done& done) {
  const auto& [pixels, conics, reaches_px, peaks, greys] = gaussians;
  for (size_t i = 0; i < peaks.shape(0); ++i) {
    const double u_px = pixels(i, 0), v_px = pixels(i, 1), reach_u = reaches_px(i, 0), reach_v = reaches_px(i, 1);
    const double xx = conics(i, 0), xy = conics(i, 1), yy = conics(i, 2), peak = peaks(i);
    const double first_u = std::max(0.0, std::ceil(u_px - reach_u)),
                 last_u = std::min(double(through.width) - 1.0, std::floor(u_px + reach_u));
    const double first_v = std::max(0.0, std::ceil(v_px - reach_v)),
                 last_v = std::min(double(through.height) - 1.0, std::floor(v_px + reach_v));
    if (first_u <= last_u && first_v <= last_v)
      for (ptrdiff_t v = ptrdiff_t(first_v); v <= ptrdiff_t(last_v); ++v)
        for (ptrdiff_t u = ptrdiff_t(first_u); u <= ptrdiff_t(last_u); ++u) {
          double& passing = through.row(v)[u];
          const double light = passing;
          if (light < kHidden) continue;
          const double du = double(u) - u_px, dv = double(v) - v_px;
          const double qu = xx * du + xy * dv, qv = xy * du + yy * dv, squared = du * qu + dv * qv;
          const double alpha = peak * std::exp(-0.5 * squared);
          if (alpha < kLeastAlpha) continue;
          visit(i, v * through.width + u, light, alpha, squared, qu, qv);
          passing = light * (1.0 - alpha);
        }
    done(i);
  }
}

// Blends Gaussians: the share of light that passes all (H, W), and the picture (H, W). Source: Kerbl et al. 2023.
auto blend(const Gaussians& gaussians, int width, int height) {
  constexpr int64_t kMostPixels = 1 << 25;
  checked(gaussians);
  if (width < 0 || height < 0 || int64_t(width) * height > kMostPixels) throw nb::value_error("width, height: up to 2^25 pixels");
  const size_t rows = size_t(height), columns = size_t(width);
  std::vector<double> through, picture;
  unlocked([&] {
    through.assign(rows * columns, 1.0), picture.resize(rows * columns);
    const double* const greys = std::get<4>(gaussians).data();
    const auto add = [&](size_t i, ptrdiff_t at, double light, double alpha, double, double, double) {
      picture[size_t(at)] += light * alpha * greys[i];
    };
    for_each_pixel(gaussians, {through.data(), height, width}, add, [](size_t) {});
  });
  return std::tuple(as_numpy<double, 2>(std::move(through), {rows, columns}), as_numpy<double, 2>(std::move(picture), {rows, columns}));
}

// Gradients (M, 3) of a loss, whose slopes by the picture are (H, W), by grey, logarithm of the size and logit of the opacity
// (M,). whole: the picture as `blend` made it. The pixels' own blur_px2 is on the diagonal of the covariances.
// Source: Kerbl et al. 2023; Mip-Splatting, Yu et al. 2024.
auto blend_backward(const Gaussians& gaussians, const Reals& opacities, double blur_px2, const Image64& slopes, const Image64& whole) {
  const size_t count = checked(gaussians);
  check_rows(count, "opacities: one for each of pixels", opacities);
  if (!same_size(slopes, whole)) throw nb::value_error("slopes: of the picture's size");
  auto gradients = zeros<std::array<double, 3>>(count);
  unlocked([&] {
    const double *const slope_of = slopes.data(), *const whole_of = whole.data();
    const double *const greys = std::get<4>(gaussians).data(), *const conics = std::get<1>(gaussians).data();
    std::vector<double> through(whole.size(), 1.0), picture(whole.size());
    double by_grey = 0.0, by_size = 0.0, by_opacity = 0.0;
    const auto add = [&](size_t i, ptrdiff_t at, double light, double alpha, double squared, double qu, double qv) {
      const double grey = greys[i], slope = slope_of[at];
      const double spread = blur_px2 * (conics[3 * i] + conics[3 * i + 2]);
      picture[size_t(at)] += light * alpha * grey;
      const double behind = whole_of[at] - picture[size_t(at)];
      const double by_alpha = slope * (light * grey - behind / (1.0 - alpha)) * alpha;
      by_grey += slope * light * alpha;
      by_size += by_alpha * (squared - blur_px2 * (qu * qu + qv * qv) + spread);
      by_opacity += by_alpha;
    };
    const auto keep = [&](size_t i) {
      gradients[i] = {by_grey, by_size, by_opacity * (1.0 - opacities(i))};
      by_grey = by_size = by_opacity = 0.0;
    };
    for_each_pixel(gaussians, {through.data(), ptrdiff_t(whole.shape(0)), ptrdiff_t(whole.shape(1))}, add, keep);
  });
  return gradients;
}

}  // namespace

void bind_surfels(nb::module_& module) {
  module.attr("SURFEL_EDGE_M") = kEdgeM;
  module.attr("SURFEL_LEVELS") = kLevels;
  module.attr("SPLAT_LEAST_ALPHA") = kLeastAlpha;
  module.attr("SURFEL_RANGE_M") = std::tuple(kMinRangeM, kMaxRangeM);
  module.def("surfel_stride_px", &stride_px, "focal_px"_a);
  module.def("voxel_keys", &voxel_keys, "points_map"_a, "levels"_a);
  nb::class_<Shared<VoxelTable>>(module, "VoxelTable")
      .def(nb::init<>())
      .def("add", in_turn<PythonLock::kReleased>(&VoxelTable::add), "disparity_px"_a, "sigma_px"_a, "lens"_a, "map_from_cam"_a, "box_map"_a)
      .def("surfels", in_turn<PythonLock::kReleased>(&VoxelTable::surfels));
  module.def("look_at", &look_at, "points_map"_a, "levels"_a, "view"_a);
  module.def("weigh", &weigh, "points_map"_a, "levels"_a, "view"_a, "picture"_a, "falloff"_a, "log_exposure"_a, "sums"_a);
  module.def("discs_before", &discs_before, "points_map"_a, "normals_map"_a, "cam_from_map"_a, "cosine"_a, "far_m"_a, "pinhole"_a,
             "width"_a, "height"_a);
  module.def("draw_discs", &draw_discs, "numbers"_a, "points_cam"_a, "pixels"_a, "cam_from_map"_a, "normals_map"_a, "levels"_a, "colours"_a,
             "far_m"_a, "radius_edges"_a, "rays"_a, "pixels_per_rad"_a);
  module.def("blend", &blend, "gaussians"_a, "width"_a, "height"_a);
  module.def("blend_backward", &blend_backward, "gaussians"_a, "opacities"_a, "blur_px2"_a, "slopes"_a, "whole"_a);
}

}  // namespace fleetmap
