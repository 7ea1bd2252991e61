#include "arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <bit>
#include <cmath>
#include <mutex>

#include "rays.h"
#include "render.h"

using namespace fleetmap;

namespace {

using Reals = Array<double, -1>;
using Quads = Array<double, -1, 9>;
using Sixes = Array<double, -1, 6>;
using Numbers = Array<int32_t, -1, 6>;
using Lit = std::tuple<Quads, Sixes, Numbers, Array<float, -1>, Reals>;
using Chunks = std::tuple<Array<int32_t, -1, 2>, Sixes>;
using Atlas = std::tuple<Array<uint8_t, -1>, Array<int32_t, -1, -1>, Array<int32_t, -1, -1>, Array<int32_t, 2>>;
using Triple = Array<double, 3>;

constexpr double kMostPx = 8192, kMostCellsAlong = 4096;

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
  if (values.shape(0) != count || numbers.shape(0) != count) throw nb::value_error("faces: columns of one length");
  for (size_t f = 0; f < count; ++f) {
    if (numbers(f, 2) < 0 || size_t(numbers(f, 2)) >= groups.shape(0)) throw nb::value_error("faces: lamp groups that have a strength");
    if (numbers(f, 0) == kLamp) continue;
    if (numbers(f, 1) < 0 || numbers(f, 1) >= textures) throw nb::value_error("faces: textures of the table");
    const int64_t first = numbers(f, 3), columns = numbers(f, 4), rows = numbers(f, 5);
    if (first < 0 || columns < 2 || rows < 2 || first + columns * rows > samples)
      throw nb::value_error("faces: 2 x 2 light samples or more");
  }
  if (bounds.shape(0) != ranges.shape(0)) throw nb::value_error("chunks: a range and bounds of each");
  for (size_t c = 0; c < ranges.shape(0); ++c)
    if (ranges(c, 0) < 0 || ranges(c, 1) > int64_t(count)) throw nb::value_error("chunks: ranges of faces");
  return {quads.data(), values.data(), numbers.data(), light.data(), groups.data(), ranges.data(), bounds.data(), ranges.shape(0)};
}

// A painter whose calls come one after the other, whichever threads they are from.
class Painter {
 public:
  Painter(const Array<double, 6>& plane, const Array<float, -1, -1, 4>& rays)
      : painter_(checked(plane), {rays.data(), ptrdiff_t(rays.shape(0)), ptrdiff_t(rays.shape(1))}),
        rows_(rays.size() ? rays.shape(0) : size_t(plane(5))),
        columns_(rays.size() ? rays.shape(1) : size_t(plane(4))) {}

  void add(const Lit& lit, const Chunks& chunks, const Atlas& atlas, const Array<double, 3, 3>& cam_from_map, const Triple& centre_map,
           int samples, std::tuple<double, double> shift, double weight, int most_taps, double reflectance,
           const Array<double, -1, 3>& shadows, bool wants_truth, const MutableArray<double, -1, -1>& radiance,
           const MutableArray<float, -1, -1>& depth_m, const MutableArray<int32_t, -1, -1>& faces) {
    if (samples < 1 || samples > 4) throw nb::value_error("samples: 1 to 4");
    if (!is_picture(radiance) || !is_picture(depth_m) || !is_picture(faces))
      throw nb::value_error("radiance, depth_m, faces: of the picture's size");
    unlocked([&] {
      const Textures textures = textures_of(atlas);
      const Surfaces surfaces = surfaces_of(lit, chunks, int64_t(std::get<1>(atlas).shape(0)));
      const std::lock_guard alone(mutex_);
      painter_.add(
          surfaces, textures, mat3(cam_from_map.data()), vec3(centre_map.data()),
          {samples, std::get<0>(shift), std::get<1>(shift), weight, most_taps, reflectance, wants_truth, shadows.data(), shadows.shape(0)},
          {{radiance.data(), ptrdiff_t(rows_), ptrdiff_t(columns_)}, depth_m.data(), faces.data()});
    });
  }

 private:
  static Plane checked(const Array<double, 6>& plane) {
    if (!(plane(4) >= 1 && plane(4) <= kMostPx && plane(5) >= 1 && plane(5) <= kMostPx))
      throw nb::value_error("plane: 1 to 8192 px each way");
    return {plane(0), plane(1), plane(2), plane(3), ptrdiff_t(plane(4)), ptrdiff_t(plane(5))};
  }
  template <typename Image>
  bool is_picture(const Image& image) const {
    return image.shape(0) == rows_ && image.shape(1) == columns_;
  }

  std::mutex mutex_;
  ScenePainter painter_;
  size_t rows_, columns_;  // once the plane is checked
};

auto develop_of(const Array<double, -1, -1>& radiance, double gain, double shot, double read, const Array<float, -1>& normals, int64_t key,
                const Array<float, -1, -1>& vignetting) {
  const size_t rows = radiance.shape(0), columns = radiance.shape(1);
  if (!std::has_single_bit(normals.shape(0))) throw nb::value_error("normals: as many as a power of two");
  if (vignetting.shape(0) != rows || vignetting.shape(1) != columns) throw nb::value_error("vignetting: of the picture's size");
  auto image = zeros<uint8_t>(rows * columns);
  unlocked([&] {
    develop({radiance.data(), ptrdiff_t(rows), ptrdiff_t(columns)}, gain, shot, read, normals.data(), normals.shape(0), uint64_t(key),
            vignetting.data(), image.data());
  });
  return as_numpy<uint8_t, 2>(std::move(image), {rows, columns});
}

BoxGrid box_grid_of(const Array<double, -1, 8>& boxes, const Triple& low, const Triple& high, double cell_m) {
  double cells = 1.0;
  for (size_t axis = 0; axis < 3; ++axis) {
    const double along = std::max(1.0, std::ceil((high(axis) - low(axis)) / cell_m));
    cells *= along;
    if (along > kMostCellsAlong || cells > double(1 << 24))
      throw nb::value_error("low, high, cell_m: at most 2^24 cells, 4096 along an axis");
  }
  return unlocked([&] {
    std::vector<YawedBox> all(boxes.shape(0));
    for (size_t b = 0; b < all.size(); ++b)
      all[b] = {{boxes(b, 0), boxes(b, 1), boxes(b, 2)}, {boxes(b, 3), boxes(b, 4), boxes(b, 5)}, boxes(b, 6), boxes(b, 7)};
    return BoxGrid(std::move(all), vec3(low.data()), vec3(high.data()), cell_m);
  });
}

auto cast_of(const BoxGrid& grid, const Triple& origin, const Array<double, -1, 3>& directions, const Reals& farthest) {
  const size_t count = directions.shape(0);
  if (farthest.shape(0) != count) throw nb::value_error("farthest: one for each of directions");
  auto at = zeros<double>(count);
  auto hits = zeros<int64_t>(2 * count);
  unlocked([&] {
    for (size_t i = 0; i < count; ++i) {
      const Hit hit = grid.cast(vec3(origin.data()), vec3(directions.data() + 3 * i), farthest(i), false, -1);
      at[i] = hit.at, hits[2 * i] = hit.box, hits[2 * i + 1] = hit.side;
    }
  });
  return std::tuple(as_numpy<double>(std::move(at)), as_numpy<int64_t, 2>(std::move(hits), {count, 2}));
}

void bake_of(const BoxGrid& grid, const Quads& quads, const Numbers& numbers, const Array<int32_t, -1, 2>& owners, int64_t owner_shift,
             const Array<double, -1, 5>& lamps, double reach_m, bool has_shadows, const MutableArray<float, -1, -1>& light) {
  const size_t count = quads.shape(0);
  if (numbers.shape(0) != count || owners.shape(0) != count) throw nb::value_error("numbers, owners: one for each of quads");
  if (std::abs(double(owner_shift)) > double(1u << 31)) throw nb::value_error("owner_shift: within 2^31");
  unlocked([&] {
    for (size_t f = 0; f < count; ++f) {
      const int64_t first = numbers(f, 3), columns = numbers(f, 4), rows = numbers(f, 5);
      if (first < 0 || columns < 0 || rows < 0 || first + columns * rows > int64_t(light.shape(1)))
        throw nb::value_error("numbers: light samples of light");
    }
    for (size_t n = 0; n < lamps.shape(0); ++n)
      if (!(lamps(n, 4) >= 0.0 && lamps(n, 4) < double(light.shape(0)))) throw nb::value_error("lamps: groups of light");
    bake_light({quads.data(), numbers.data(), owners.data(), count, owner_shift}, grid, lamps.data(), lamps.shape(0), reach_m, has_shadows,
               light.data(), light.shape(1));
  });
}

}  // namespace

void bind_render(nb::module_& module) {
  nb::class_<Painter>(module, "ScenePainter")
      .def(nb::init<const Array<double, 6>&, const Array<float, -1, -1, 4>&>(), "plane"_a.noconvert(), "rays"_a.noconvert())
      .def("add", &Painter::add, "faces"_a.noconvert(), "chunks"_a.noconvert(), "textures"_a.noconvert(), "cam_from_map"_a.noconvert(),
           "centre_map"_a.noconvert(), "samples"_a, "shift_px"_a, "weight"_a, "most_taps"_a, "reflectance"_a, "shadows"_a.noconvert(),
           "wants_truth"_a, "radiance"_a.noconvert(), "depth_m"_a.noconvert(), "face_of"_a.noconvert());
  module.def("develop", &develop_of, "radiance"_a.noconvert(), "gain"_a, "shot"_a, "read"_a, "normals"_a.noconvert(), "key"_a,
             "vignetting"_a.noconvert());
  nb::class_<BoxGrid>(module, "BoxGrid")
      .def(nb::new_(&box_grid_of), "boxes"_a.noconvert(), "low"_a.noconvert(), "high"_a.noconvert(), "cell_m"_a)
      .def("cast", &cast_of, "origin"_a.noconvert(), "directions"_a.noconvert(), "farthest"_a.noconvert())
      .def("bake", &bake_of, "quads"_a.noconvert(), "numbers"_a.noconvert(), "owners"_a.noconvert(), "owner_shift"_a, "lamps"_a.noconvert(),
           "reach_m"_a, "has_shadows"_a, "light"_a.noconvert());
}
