#include "arrays.h"  // first: Python's header comes before the system's

#include "calibration.h"

using namespace fleetmap;

namespace {

template <int64_t... kShape>
using Reals = Array<double, kShape...>;
template <int64_t... kShape>
using MutableReals = MutableArray<double, kShape...>;
using Indices = Array<int64_t, -1>;
using Images = std::tuple<Reals<-1, 4>, Reals<-1, 4, 6>, Reals<-1, 4, 3>, Reals<-1, 4, -1>>;
using Landmarks = std::tuple<MutableReals<-1, 3, 3>, MutableReals<-1, 3>, MutableReals<-1, 3, -1>>;

void check(bool holds, const char* message) {
  if (!holds) throw nb::value_error(message);
}

CalibrationRows rows_of(const Images& images, const Indices& keyframes, const Indices& starts, int64_t most_keyframes) {
  const auto& [residuals, by_keyframe, by_point, by_calibration] = images;
  const size_t count = residuals.shape(0);
  check(by_keyframe.shape(0) == count && by_point.shape(0) == count && by_calibration.shape(0) == count && keyframes.shape(0) == count,
        "images, keyframes: a row for each observation");
  for (size_t m = 0; m < count; ++m) check(keyframes(m) >= 0 && keyframes(m) < most_keyframes, "keyframes: those of the system");
  check(starts.shape(0) > 0 && starts(0) == 0 && starts(starts.shape(0) - 1) == int64_t(count), "starts: from 0 to all observations");
  for (size_t n = 1; n < starts.shape(0); ++n) check(starts(n - 1) <= starts(n), "starts: rising");
  return {residuals.data(), by_keyframe.data(), by_point.data(),     by_calibration.data(),
          keyframes.data(), starts.data(),      starts.shape(0) - 1, by_calibration.shape(2)};
}

CalibrationLandmarks landmarks_of(const Landmarks& landmarks, const CalibrationRows& rows) {
  const auto& [inverse, rhs, coupling] = landmarks;
  check(inverse.shape(0) == rows.landmarks && rhs.shape(0) == rows.landmarks && coupling.shape(0) == rows.landmarks &&
            coupling.shape(2) == rows.columns,
        "landmarks: a row for each, couplings as wide as the calibration");
  return {reinterpret_cast<Mat3*>(inverse.data()), reinterpret_cast<Vec3*>(rhs.data()), coupling.data()};
}

// How many keyframes a system of this size has.
int64_t keyframes_in(size_t size, const Images& images, int stride) {
  const size_t columns = std::get<3>(images).shape(2);
  check(stride >= 6, "stride: at least 6");
  check(size >= columns, "rhs: unknowns of the keyframes and of the calibration");
  return int64_t((size - columns) / size_t(stride));
}

bool reduce_landmarks_of(const Images& images, const Indices& keyframes, const Indices& starts, int stride, double damping,
                         const MutableReals<-1, -1>& information, const MutableReals<-1>& rhs, const Landmarks& landmarks) {
  const size_t size = rhs.shape(0);
  check(information.shape(0) == size && information.shape(1) == size, "information: square, as long as rhs");
  const auto rows = rows_of(images, keyframes, starts, keyframes_in(size, images, stride));
  const auto out = landmarks_of(landmarks, rows);
  return unlocked([&] { return reduce_landmarks(rows, size_t(stride), damping, size, information.data(), rhs.data(), out); });
}

auto landmark_steps_of(const Images& images, const Indices& keyframes, const Indices& starts, const Landmarks& landmarks, int stride,
                       const Reals<-1>& step) {
  const auto rows = rows_of(images, keyframes, starts, keyframes_in(step.shape(0), images, stride));
  const auto eliminated = landmarks_of(landmarks, rows);
  std::vector<Vec3> steps(rows.landmarks);
  const double* of_calibration = step.data() + step.shape(0) - rows.columns;
  unlocked([&] { landmark_steps(rows, size_t(stride), eliminated, step.data(), of_calibration, steps.data()); });
  return as_numpy<double, 2>(std::move(steps), {rows.landmarks, 3});
}

void weigh_of(const MutableReals<-1, 4, -1>& slopes, const Reals<-1, 4>& factors) {
  check(slopes.shape(0) == factors.shape(0), "factors: four for each observation");
  unlocked([&] { weigh(slopes.data(), factors.data(), factors.size(), slopes.shape(2)); });
}

}  // namespace

void bind_calibration(nb::module_& module) {
  const auto images = "images"_a.noconvert(), keyframes = "keyframes"_a.noconvert(), starts = "starts"_a.noconvert();
  const auto landmarks = "landmarks"_a.noconvert(), rhs = "rhs"_a.noconvert();
  module.def("reduce_landmarks", &reduce_landmarks_of, images, keyframes, starts, "stride"_a, "damping"_a, "information"_a.noconvert(), rhs,
             landmarks);
  module.def("landmark_steps", &landmark_steps_of, images, keyframes, starts, landmarks, "stride"_a, "step"_a.noconvert());
  module.def("weigh", &weigh_of, "slopes"_a.noconvert(), "factors"_a.noconvert());
}
