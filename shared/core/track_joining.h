// Matched features joined to tracks.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace fleetmap {

// The root of each of V nodes after joining first (L,) with second (L,) in their order; keyframes (V,): a link that would bring two nodes
// of one keyframe into one group is left out. Sources: union-find, Tarjan 1975; tracks over unordered pairs, Moulon and Monasse 2012.
std::vector<int32_t> join_tracks(const int32_t* first, const int32_t* second, size_t links, const int32_t* keyframes, size_t nodes);

}  // namespace fleetmap
