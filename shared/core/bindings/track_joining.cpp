#include "track_joining.h"
#include "arrays.h"  // first: Python's header comes before the system's

using namespace fleetmap;

namespace {

using Links = Array<int32_t, -1>;

auto join_tracks_of(const Links& first, const Links& second, const Links& keyframes) {
  if (first.shape(0) != second.shape(0)) throw nb::value_error("second: as many as first");
  const size_t nodes = keyframes.shape(0), links = first.shape(0);
  auto roots = unlocked([&] {
    for (size_t k = 0; k < links; ++k)
      if (size_t(first(k)) >= nodes || size_t(second(k)) >= nodes) throw nb::value_error("first, second: numbers of nodes");
    for (size_t n = 0; n < nodes; ++n)
      if (size_t(keyframes(n)) >= nodes) throw nb::value_error("keyframes: numbers below that of the nodes");
    return join_tracks(first.data(), second.data(), links, keyframes.data(), nodes);
  });
  return as_numpy<int32_t>(std::move(roots));
}

}  // namespace

void bind_track_joining(nb::module_& module) {
  module.def("join_tracks", &join_tracks_of, "first"_a.noconvert(), "second"_a.noconvert(), "keyframes"_a.noconvert());
}
