#include "rays.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

#include "picture.h"

namespace fleetmap {
namespace {

constexpr double kNever = 1e30;

// Ray parameters at which a ray enters and leaves the slab |x| <= half.
struct Interval {
  double enter, leave;
  Interval(double origin, double along, double half) {
    const double inverse = along != 0.0 ? 1.0 / along : kNever, a = (-half - origin) * inverse, b = (half - origin) * inverse;
    enter = std::min(a, b), leave = std::max(a, b);
  }
};

// Where a ray from outside enters a box: its parameter, kNever for no hit, and the side.
Hit enter_box(const YawedBox& box, Vec3 origin, Vec3 direction) {
  const Vec3 off = origin - box.centre;
  const double along_x = box.cosine * direction[0] + box.sine * direction[1], along_y = box.cosine * direction[1] - box.sine * direction[0];
  const double along_z = direction[2];
  const Interval x(box.cosine * off[0] + box.sine * off[1], along_x, box.half[0]);
  const Interval y(box.cosine * off[1] - box.sine * off[0], along_y, box.half[1]), z(off[2], along_z, box.half[2]);
  double enter = x.enter;
  int64_t side = along_x > 0.0 ? 0 : 1;
  if (y.enter > enter) enter = y.enter, side = along_y > 0.0 ? 2 : 3;
  if (z.enter > enter) enter = z.enter, side = along_z > 0.0 ? 4 : 5;
  if (enter > std::min(std::min(x.leave, y.leave), z.leave) || enter <= 1e-6) return {kNever, -1, -1};
  return {enter, -1, side};
}

}  // namespace

BoxGrid::BoxGrid(std::vector<YawedBox> boxes, Vec3 low, Vec3 high, double cell_m) : boxes_(std::move(boxes)), low_(low), cell_m_(cell_m) {
  for (int axis = 0; axis < 3; ++axis) counts_[axis] = std::max<int64_t>(0, whole_or_outside(std::ceil((high[axis] - low[axis]) / cell_m)));
  starts_.assign(size_t(counts_[0] * counts_[1] * counts_[2]) + 1, 0);
  constexpr int64_t kMostItems = 1 << 26;
  const auto for_each_cell = [&](const auto& visit) {
    int64_t items = 0;
    for (size_t b = 0; b < boxes_.size(); ++b) {
      const YawedBox& box = boxes_[b];
      const Vec3 reach = {std::abs(box.cosine) * box.half[0] + std::abs(box.sine) * box.half[1],
                          std::abs(box.sine) * box.half[0] + std::abs(box.cosine) * box.half[1], box.half[2]};
      int64_t first[3], last[3];
      for (int axis = 0; axis < 3; ++axis) {
        first[axis] = std::max<int64_t>(0, whole_or_outside(std::floor((box.centre[axis] - reach[axis] - low[axis]) / cell_m)));
        last[axis] =
            std::min<int64_t>(counts_[axis] - 1, whole_or_outside(std::floor((box.centre[axis] + reach[axis] - low[axis]) / cell_m)));
      }
      int64_t touched = 1;
      for (int axis = 0; axis < 3; ++axis) touched *= std::max<int64_t>(0, last[axis] - first[axis] + 1);
      if ((items += touched) > kMostItems) throw std::length_error("boxes: at most 2^26 in the lists of all cells");
      for (int64_t k = first[2]; k <= last[2]; ++k)
        for (int64_t j = first[1]; j <= last[1]; ++j)
          for (int64_t i = first[0]; i <= last[0]; ++i) visit(size_t((k * counts_[1] + j) * counts_[0] + i), int32_t(b));
    }
  };
  for_each_cell([&](size_t cell, int32_t) { ++starts_[cell + 1]; });
  for (size_t cell = 1; cell < starts_.size(); ++cell) starts_[cell] += starts_[cell - 1];
  items_.resize(size_t(starts_.back()));
  std::vector<int64_t> next = starts_;
  for_each_cell([&](size_t cell, int32_t b) { items_[size_t(next[cell]++)] = b; });
}

Hit BoxGrid::cast(Vec3 origin, Vec3 direction, double farthest, bool is_any_enough, int64_t skipped_box) const {
  int64_t cell[3], step[3];
  double crossing[3], spacing[3];
  for (int axis = 0; axis < 3; ++axis) {
    cell[axis] = whole_or_outside(std::floor((origin[axis] - low_[axis]) / cell_m_));
    step[axis] = 0, crossing[axis] = spacing[axis] = kNever;
    if (direction[axis] == 0.0) continue;
    step[axis] = direction[axis] > 0.0 ? 1 : -1;
    const double edge = double(cell[axis] + (direction[axis] > 0.0 ? 1 : 0));
    crossing[axis] = (low_[axis] + edge * cell_m_ - origin[axis]) / direction[axis];
    spacing[axis] = std::abs(cell_m_ / direction[axis]);
  }
  Hit nearest = {farthest, -1, -1};
  const auto is_inside = [&](int axis) { return cell[axis] >= 0 && cell[axis] < counts_[axis]; };
  while (is_inside(0) && is_inside(1) && is_inside(2)) {
    const size_t index = size_t((cell[2] * counts_[1] + cell[1]) * counts_[0] + cell[0]);
    for (int64_t slot = starts_[index]; slot < starts_[index + 1]; ++slot) {
      const int32_t b = items_[size_t(slot)];
      if (b == skipped_box) continue;
      const Hit hit = enter_box(boxes_[size_t(b)], origin, direction);
      if (!(hit.at < nearest.at)) continue;
      nearest = {hit.at, b, hit.side};
      if (is_any_enough) return nearest;
    }
    int axis = 0;
    if (crossing[1] < crossing[axis]) axis = 1;
    if (crossing[2] < crossing[axis]) axis = 2;
    if (nearest.at <= crossing[axis] || crossing[axis] > farthest || step[axis] == 0) break;
    cell[axis] += step[axis];
    crossing[axis] += spacing[axis];
  }
  return nearest;
}

void bake_light(const BakedFaces& faces, const BoxGrid& grid, const double* lamps, size_t lamp_count, double reach_m, bool has_shadows,
                float* light, size_t samples) {
  for (size_t f = 0; f < faces.count; ++f) {
    const double* quad = faces.quads + 9 * f;
    const Vec3 u_edge = vec3(quad + 3), v_edge = vec3(quad + 6), outward = cross(v_edge, u_edge), normal = (1.0 / norm(outward)) * outward;
    const int32_t *number = faces.numbers + 6 * f, along_u = number[4], along_v = number[5], own = faces.owners[2 * f];
    const int64_t skipped = own >= 0 ? own + faces.owner_shift : -1;
    for (int32_t j = 0; j < along_v; ++j)
      for (int32_t i = 0; i < along_u; ++i) {
        const double u = std::min(std::max(i / (along_u - 1.0), 0.04), 0.96), v = std::min(std::max(j / (along_v - 1.0), 0.04), 0.96);
        Vec3 origin;
        for (int axis = 0; axis < 3; ++axis) origin[axis] = quad[axis] + u * u_edge[axis] + v * v_edge[axis] + normal[axis] * 0.02;
        const size_t sample = size_t(number[3]) + size_t(j) * size_t(along_u) + size_t(i);
        for (const double* lamp = lamps; lamp < lamps + 5 * lamp_count; lamp += 5) {
          const Vec3 off = vec3(lamp) - origin;
          const double squared = dot(off, off);
          if (squared > reach_m * reach_m) continue;
          double cosine = dot(off, normal);
          if (cosine <= 0.0) continue;
          const double distance = std::sqrt(squared);
          cosine /= distance;
          const Vec3 direction = {off[0] / distance, off[1] / distance, off[2] / distance};
          if (has_shadows && grid.cast(origin, direction, distance, true, skipped).box >= 0) continue;
          const double fade = 1.0 - squared / (reach_m * reach_m);
          float& received = light[size_t(lamp[4]) * samples + sample];
          received = float(received + lamp[3] * cosine / (squared + 3.0) * fade / std::numbers::pi);
        }
      }
  }
}

}  // namespace fleetmap
