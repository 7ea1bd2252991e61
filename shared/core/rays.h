// Rays against yawed boxes in a uniform grid: for baking light into the simulator's faces. Lengths in metres, in map.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "lie.h"

namespace fleetmap {

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

// Boxes by the cells that they touch.
class BoxGrid {
 public:
  // The grid of boxes between two corners; parts outside are ignored.
  BoxGrid(std::vector<YawedBox> boxes, Vec3 low, Vec3 high, double cell_m);
  // The nearest hit up to `farthest`, from an origin inside the grid and outside of the boxes, or any where that is enough (shadows).
  // Walks from cell to cell. Source: Amanatides and Woo 1987.
  Hit cast(Vec3 origin, Vec3 direction, double farthest, bool is_any_enough, int64_t skipped_box) const;
  size_t size() const { return boxes_.size(); }

 private:
  std::vector<YawedBox> boxes_;
  Vec3 low_;
  double cell_m_;
  int64_t counts_[3];
  std::vector<int64_t> starts_;  // of each cell's list among items_
  std::vector<int32_t> items_;
};

// Faces whose light is baked: quads (F, 9) of origin, edge U and edge V; numbers (F, 6), of which the last three are the first light
// sample and the samples along U and V; owners (F, 2), of which the first is the number of the own box after owner_shift, -1 none.
struct BakedFaces {
  const double* quads;
  const int32_t *numbers, *owners;
  size_t count;
  int64_t owner_shift;
};

// Adds the direct light of lamps (L, 5), x y z power group, to light (groups, samples). A lamp's term is 1 / (r^2 + 3), softened because
// lamps are long; it fades to 0 at reach_m.
void bake_light(const BakedFaces& faces, const BoxGrid& grid, const double* lamps, size_t lamp_count, double reach_m, bool has_shadows,
                float* light, size_t samples);

}  // namespace fleetmap
