#include "arrays.h"  // first: Python's header comes before the system's

#include <algorithm>

#include "matching.h"
#include "projection.h"

using namespace fleetmap;

namespace {

using Packed = Array<uint64_t, -1, 4>;

Descriptors descriptors_of(const Packed& packed) { return {packed.data(), packed.shape(0)}; }

auto nearest_two_of(const Packed& a, const Packed& b) {
  const size_t count = a.shape(0);
  auto index = zeros<int64_t>(count);
  auto first = zeros<int32_t>(count), second = zeros<int32_t>(count);
  unlocked([&] { nearest_two(descriptors_of(a), descriptors_of(b), index.data(), first.data(), second.data()); });
  return std::make_tuple(as_numpy<int64_t>(std::move(index)), as_numpy<int32_t>(std::move(first)), as_numpy<int32_t>(std::move(second)));
}

auto pairs_array(Pairs&& pairs) {
  static_assert(sizeof(Pairs::value_type) == 2 * sizeof(int64_t));
  const size_t count = pairs.size();
  return as_numpy<int64_t, 2>(std::move(pairs), {count, 2});
}

auto mutual_of(const Packed& a, const Packed& b, int max_distance, double ratio) {
  return pairs_array(unlocked([&] { return mutual(descriptors_of(a), descriptors_of(b), max_distance, ratio); }));
}

auto mutual_within_of(const Packed& a, const Array<int32_t, -1, 2>& nodes_a, const Packed& b, const Array<int32_t, -1>& nodes_b,
                      int max_distance, double ratio) {
  constexpr int32_t kMostNodes = 1 << 20;
  if (nodes_a.shape(0) != a.shape(0) || nodes_b.shape(0) != b.shape(0)) throw nb::value_error("a node for each descriptor is needed");
  auto is_node = [](int32_t node) { return node >= 0 && node < kMostNodes; };
  if (!std::all_of(nodes_a.data(), nodes_a.data() + nodes_a.size(), is_node) ||
      !std::all_of(nodes_b.data(), nodes_b.data() + nodes_b.size(), is_node))
    throw nb::value_error("nodes are numbers from 0 to 2^20");
  return pairs_array(
      unlocked([&] { return mutual_within(descriptors_of(a), nodes_a.data(), descriptors_of(b), nodes_b.data(), max_distance, ratio); }));
}

auto match_projected_of(const Array<double, -1, 2>& predicted, const Array<double, -1>& radius_px, const Packed& a,
                        const Array<int64_t, -1, 2>& octave_range, const Array<double, -1, 2>& pixels, const Array<int8_t, -1>& octaves,
                        const Packed& b, int max_distance, double ratio) {
  const size_t count = a.shape(0);
  if (predicted.shape(0) != count || radius_px.shape(0) != count || octave_range.shape(0) != count)
    throw nb::value_error("predicted, radius_px, octave_range: one for each descriptor of a");
  if (pixels.shape(0) != b.shape(0) || octaves.shape(0) != b.shape(0))
    throw nb::value_error("pixels, octaves: one for each descriptor of b");
  auto index = zeros<int64_t>(count);
  auto distances = zeros<int32_t>(count);
  unlocked([&] {
    match_projected({predicted.data(), radius_px.data(), octave_range.data(), descriptors_of(a)},
                    {pixels.data(), octaves.data(), descriptors_of(b)}, max_distance, ratio, index.data(), distances.data());
  });
  return std::make_tuple(as_numpy<int64_t>(std::move(index)), as_numpy<int32_t>(std::move(distances)));
}

}  // namespace

void bind_matching(nb::module_& module) {
  const auto a = "a"_a.noconvert(), b = "b"_a.noconvert();
  module.def("nearest_two", &nearest_two_of, a, b);
  module.def("mutual", &mutual_of, a, b, "max_distance"_a, "ratio"_a);
  module.def("mutual_within", &mutual_within_of, a, "nodes_a"_a.noconvert(), b, "nodes_b"_a.noconvert(), "max_distance"_a, "ratio"_a);
  module.def("match_projected", &match_projected_of, "predicted"_a.noconvert(), "radius_px"_a.noconvert(), a, "octave_range"_a.noconvert(),
             "pixels"_a.noconvert(), "octaves"_a.noconvert(), b, "max_distance"_a, "ratio"_a);
}
