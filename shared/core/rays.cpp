// Rays against yawed boxes in a uniform grid: for baking light into the simulator's faces. Lengths in metres, in map.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

namespace fleetmap {
namespace {

constexpr double kNever = 1e30;

// A solid box: centre, half sizes, cosine and sine of its yaw.
struct YawedBox {
  Vec3 centre, half;
  double cosine, sine;
};

// Entry of a ray into a box: the ray's parameter, the box or -1, and its side, 0 to 5 for xXyYzZ.
struct Hit {
  double at;
  int64_t box, side;
};

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

// Boxes by the cells that they touch.
class BoxGrid {
 public:
  // The grid of boxes between two corners; parts outside are ignored.
  BoxGrid(const Array<double, -1, 8>& boxes, const Vec3& low, const Vec3& high, double cell_m) : low_(low), cell_m_(cell_m) {
    constexpr double kMostCellsAlong = 4096, kMostCells = 1 << 24;
    double cells = 1.0;
    for (int axis = 0; axis < 3; ++axis) {
      const double along = std::ceil((high[axis] - low[axis]) / cell_m);
      cells *= std::max(1.0, along);
      if (along > kMostCellsAlong || cells > kMostCells) throw nb::value_error("low, high, cell_m: at most 2^24 cells, 4096 along an axis");
      counts_[axis] = std::max<int64_t>(0, whole(along));
    }
    const nb::gil_scoped_release others_run;
    for (const double* b = boxes.begin(); b < boxes.end(); b += 8) boxes_.push_back({vec3(b), vec3(b + 3), b[6], b[7]});
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
          first[axis] = std::max<int64_t>(0, whole(std::floor((box.centre[axis] - reach[axis] - low[axis]) / cell_m)));
          last[axis] = std::min<int64_t>(counts_[axis] - 1, whole(std::floor((box.centre[axis] + reach[axis] - low[axis]) / cell_m)));
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

  // The nearest hit up to `farthest`, from an origin inside the grid and outside of the boxes, or any where that is enough (shadows).
  // Walks from cell to cell. Source: Amanatides and Woo 1987.
  Hit cast(Vec3 origin, Vec3 direction, double farthest, bool is_any_enough, int64_t skipped_box) const {
    int64_t cell[3], step[3];
    double crossing[3], spacing[3];
    for (int axis = 0; axis < 3; ++axis) {
      cell[axis] = whole(std::floor((origin[axis] - low_[axis]) / cell_m_));
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

 private:
  std::vector<YawedBox> boxes_;
  Vec3 low_;
  double cell_m_;
  int64_t counts_[3];
  std::vector<int64_t> starts_;  // of each cell's list among items_
  std::vector<int32_t> items_;
};

// Parameters of the nearest hits of rays, and their boxes and sides.
auto cast(const BoxGrid& grid, const Vec3& origin, const Points& directions, const Reals& farthest) {
  const size_t count = directions.shape(0);
  check_rows(count, "farthest: one for each of directions", farthest);
  auto at = zeros<double>(count);
  auto hits = zeros<std::array<int64_t, 2>>(count);
  unlocked([&] {
    for (size_t i = 0; i < count; ++i) {
      const Hit hit = grid.cast(origin, vec3(&directions(i, 0)), farthest(i), false, -1);
      at[i] = hit.at, hits[i] = {hit.box, hit.side};
    }
  });
  return std::tuple(std::move(at), std::move(hits));
}

// Adds the direct light of lamps (L, 5), x y z power group, to light (groups, samples) of faces: quads (F, 9) of origin, edge U and edge V;
// numbers (F, 6), of which the last three are the first light sample and the samples along U and V; owners (F, 2), of which the first is
// the number of the own box after owner_shift, -1 none. A lamp's term is 1 / (r^2 + 3), softened because lamps are long; it fades to 0 at
// reach_m.
void bake(const BoxGrid& grid, const Array<double, -1, 9>& quads, const Array<int32_t, -1, 6>& numbers, const Array<int32_t, -1, 2>& owners,
          int64_t owner_shift, const Array<double, -1, 5>& lamps, double reach_m, bool has_shadows,
          const MutableArray<float, -1, -1>& light) {
  const size_t count = quads.shape(0), samples = light.shape(1);
  check_rows(count, "numbers, owners: one for each of quads", numbers, owners);
  if (std::abs(double(owner_shift)) > double(1u << 31)) throw nb::value_error("owner_shift: within 2^31");
  const nb::gil_scoped_release others_run;
  for (size_t f = 0; f < count; ++f) {
    const int64_t first = numbers(f, 3), columns = numbers(f, 4), rows = numbers(f, 5);
    if (first < 0 || columns < 0 || rows < 0 || first + columns * rows > int64_t(samples))
      throw nb::value_error("numbers: light samples of light");
  }
  for (size_t n = 0; n < lamps.shape(0); ++n)
    if (!(lamps(n, 4) >= 0.0 && lamps(n, 4) < double(light.shape(0)))) throw nb::value_error("lamps: groups of light");
  float* const light_of = light.data();
  for (size_t f = 0; f < count; ++f) {
    const double* quad = quads.data() + 9 * f;
    const Vec3 u_edge = vec3(quad + 3), v_edge = vec3(quad + 6), outward = cross(v_edge, u_edge), normal = (1.0 / norm(outward)) * outward;
    const int32_t *number = numbers.data() + 6 * f, along_u = number[4], along_v = number[5], own = owners(f, 0);
    const int64_t skipped = own >= 0 ? own + owner_shift : -1;
    for (int32_t j = 0; j < along_v; ++j)
      for (int32_t i = 0; i < along_u; ++i) {
        const double u = std::min(std::max(i / (along_u - 1.0), 0.04), 0.96), v = std::min(std::max(j / (along_v - 1.0), 0.04), 0.96);
        Vec3 origin;
        for (int axis = 0; axis < 3; ++axis) origin[axis] = quad[axis] + u * u_edge[axis] + v * v_edge[axis] + normal[axis] * 0.02;
        const size_t sample = size_t(number[3]) + size_t(j) * size_t(along_u) + size_t(i);
        for (const double* lamp = lamps.begin(); lamp < lamps.end(); lamp += 5) {
          const Vec3 off = vec3(lamp) - origin;
          const double squared = dot(off, off);
          if (squared > reach_m * reach_m) continue;
          double cosine = dot(off, normal);
          if (cosine <= 0.0) continue;
          const double distance = std::sqrt(squared);
          cosine /= distance;
          const Vec3 direction = off / distance;
          if (has_shadows && grid.cast(origin, direction, distance, true, skipped).box >= 0) continue;
          const double fade = 1.0 - squared / (reach_m * reach_m);
          float& received = light_of[size_t(lamp[4]) * samples + sample];
          received = float(received + lamp[3] * cosine / (squared + 3.0) * fade / std::numbers::pi);
        }
      }
  }
}

}  // namespace

void bind_rays(nb::module_& module) {
  nb::class_<BoxGrid>(module, "BoxGrid")
      .def(nb::init<const Array<double, -1, 8>&, const Vec3&, const Vec3&, double>(), "boxes"_a, "low"_a, "high"_a, "cell_m"_a)
      .def("cast", &cast, "origin"_a, "directions"_a, "farthest"_a)
      .def("bake", &bake, "quads"_a, "numbers"_a, "owners"_a, "owner_shift"_a, "lamps"_a, "reach_m"_a, "has_shadows"_a, "light"_a);
}

}  // namespace fleetmap
