#include "track_joining.h"

#include <algorithm>
#include <numeric>
#include <utility>

namespace fleetmap {

std::vector<int32_t> join_tracks(const int32_t* first, const int32_t* second, size_t links, const int32_t* keyframes, size_t nodes) {
  // Groups are trees of parents, and lists of successors, which begin at the root.
  std::vector<int32_t> parents(nodes), sizes(nodes, 1), following(nodes, -1), last(nodes);
  std::iota(parents.begin(), parents.end(), 0);
  std::iota(last.begin(), last.end(), 0);
  std::vector<int32_t> marks(nodes ? size_t(*std::max_element(keyframes, keyframes + nodes)) + 1 : 0, -1);
  auto root = [&](int32_t node) {
    while (parents[size_t(node)] != node) {
      parents[size_t(node)] = parents[size_t(parents[size_t(node)])];
      node = parents[size_t(node)];
    }
    return node;
  };
  for (size_t link = 0; link < links; ++link) {
    int32_t a = root(first[link]), b = root(second[link]);
    if (a == b) continue;
    if (sizes[size_t(a)] < sizes[size_t(b)]) std::swap(a, b);
    for (int32_t node = a; node >= 0; node = following[size_t(node)]) marks[size_t(keyframes[node])] = int32_t(link);
    bool clashes = false;
    for (int32_t node = b; node >= 0 && !clashes; node = following[size_t(node)]) clashes = marks[size_t(keyframes[node])] == int32_t(link);
    if (clashes) continue;
    parents[size_t(b)] = a;
    sizes[size_t(a)] += sizes[size_t(b)];
    following[size_t(last[size_t(a)])] = b;
    last[size_t(a)] = last[size_t(b)];
  }
  for (size_t node = 0; node < nodes; ++node) parents[node] = root(int32_t(node));
  return parents;
}

}  // namespace fleetmap
