#include "surfels.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace fleetmap {
namespace {

constexpr double kMaxSigmaShare = 0.06;  // standard deviation of a depth, as a share of it
constexpr double kFootprintShare = 1.5;  // least edge of a voxel, in steps from pixel to pixel that merge in it
// Square around a pixel whose disparities give the normal: half size and step, largest difference to its own, least number.
constexpr ptrdiff_t kFitPx = 6, kFitStepPx = 2;
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

// Of a voxel that a camera sees at this depth.
inline int level_at(double depth, double focal) {
  int level = 0;
  while (level < kLevels - 1 && edge_of(level) < kFootprintShare * kStridePx * depth / focal) ++level;
  return level;
}

// The normal, in the camera and towards it, of the plane through the disparities around a pixel; false without one. A plane is affine in
// (u, v, disparity), so that its gradient is its normal: least squares over disparities like the middle one.
bool fit_normal(Picture<const float> disparity, ptrdiff_t u, ptrdiff_t v, StereoLens lens, Vec3& normal) {
  const float middle = disparity.row(v)[u];
  double n = 0, su = 0, sv = 0, sd = 0, suu = 0, svv = 0, suv = 0, sud = 0, svd = 0;
  for (ptrdiff_t dv = -kFitPx; dv <= kFitPx; dv += kFitStepPx) {
    if (v + dv < 0 || v + dv >= disparity.height) continue;
    const float* row = disparity.row(v + dv) + u;
    for (ptrdiff_t du = -kFitPx; du <= kFitPx; du += kFitStepPx) {
      if (u + du < 0 || u + du >= disparity.width) continue;
      const float apart = row[du] - middle;
      if (!(std::abs(apart) <= kFitApartPx)) continue;
      const double x = double(du), y = double(dv), d = apart;
      n += 1.0, su += x, sv += y, sd += d;
      suu += x * x, svv += y * y, suv += x * y;
      sud += x * d, svd += y * d;
    }
  }
  if (n < kMinFit) return false;
  suu -= su * su / n, svv -= sv * sv / n, suv -= su * sv / n;
  sud -= su * sd / n, svd -= sv * sd / n;
  const double determinant = suu * svv - suv * suv;
  if (determinant <= 1e-6) return false;
  const double a = (sud * svv - svd * suv) / determinant, b = (svd * suu - sud * suv) / determinant;
  const double off_u = double(u) - lens.cx, off_v = double(v) - lens.cy;
  normal = {-a * lens.focal, -b * lens.focal, -(double(middle) - a * off_u - b * off_v)};
  const double length = norm(normal), towards = dot(normal, {off_u / lens.focal, off_v / lens.focal, 1.0});
  if (length <= 0.0 || towards >= 0.0) return false;
  normal = {normal[0] / length, normal[1] / length, normal[2] / length};
  return true;
}

}  // namespace

int64_t voxel_key(double x, double y, double z, int level) {
  const double edge = edge_of(level);
  uint64_t key = uint64_t(level);
  for (const double along : {x, y, z}) {
    const double cell = std::floor(along / edge) + kHalfSpan;
    key = key << kBits | uint64_t(int64_t(std::min(std::max(0.0, cell), 2.0 * kHalfSpan - 1.0)));  // 0 for NaN
  }
  return int64_t(key);
}

// Where the table has a key, or has room for it. Source: open addressing, Knuth vol. 3, 6.4; the mixing of splitmix64.
size_t VoxelTable::slot_of(int64_t key) const {
  const uint64_t mask = slots_.size() - 1, mixed = uint64_t(key) * 0x9E3779B97F4A7C15;
  uint64_t place = (mixed ^ (mixed >> 29)) & mask;
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

void VoxelTable::add(Picture<const float> disparity, double sigma_px, StereoLens lens, const double* map_from_cam) {
  make_room(size_t((disparity.height + kStridePx - 1) / kStridePx) * size_t((disparity.width + kStridePx - 1) / kStridePx));
  const SE3 pose = se3(map_from_cam);
  for (ptrdiff_t v = 0; v < disparity.height; v += kStridePx)
    for (ptrdiff_t u = 0; u < disparity.width; u += kStridePx) {
      const float px = disparity.row(v)[u];
      if (!(px > 0.0f)) continue;
      const double z = lens.focal_baseline / px, sigma = z * z / lens.focal_baseline * sigma_px;
      if (!(z >= kMinRangeM && z <= kMaxRangeM) || sigma > kMaxSigmaShare * z) continue;
      Vec3 normal;
      if (!fit_normal(disparity, u, v, lens, normal)) continue;
      const int level = level_at(z, lens.focal);
      const Vec3 point = pose * Vec3{(double(u) - lens.cx) * z / lens.focal, (double(v) - lens.cy) * z / lens.focal, z};
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

void look_at(const float* points, const uint8_t* levels, size_t count, Picture<const float> nearest_px, double step_px, double sigma_px,
             StereoLens lens, const double* cam_from_map, double clear_sigmas, double clear_m, uint8_t* marks, float* weights,
             float* pixels) {
  const SE3 pose = se3(cam_from_map);
  for (size_t i = 0; i < count; ++i) {
    marks[i] = kUnseen, weights[i] = 0.0f;
    float* const pixel = pixels + 2 * i;
    pixel[0] = pixel[1] = 0.0f;
    const Vec3 point = pose * Vec3{points[3 * i], points[3 * i + 1], points[3 * i + 2]};
    const double depth = point[2];
    if (!(depth > kMinRangeM && depth < kMaxRangeM)) continue;
    pixel[0] = float(lens.focal * point[0] / depth + lens.cx), pixel[1] = float(lens.focal * point[1] / depth + lens.cy);
    const ptrdiff_t u = whole_or_outside(std::floor(pixel[0] / step_px + 0.5)), v = whole_or_outside(std::floor(pixel[1] / step_px + 0.5));
    if (u < 0 || u >= nearest_px.width || v < 0 || v >= nearest_px.height || !(nearest_px.row(v)[u] > 0.0f)) continue;
    const double shown = lens.focal_baseline / nearest_px.row(v)[u];
    const double clear = clear_sigmas * shown * shown / lens.focal_baseline * sigma_px + clear_m;
    weights[i] = float(1 << 2 * std::max(0, levels[i] - level_at(depth, lens.focal)));
    if (depth < shown - clear)
      marks[i] = kSeenThrough;
    else if (depth < shown + clear)
      marks[i] = kSeen;
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
