#include "arrays.h"  // first: Python's header comes before the system's

#include <optional>

#include "pnp.h"

using namespace fleetmap;

namespace {

using Lens = Array<double, 4>;
using Points = Array<double, -1, 3>;

StereoLens stereo_lens(const Lens& lens) { return {lens(0), lens(1), lens(2), lens(3)}; }

auto refine_pnp_of(const Array<double, 4, 4>& cam_from_source, const Points& points, const Points& pixels,
                   const Array<double, -1, 2>& weights, const Lens& lens,
                   const std::tuple<double, double, std::tuple<int, int>>& refinement, const std::optional<Array<double, 6, 6>>& prior) {
  const size_t count = points.shape(0);
  if (pixels.shape(0) != count || weights.shape(0) != count) throw nb::value_error("pixels and weights: one row for each point");
  const auto [width, gate_squared, iterations] = refinement;
  using Result = std::tuple<nb::ndarray<nb::numpy, double, nb::ndim<2>>, nb::ndarray<nb::numpy, double, nb::ndim<2>>,
                            nb::ndarray<nb::numpy, double, nb::ndim<1>>>;
  SE3 refined = se3(cam_from_source.data());
  std::vector<double> information(36), squared(count), matrix(16);
  const bool is_solved = unlocked([&] {
    const Sightings seen{points.data(), pixels.data(), weights.data(), count};
    const Refinement limits{width, gate_squared, std::get<0>(iterations), std::get<1>(iterations)};
    return refine_twice(seen, stereo_lens(lens), limits, prior ? prior->data() : nullptr, refined, information.data(), squared.data());
  });
  if (!is_solved) return std::optional<Result>();
  if (prior)
    for (size_t k = 0; k < 36; ++k) information[k] += prior->data()[k];
  store(refined, matrix.data());
  return std::optional<Result>(Result(as_numpy<double, 2>(std::move(matrix), {4, 4}), as_numpy<double, 2>(std::move(information), {6, 6}),
                                      as_numpy<double, 1>(std::move(squared), {count})));
}

auto search_translation_of(const Array<double, 3, 3>& rotation, const Points& points, const Points& seen_points,
                           const Array<double, -1, 2>& pixels, const Lens& lens, double threshold_px) {
  const size_t count = points.shape(0);
  if (seen_points.shape(0) != count || pixels.shape(0) != count) throw nb::value_error("seen_points and pixels: one row for each point");
  Vec3 best = {};
  const int score = unlocked([&] {
    return search_translation(mat3(rotation.data()), points.data(), seen_points.data(), pixels.data(), count, stereo_lens(lens),
                              threshold_px, best);
  });
  return std::make_tuple(score, as_numpy<double, 1>(std::vector<double>(best.at, best.at + 3), {3}));
}

}  // namespace

void bind_pnp(nb::module_& module) {
  const auto points = "points"_a.noconvert(), pixels = "pixels"_a.noconvert(), lens = "lens"_a.noconvert();
  module.def("refine_pnp", &refine_pnp_of, "cam_from_source"_a.noconvert(), points, pixels, "weights"_a.noconvert(), lens, "refinement"_a,
             "prior"_a.noconvert().none());
  module.def("search_translation", &search_translation_of, "rotation"_a.noconvert(), points, "seen_points"_a.noconvert(), pixels, lens,
             "threshold_px"_a);
}
