#include "surfels.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace fleetmap {
namespace {

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
  normal = {normal[0] / length, normal[1] / length, normal[2] / length};
  return true;
}

}  // namespace

int stride_px(double focal) {
  int stride = 2;
  while (stride < 4 && kEdgeM * focal / kFootprintShare >= stride + 0.5) ++stride;
  return stride;
}

int64_t voxel_key(double x, double y, double z, int level) {
  const double edge = edge_of(level);
  uint64_t key = uint64_t(level);
  for (const double along : {x, y, z}) {
    const double cell = std::floor(along / edge) + kHalfSpan;
    key = key << kBits | uint64_t(int64_t(std::min(std::max(0.0, cell), 2.0 * kHalfSpan - 1.0)));  // 0 for NaN
  }
  return int64_t(key);
}

// Where the table has a key, or has room for it: voxels above each other are near in memory. Source: open addressing, Knuth vol. 3, 6.4;
// the mixing of splitmix64.
size_t VoxelTable::slot_of(int64_t key) const {
  const uint64_t mask = slots_.size() - 1, mixed = uint64_t(key >> 3) * 0x9E3779B97F4A7C15;
  uint64_t place = ((mixed ^ (mixed >> 29)) << 3 | uint64_t(key & 7)) & mask;
  while (slots_[place] >= 0 && voxels_[size_t(slots_[place])].key != key) place = (place + 1) & mask;
  return place;
}

void VoxelTable::make_room(size_t more) {
  const size_t needed = voxels_.size() + more;
  size_t slots = std::max<size_t>(slots_.size(), 1 << 16);
  while (slots < 2 * needed) slots *= 2;
  if (slots == slots_.size()) return;
  slots_.assign(slots, -1);
  for (size_t i = 0; i < voxels_.size(); ++i) slots_[slot_of(voxels_[i].key)] = int32_t(i);
}

void VoxelTable::add(Picture<const float> disparity, double sigma_px, StereoLens lens, const double* map_from_cam, const double* low,
                     const double* high) {
  make_room(size_t(disparity.height) * size_t(disparity.width));
  const SE3 pose = se3(map_from_cam);
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
      const Vec3 point = pose * Vec3{(u - lens.cx) * z / lens.focal, (v - lens.cy) * z / lens.focal, z};
      if (!(point[0] >= low[0] && point[0] < high[0] && point[1] >= low[1] && point[1] < high[1])) continue;
      Vec3 normal;
      if (!fit_normal(around_.data() + row * row_step + column, row_step, stride, reach, u, v, lens, normal)) continue;
      const int level = level_at(z, per_m);
      const Vec3 turned = pose.rotation * normal;
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

size_t VoxelTable::surfels(float* points, float* normals, uint8_t* levels, int64_t* views) const {
  size_t count = 0;
  for (const Voxel& voxel : voxels_) {
    const Vec3 normal = {voxel.normal[0], voxel.normal[1], voxel.normal[2]};
    const double length = norm(normal);
    if (!(length > 1e-9)) continue;
    const int level = int(voxel.key >> 3 * kBits);
    for (int axis = 0; axis < 3; ++axis) {
      const double cell = double(voxel.key >> kBits * (2 - axis) & ((1 << kBits) - 1)) - kHalfSpan;
      points[3 * count + size_t(axis)] = float(cell * edge_of(level) + double(voxel.offset[axis]) / double(voxel.weight));
      normals[3 * count + size_t(axis)] = float(normal[axis] / length);
    }
    levels[count] = uint8_t(level), views[count] = voxel.views;
    ++count;
  }
  return count;
}

namespace {

struct Look {
  Mark mark = kUnseen;
  float weight = 0.0f;
  double u = 0.0, v = 0.0;
};

Look look(Vec3 point_cam, int level, double per_m, const DepthPicture& view) {
  Look found;
  const StereoLens& lens = view.lens;
  const double depth = point_cam[2];
  if (!(depth > kMinRangeM && depth < kMaxRangeM)) return found;
  found.u = lens.focal * point_cam[0] / depth + lens.cx, found.v = lens.focal * point_cam[1] / depth + lens.cy;
  const ptrdiff_t column = whole_or_outside(std::floor(found.u / view.step_px + 0.5)),
                  row = whole_or_outside(std::floor(found.v / view.step_px + 0.5));
  const Picture<const float>& nearest = view.nearest_px;
  if (column < 0 || column >= nearest.width || row < 0 || row >= nearest.height || !(nearest.row(row)[column] > 0.0f)) return found;
  const double shown = lens.focal_baseline / nearest.row(row)[column];
  const double clear = view.clear_sigmas * shown * shown / lens.focal_baseline * view.sigma_px + view.clear_m;
  found.weight = float(1 << 2 * std::max(0, level - level_at(depth, per_m)));
  if (depth < shown - clear)
    found.mark = kSeenThrough;
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

}  // namespace

void look_at(const float* points, const uint8_t* levels, size_t count, const DepthPicture& view, uint8_t* marks, float* pixels) {
  const SE3 pose = se3(view.cam_from_map);
  const double per_m = edges_per_m(view.lens.focal);
  for (size_t i = 0; i < count; ++i) {
    const Look found = look(pose * Vec3{points[3 * i], points[3 * i + 1], points[3 * i + 2]}, levels[i], per_m, view);
    marks[i] = found.mark, pixels[2 * i] = float(found.u), pixels[2 * i + 1] = float(found.v);
  }
}

void weigh(const float* points, const uint8_t* levels, size_t count, const DepthPicture& view, Picture<const uint8_t> picture, Vec3 falloff,
           double log_exposure, double* sums) {
  if (picture.height < 2 || picture.width < 2) return;
  const SE3 pose = se3(view.cam_from_map);
  const double per_squared = 1.0 / (view.lens.focal * view.lens.focal), per_m = edges_per_m(view.lens.focal);
  for (size_t i = 0; i < count; ++i) {
    const Vec3 point = pose * Vec3{points[3 * i], points[3 * i + 1], points[3 * i + 2]};
    const Look found = look(point, levels[i], per_m, view);
    double* const sum = sums + 4 * i;
    if (found.mark == kSeenThrough) sum[1] += found.weight;
    if (found.mark != kSeen) continue;
    sum[0] += 1.0;
    const double off_u = found.u - view.lens.cx, off_v = found.v - view.lens.cy, squared = (off_u * off_u + off_v * off_v) * per_squared;
    const double light = std::exp(log_exposure + squared * (falloff[0] + squared * (falloff[1] + squared * falloff[2])));
    const double distance = dot(point, point), weight = 1.0 / (distance * distance);
    sum[2] += bilinear(picture, found.u, found.v) / light * weight;
    sum[3] += weight;
  }
}

Discs discs_before(const float* points_map, const float* normals_map, size_t count, const double* cam_from_map, double cosine, double far_m,
                   Pinhole pinhole, double width, double height) {
  constexpr double kRim = 0.1;  // of the width: discs whose centre is so far outside may reach in
  const Mat3 rotation = mat3(cam_from_map, 4);
  const Vec3 centre = -(transposed(rotation) * Vec3{cam_from_map[3], cam_from_map[7], cam_from_map[11]});
  const double rim = kRim * width;
  Discs found;
  found.numbers.reserve(count), found.points.reserve(count), found.pixels.reserve(count);
  for (size_t i = 0; i < count; ++i) {
    const Vec3 off = Vec3{points_map[3 * i], points_map[3 * i + 1], points_map[3 * i + 2]} - centre;
    const double squared = dot(off, off);
    if (squared > far_m * far_m || squared < 1e-4) continue;
    if (dot({normals_map[3 * i], normals_map[3 * i + 1], normals_map[3 * i + 2]}, off) >= 0.0) continue;
    const double depth = dot(vec3(rotation[2]), off);
    if (depth < cosine * std::sqrt(squared)) continue;
    const double right = dot(vec3(rotation[0]), off), down = dot(vec3(rotation[1]), off);
    double u = 0.0, v = 0.0;
    if (pinhole.fx > 0.0) {
      if (depth < 1e-9) continue;
      u = pinhole.fx * right / depth + pinhole.cx, v = pinhole.fy * down / depth + pinhole.cy;
      if (!(u > -rim && u < width + rim && v > -rim && v < height + rim)) continue;
    }
    found.numbers.push_back(int32_t(i));
    found.points.push_back({right, down, depth});
    found.pixels.push_back({u, v});
  }
  return found;
}

namespace {

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

}  // namespace

void draw_discs(const int32_t* numbers, const double* points_cam, const double* pixels, size_t count, const double* cam_from_map,
                const float* normals_map, const uint8_t* levels, const uint8_t* colours, double far_m, double radius_edges, Rays rays,
                float* weight, float* colour, float* depth) {
  const ptrdiff_t rows = rays.height, columns = rays.width;
  if (rows == 0 || columns == 0) return;
  const Mat3 rotation = mat3(cam_from_map, 4);
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
      const ptrdiff_t at_u = std::clamp<ptrdiff_t>(whole_or_outside(middle_u), 0, columns - 1),
                      at_v = std::clamp<ptrdiff_t>(whole_or_outside(middle_v), 0, rows - 1);
      const double fine = rays.pixels_per_rad[at_v * columns + at_u], edge = edge_of(levels[n]);
      const double radius = std::max(radius_edges * edge, kMinPixels * distance / fine);
      const double reach = std::min(kMargin * radius / distance * fine, kMostPixels);
      const ptrdiff_t first_u = std::max<ptrdiff_t>(0, whole_or_outside(std::ceil(middle_u - reach)));
      const ptrdiff_t first_v = std::max<ptrdiff_t>(0, whole_or_outside(std::ceil(middle_v - reach)));
      const ptrdiff_t last_u = std::min(columns, whole_or_outside(std::floor(middle_u + reach)) + 1);
      const ptrdiff_t last_v = std::min(rows, whole_or_outside(std::floor(middle_v + reach)) + 1);
      if (first_u >= last_u || first_v >= last_v) continue;
      const double thick = kThickEdges * edge + kThickPerM * edge * edge;
      // Nothing of the disc is nearer than this. What float32 rounds away is added.
      const double least = 0.99999 * (distance - radius + (is_drawing ? 0.0 : thick));
      bool is_hidden = true;
      for (ptrdiff_t row = first_v / kBlockPx; row <= (last_v - 1) / kBlockPx; ++row)
        for (ptrdiff_t column = first_u / kBlockPx; column <= (last_u - 1) / kBlockPx; ++column)
          is_hidden &= least > hidden.row(row)[column];
      if (is_hidden) continue;
      const Vec3 normal = rotation * Vec3{normals_map[3 * n], normals_map[3 * n + 1], normals_map[3 * n + 2]};
      const double through = dot(normal, centre), per_squared = 1.0 / (radius * radius), factor = 1e-8 / (edge * edge * edge * edge);
      for (ptrdiff_t v = first_v; v < last_v; ++v)
        for (ptrdiff_t u = first_u; u < last_u; ++u) {
          const ptrdiff_t at = v * columns + u;
          const Vec3 ray = vec3(rays.at + 3 * at);
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

namespace {

// Calls visit(i, pixel's index, light before it, alpha, squared distance, (qu, qv) its derivatives) for each pixel of each Gaussian, and
// takes the light; done(i) after each.
template <typename Visit, typename Done>
[[gnu::always_inline]] inline void for_each_pixel(const Gaussians& g, Picture<double> through, const Visit& visit, const Done& done) {
  for (size_t i = 0; i < g.count; ++i) {
    const double u_px = g.pixels[2 * i], v_px = g.pixels[2 * i + 1], reach_u = g.reaches_px[2 * i], reach_v = g.reaches_px[2 * i + 1];
    const double xx = g.conics[3 * i], xy = g.conics[3 * i + 1], yy = g.conics[3 * i + 2];
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
          const double alpha = g.peaks[i] * std::exp(-0.5 * squared);
          if (alpha < kLeastAlpha) continue;
          visit(i, v * through.width + u, light, alpha, squared, qu, qv);
          passing = light * (1.0 - alpha);
        }
    done(i);
  }
}

}  // namespace

void blend(const Gaussians& gaussians, Picture<double> through, double* picture) {
  for_each_pixel(
      gaussians, through,
      [&](size_t i, ptrdiff_t at, double light, double alpha, double, double, double) {
        picture[at] += light * alpha * gaussians.greys[i];
      },
      [](size_t) {});
}

void blend_backward(const Gaussians& gaussians, const double* opacities, double blur_px2, const double* slopes, const double* whole,
                    ptrdiff_t height, ptrdiff_t width, double* gradients) {
  std::vector<double> through(size_t(height * width), 1.0), picture(size_t(height * width));
  double by_grey = 0.0, by_size = 0.0, by_opacity = 0.0;
  for_each_pixel(
      gaussians, {through.data(), height, width},
      [&](size_t i, ptrdiff_t at, double light, double alpha, double squared, double qu, double qv) {
        const double grey = gaussians.greys[i], slope = slopes[at],
                     spread = blur_px2 * (gaussians.conics[3 * i] + gaussians.conics[3 * i + 2]);
        picture[size_t(at)] += light * alpha * grey;
        const double behind = whole[at] - picture[size_t(at)];
        const double by_alpha = slope * (light * grey - behind / (1.0 - alpha)) * alpha;
        by_grey += slope * light * alpha;
        by_size += by_alpha * (squared - blur_px2 * (qu * qu + qv * qv) + spread);
        by_opacity += by_alpha;
      },
      [&](size_t i) {
        gradients[3 * i] = by_grey, gradients[3 * i + 1] = by_size, gradients[3 * i + 2] = by_opacity * (1.0 - opacities[i]);
        by_grey = by_size = by_opacity = 0.0;
      });
}

}  // namespace fleetmap
