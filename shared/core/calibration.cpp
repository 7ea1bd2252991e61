#include "calibration.h"

#include <algorithm>
#include <limits>

#include "dense.h"

namespace fleetmap {
namespace {

constexpr size_t kRows = 4, kPose = 6;

// to (n,) += a0 x_0 + a1 x_1 + a2 x_2 + a3 x_3 for the four rows x of an observation, from number `first` on.
inline void add_rows(const double* a, size_t a_stride, const double* __restrict x, size_t n, double* __restrict to, size_t first = 0) {
  const double a0 = a[0], a1 = a[a_stride], a2 = a[2 * a_stride], a3 = a[3 * a_stride];
  for (size_t c = first; c < n; ++c) to[c] = to[c] + a0 * x[c] + a1 * x[n + c] + a2 * x[2 * n + c] + a3 * x[3 * n + c];
}

// to (n,) -= a0 x_0 + a1 x_1 + a2 x_2 for three rows x.
inline void subtract_rows(double a0, double a1, double a2, const double* __restrict x, size_t n, double* __restrict to, size_t first = 0) {
  for (size_t c = first; c < n; ++c) to[c] = to[c] - a0 * x[c] - a1 * x[n + c] - a2 * x[2 * n + c];
}

inline void subtract(const double* slopes, double value, size_t count, double* from) {
  for (size_t a = 0; a < count; ++a) from[a] -= slopes[a] * value;
}

}  // namespace

bool reduce_landmarks(const CalibrationRows& rows, size_t stride, double damping, size_t size, double* information, double* rhs,
                      const CalibrationLandmarks& out) {
  const size_t columns = rows.columns, border = size - columns;
  std::vector<double> coupled, corner(columns * columns), lifted(3 * columns);  // W of each observation, H_cc's upper triangle, H_ll^-1 E
  bool finite = true;
  for (size_t n = 0; n < rows.landmarks; ++n) {
    const size_t begin = size_t(rows.starts[n]), end = size_t(rows.starts[n + 1]);
    double *coupling = out.coupling + 3 * columns * n, block[9] = {};
    Vec3 slope = {};
    std::fill_n(coupling, 3 * columns, 0.0);
    coupled.assign((end - begin) * kPose * 3, 0.0);
    for (size_t row = begin; row < end; ++row) {
      const double *point = rows.by_point + row * kRows * 3, *pose = rows.by_keyframe + row * kRows * kPose;
      const double* calibration = rows.by_calibration + row * kRows * columns;
      double* at = information + size_t(rows.keyframes[row]) * stride * (size + 1);
      for (size_t a = 0; a < 3; ++a) {
        add_rows(point + a, 3, point, 3, block + 3 * a);
        add_rows(point + a, 3, calibration, columns, coupling + a * columns);
      }
      for (size_t a = 0; a < kPose; ++a) {
        add_rows(pose + a, kPose, point, 3, &coupled[((row - begin) * kPose + a) * 3]);
        add_rows(pose + a, kPose, pose, kPose, at + a * size);
        add_rows(pose + a, kPose, calibration, columns, information + (size_t(rows.keyframes[row]) * stride + a) * size + border);
      }
      for (size_t a = 0; a < columns; ++a) add_rows(calibration + a, columns, calibration, columns, &corner[a * columns], a);
      for (size_t e = 0; e < kRows; ++e) {
        const double residual = rows.residuals[row * kRows + e];
        subtract(point + e * 3, residual, 3, slope.at);
        subtract(pose + e * kPose, residual, kPose, rhs + size_t(rows.keyframes[row]) * stride);
        subtract(calibration + e * columns, residual, columns, rhs + border);
      }
    }
    Mat3 damped = mat3(block);
    const double sum = trace(damped);
    for (int a = 0; a < 3; ++a) damped[a][a] += damping * damped[a][a] + 1e-9 * sum + 1e-12;
    const Mat3 held = out.inverse[n] = inverse_symmetric(damped);
    finite = finite && is_finite(held[0], 9);
    out.rhs[n] = slope;
    const Vec3 pulled = held * slope;
    subtract_rows(pulled[0], pulled[1], pulled[2], coupling, columns, rhs + border);
    multiply(held[0], coupling, lifted.data(), 3, 3, columns);
    for (size_t a = 0; a < columns; ++a)
      subtract_rows(coupling[a], coupling[columns + a], coupling[2 * columns + a], lifted.data(), columns, &corner[a * columns], a);
    for (size_t m = begin; m < end; ++m) {
      const size_t at = size_t(rows.keyframes[m]) * stride;
      const double* from = &coupled[(m - begin) * kPose * 3];
      double turned[kPose * 3];  // W H_ll^-1
      multiply(from, held[0], turned, kPose, 3, 3);
      for (size_t a = 0; a < kPose; ++a)
        for (size_t d = 0; d < 3; ++d) rhs[at + a] -= from[3 * a + d] * pulled[int(d)];
      for (size_t a = 0; a < kPose; ++a)
        subtract_rows(from[3 * a], from[3 * a + 1], from[3 * a + 2], lifted.data(), columns, information + (at + a) * size + border);
      for (size_t other = m; other < end; ++other) {
        const size_t to = size_t(rows.keyframes[other]) * stride;
        const double* there = &coupled[(other - begin) * kPose * 3];
        double* corner_of_block = information + std::min(at, to) * size + std::max(at, to);
        const size_t down = to < at ? 1 : size, right = to < at ? size : 1;
        for (size_t a = 0; a < kPose; ++a)
          for (size_t b = 0; b < kPose; ++b)
            corner_of_block[a * down + b * right] -=
                turned[3 * a] * there[3 * b] + turned[3 * a + 1] * there[3 * b + 1] + turned[3 * a + 2] * there[3 * b + 2];
      }
    }
  }
  for (size_t a = 0; a < columns; ++a)
    for (size_t b = 0; b < columns; ++b) information[(border + a) * size + border + b] += corner[std::min(a, b) * columns + std::max(a, b)];
  return finite;
}

void landmark_steps(const CalibrationRows& rows, size_t stride, const CalibrationLandmarks& eliminated, const double* of_keyframes,
                    const double* of_calibration, Vec3* steps) {
  const size_t columns = rows.columns;
  for (size_t n = 0; n < rows.landmarks; ++n) {
    Vec3 slope = eliminated.rhs[n];
    for (size_t a = 0; a < 3; ++a) {
      double coupled = 0.0;
      for (size_t c = 0; c < columns; ++c) coupled += eliminated.coupling[(3 * n + a) * columns + c] * of_calibration[c];
      slope[int(a)] -= coupled;
    }
    for (size_t row = size_t(rows.starts[n]); row < size_t(rows.starts[n + 1]); ++row) {
      const double* step = of_keyframes + size_t(rows.keyframes[row]) * stride;
      for (size_t e = row * kRows; e < (row + 1) * kRows; ++e) {
        double value = 0.0;
        for (size_t a = 0; a < kPose; ++a) value += rows.by_keyframe[e * kPose + a] * step[a];
        slope = slope - value * vec3(rows.by_point + e * 3);
      }
    }
    steps[n] = eliminated.inverse[n] * slope;
  }
}

void weigh(double* slopes, const double* factors, size_t count, size_t width) {
  constexpr double kLargest = std::numeric_limits<double>::max();
  for (size_t row = 0; row < count; ++row) {
    double* __restrict slope = slopes + row * width;
    const double factor = factors[row];
    for (size_t a = 0; a < width; ++a) {
      const double number = slope[a] == slope[a] ? slope[a] : 0.0;
      const double below = kLargest < number ? kLargest : number;
      slope[a] = (below < -kLargest ? -kLargest : below) * factor;
    }
  }
}

}  // namespace fleetmap
