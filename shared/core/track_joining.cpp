// Matched features joined to tracks.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <numeric>

namespace fleetmap {
namespace {

// The root of each of V nodes after joining first (L,) with second (L,) in their order; keyframes (V,): a link that would bring two nodes
// of one keyframe into one group is left out. Sources: union-find, Tarjan 1975; tracks over unordered pairs, Moulon and Monasse 2012.
std::vector<int32_t> joined(const Numbers& first, const Numbers& second, const Numbers& keyframes) {
  const size_t nodes = keyframes.shape(0);
  const auto is_other = [&](int32_t node) { return size_t(node) >= nodes; };
  if (std::any_of(first.begin(), first.end(), is_other) || std::any_of(second.begin(), second.end(), is_other))
    throw nb::value_error("first, second: numbers of nodes");
  if (std::any_of(keyframes.begin(), keyframes.end(), is_other)) throw nb::value_error("keyframes: numbers below that of the nodes");
  // Groups are trees of parents, and lists of successors, which begin at the root.
  std::vector<int32_t> parents(nodes), sizes(nodes, 1), following(nodes, -1), last(nodes), marks(nodes, -1);
  std::iota(parents.begin(), parents.end(), 0);
  std::iota(last.begin(), last.end(), 0);
  const auto mark = [&](int32_t node) -> int32_t& { return marks[size_t(keyframes.begin()[node])]; };
  const auto root = [&](int32_t node) {
    while (parents[size_t(node)] != node) {
      parents[size_t(node)] = parents[size_t(parents[size_t(node)])];
      node = parents[size_t(node)];
    }
    return node;
  };
  for (int32_t link = 0; size_t(link) < first.size(); ++link) {
    int32_t a = root(first.begin()[link]), b = root(second.begin()[link]);
    if (a == b) continue;
    if (sizes[size_t(a)] < sizes[size_t(b)]) std::swap(a, b);
    for (int32_t node = a; node >= 0; node = following[size_t(node)]) mark(node) = link;
    bool clashes = false;
    for (int32_t node = b; node >= 0 && !clashes; node = following[size_t(node)]) clashes = mark(node) == link;
    if (clashes) continue;
    parents[size_t(b)] = a;
    sizes[size_t(a)] += sizes[size_t(b)];
    following[size_t(last[size_t(a)])] = b;
    last[size_t(a)] = last[size_t(b)];
  }
  for (size_t node = 0; node < nodes; ++node) parents[node] = root(int32_t(node));
  return parents;
}

auto join_tracks(const Numbers& first, const Numbers& second, const Numbers& keyframes) {
  if (first.shape(0) != second.shape(0)) throw nb::value_error("second: as many as first");
  return as_numpy<int32_t>(unlocked([&] { return joined(first, second, keyframes); }));
}

}  // namespace

void bind_track_joining(nb::module_& module) { module.def("join_tracks", &join_tracks, "first"_a, "second"_a, "keyframes"_a); }

}  // namespace fleetmap
