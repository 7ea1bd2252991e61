#include "arrays.h"  // first: Python's header comes before the system's

#include <algorithm>

#include "matching.h"

using namespace fleetmap;

namespace {

using Packed = Array<uint64_t, -1, 4>;

Descriptors descriptors_of(const Packed& packed) { return {packed.data(), packed.shape(0)}; }

auto nearest_two_of(const Packed& a, const Packed& b) {
  const size_t count = a.shape(0);
  std::vector<int64_t> index(count);
  std::vector<int32_t> first(count), second(count);
  unlocked([&] { nearest_two(descriptors_of(a), descriptors_of(b), index.data(), first.data(), second.data()); });
  return std::make_tuple(as_numpy<int64_t, 1>(std::move(index), {count}), as_numpy<int32_t, 1>(std::move(first), {count}),
                         as_numpy<int32_t, 1>(std::move(second), {count}));
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

}  // namespace

void bind_matching(nb::module_& module) {
  const auto a = "a"_a.noconvert(), b = "b"_a.noconvert();
  module.def("nearest_two", &nearest_two_of, a, b);
  module.def("mutual", &mutual_of, a, b, "max_distance"_a, "ratio"_a);
  module.def("mutual_within", &mutual_within_of, a, "nodes_a"_a.noconvert(), b, "nodes_b"_a.noconvert(), "max_distance"_a, "ratio"_a);
}
