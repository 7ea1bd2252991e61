#include "flow.h"
#include "images.h"  // first: Python's header comes before the system's

using namespace fleetmap;

namespace {

using Flags = MutableArray<bool, -1>;

void check(const Image& before, const Image& now, const Places& pixels, size_t places, const Flags& flags, const FlowSteps& steps) {
  if (places != pixels.shape(0) || flags.shape(0) != pixels.shape(0)) throw nb::value_error("places, flags: one for each pixel");
  if (steps.half < 1 || steps.half > kMostFlowHalf || steps.most < 0 || steps.most > 1000)
    throw nb::value_error("half: 1 to 7; steps: 0 to 1000");
  if (before.size() == 0 || now.size() == 0) throw nb::value_error("before, now: not empty");
}

void follow_of(const Image& before, const Image& now, double scale, int half, int steps, double settled_px, const Places& pixels,
               const MutableArray<double, -1, 2>& places, const Flags& found) {
  const FlowSteps flow{half, steps, settled_px};
  check(before, now, pixels, places.shape(0), found, flow);
  unlocked([&] { follow(grey(before), grey(now), scale, flow, pixels.data(), places.data(), found.data(), pixels.shape(0)); });
}

void check_back_of(const Image& before, const Image& now, int half, int steps, double settled_px, const Places& pixels,
                   const Places& places, double within_px, double margin_px, const Flags& held) {
  const FlowSteps flow{half, steps, settled_px};
  check(before, now, pixels, places.shape(0), held, flow);
  unlocked(
      [&] { check_back(grey(before), grey(now), flow, pixels.data(), places.data(), within_px, margin_px, held.data(), pixels.shape(0)); });
}

}  // namespace

void bind_flow(nb::module_& module) {
  const auto before = "before"_a.noconvert(), now = "now"_a.noconvert(), pixels = "pixels"_a.noconvert(), places = "places"_a.noconvert();
  module.def("follow_windows", &follow_of, before, now, "scale"_a, "half"_a, "steps"_a, "settled_px"_a, pixels, places,
             "found"_a.noconvert());
  module.def("check_windows_back", &check_back_of, before, now, "half"_a, "steps"_a, "settled_px"_a, pixels, places, "within_px"_a,
             "margin_px"_a, "held"_a.noconvert());
}
