// Vectors and rotations in space. Sums go from left to right, so that every compiler and every processor gives the same bits.
#pragma once

#include <algorithm>
#include <cmath>

#include "dense.h"

namespace fleetmap {

struct Vec3 {
  double at[3];
  double& operator[](int i) { return at[i]; }
  double operator[](int i) const { return at[i]; }
};

inline Vec3 operator+(Vec3 a, Vec3 b) { return {a[0] + b[0], a[1] + b[1], a[2] + b[2]}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
inline Vec3 operator-(Vec3 a) { return {-a[0], -a[1], -a[2]}; }
inline Vec3 operator*(double s, Vec3 a) { return {s * a[0], s * a[1], s * a[2]}; }
inline Vec3 operator/(Vec3 a, double s) { return {a[0] / s, a[1] / s, a[2] / s}; }
inline double dot(Vec3 a, Vec3 b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline double norm(Vec3 a) { return std::sqrt(dot(a, a)); }
inline Vec3 cross(Vec3 a, Vec3 b) { return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]}; }
template <typename Real>
inline Vec3 vec3(const Real* from) {
  return {from[0], from[1], from[2]};
}
inline void store(Vec3 a, double* to) { to[0] = a[0], to[1] = a[1], to[2] = a[2]; }

// Row by row: m[row][column].
struct Mat3 {
  double at[3][3];
  double* operator[](int row) { return at[row]; }
  const double* operator[](int row) const { return at[row]; }
};

constexpr Mat3 kIdentity = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};

// The matrix whose number (i, j) is of(i, j).
template <typename Number>
inline Mat3 filled(const Number& of) {
  Mat3 out;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) out[i][j] = of(i, j);
  return out;
}

inline Mat3 operator*(const Mat3& a, const Mat3& b) {
  return filled([&](int i, int j) { return a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j]; });
}
inline Vec3 operator*(const Mat3& a, Vec3 v) { return {dot(vec3(a[0]), v), dot(vec3(a[1]), v), dot(vec3(a[2]), v)}; }
inline Mat3 operator+(const Mat3& a, const Mat3& b) {
  return filled([&](int i, int j) { return a[i][j] + b[i][j]; });
}
inline Mat3 operator-(const Mat3& a, const Mat3& b) {
  return filled([&](int i, int j) { return a[i][j] - b[i][j]; });
}
inline Mat3 operator*(double s, const Mat3& a) {
  return filled([&](int i, int j) { return s * a[i][j]; });
}
inline Mat3 operator/(const Mat3& a, double s) {
  return filled([&](int i, int j) { return a[i][j] / s; });
}
inline Mat3 transposed(const Mat3& a) {
  return filled([&](int i, int j) { return a[j][i]; });
}
inline double trace(const Mat3& a) { return a[0][0] + a[1][1] + a[2][2]; }

// The inverse of a symmetric matrix, by its cofactors.
inline Mat3 inverse_symmetric(const Mat3& m) {
  const double a = m[0][0], b = m[0][1], c = m[0][2], d = m[1][1], e = m[1][2], f = m[2][2];
  const double minor_a = d * f - e * e, minor_b = c * e - b * f, minor_c = b * e - c * d;
  const double scale = 1.0 / (a * minor_a + b * minor_b + c * minor_c);
  const double xy = minor_b * scale, xz = minor_c * scale, yz = (b * c - a * e) * scale;
  return {{{minor_a * scale, xy, xz}, {xy, (a * f - c * c) * scale, yz}, {xz, yz, (a * d - b * b) * scale}}};
}

// The upper left corner of a matrix in memory whose rows are `stride` numbers apart.
inline Mat3 mat3(const double* from, int stride) {
  return filled([&](int i, int j) { return from[stride * i + j]; });
}
inline Mat3 mat3(const double* from) { return mat3(from, 3); }
inline void store(const Mat3& a, double* to, int stride = 3) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) to[stride * i + j] = a[i][j];
}

// The matrix of the cross product with v.
inline Mat3 skew(Vec3 v) { return {{{0, -v[2], v[1]}, {v[2], 0, -v[0]}, {-v[1], v[0], 0}}}; }

// I + linear skew(v) + square skew(v)^2.
inline Mat3 skew_series(Vec3 v, double linear, double square) {
  const double x = v[0], y = v[1], z = v[2];
  return {{{1.0 - square * (y * y + z * z), square * x * y - linear * z, square * x * z + linear * y},
           {square * x * y + linear * z, 1.0 - square * (x * x + z * z), square * y * z - linear * x},
           {square * x * z - linear * y, square * y * z + linear * x, 1.0 - square * (x * x + y * y)}}};
}

// The rotation of a rotation vector. Source: Rodrigues' formula.
inline Mat3 so3_exp(Vec3 r) {
  const double squared = dot(r, r), angle = std::sqrt(squared);
  if (angle < 1e-4)  // below it the series' next term is under 1e-17
    return skew_series(r, 1.0 - squared / 6.0, 0.5 - squared / 24.0);
  return skew_series(r, std::sin(angle) / angle, (1.0 - std::cos(angle)) / squared);
}

// J with Exp(r + dr) ~ Exp(r) Exp(J dr). Source: Forster et al. 2017, eq. 8.
inline Mat3 right_jacobian(Vec3 r) {
  const double squared = dot(r, r), angle = std::sqrt(squared);
  if (angle < 1e-2)
    return skew_series(r, -0.5 + squared / 24.0 - squared * squared / 720.0, 1.0 / 6.0 - squared / 120.0 + squared * squared / 5040.0);
  return skew_series(r, -(1.0 - std::cos(angle)) / squared, (angle - std::sin(angle)) / (squared * angle));
}

// J with Log(Exp(dr) Exp(r)) ~ r + J dr; transposed, the inverse right one. Source: Forster et al. 2017, eq. 9.
inline Mat3 inverse_left_jacobian(Vec3 r) {
  const double squared = dot(r, r), angle = std::sqrt(squared);
  const double square = angle < 1e-2 ? 1.0 / 12.0 + squared / 720.0 + squared * squared / 30240.0
                                     : 1.0 / squared - (1.0 + std::cos(angle)) / (2.0 * angle * std::sin(angle));
  return skew_series(r, -0.5, square);
}

// The rotation vector, of an angle from 0 to pi, by way of the quaternion, which is stable near pi. Source: Shepperd 1978.
inline Vec3 so3_log(const Mat3& m) {
  const double t = trace(m);
  double w, x, y, z;
  if (t > m[0][0] && t > m[1][1] && t > m[2][2]) {
    w = 1.0 + t, x = m[2][1] - m[1][2], y = m[0][2] - m[2][0], z = m[1][0] - m[0][1];
  } else if (m[0][0] > m[1][1] && m[0][0] > m[2][2]) {
    w = m[2][1] - m[1][2], x = 1.0 + m[0][0] - m[1][1] - m[2][2], y = m[0][1] + m[1][0], z = m[0][2] + m[2][0];
  } else if (m[1][1] > m[2][2]) {
    w = m[0][2] - m[2][0], y = 1.0 - m[0][0] + m[1][1] - m[2][2], x = m[0][1] + m[1][0], z = m[1][2] + m[2][1];
  } else {
    w = m[1][0] - m[0][1], z = 1.0 - m[0][0] - m[1][1] + m[2][2], x = m[0][2] + m[2][0], y = m[1][2] + m[2][1];
  }
  if (w < 0.0) w = -w, x = -x, y = -y, z = -z;
  const double sine = std::sqrt(x * x + y * y + z * z);
  const double scale = sine < 1e-9 * w ? 2.0 / w : 2.0 * std::atan2(sine, w) / sine;
  return {scale * x, scale * y, scale * z};
}

// A rigid transform of points: rotation, then translation.
struct SE3 {
  Mat3 rotation;
  Vec3 translation;
};

inline SE3 operator*(const SE3& a, const SE3& b) { return {a.rotation * b.rotation, a.rotation * b.translation + a.translation}; }
inline Vec3 operator*(const SE3& a, Vec3 point) { return a.rotation * point + a.translation; }
inline SE3 inverse(const SE3& a) {
  const Mat3 turned = transposed(a.rotation);
  return {turned, -(turned * a.translation)};
}
// From and to matrices (4, 4) in memory.
inline SE3 se3(const double* matrix) { return {mat3(matrix, 4), {matrix[3], matrix[7], matrix[11]}}; }
inline void store(const SE3& a, double* matrix) {
  store(a.rotation, matrix, 4);
  for (int i = 0; i < 3; ++i) matrix[4 * i + 3] = a.translation[i], matrix[12 + i] = 0.0;
  matrix[15] = 1.0;
}

// Covariance or information (6, 6) of a pose: rotation, then translation.
struct Mat6 {
  double at[36];
  double* operator[](int row) { return at + 6 * row; }
  const double* operator[](int row) const { return at + 6 * row; }
};
inline Mat6 operator+(Mat6 a, const Mat6& b) {
  for (int k = 0; k < 36; ++k) a.at[k] += b.at[k];
  return a;
}
inline void store(const Mat6& a, double* to) { std::copy_n(a.at, 36, to); }
inline Mat6 mat6(const double* from) {
  Mat6 out;
  std::copy_n(from, 36, out.at);
  return out;
}
// The covariance of what a matrix makes of a perturbation: `turn` twice on its diagonal, `below` in its lower left corner.
inline Mat6 carried(const Mat6& covariance, const Mat3& turn, const Mat3& below) {
  double matrix[36]{};
  store(turn, matrix, 6), store(turn, matrix + 21, 6), store(below, matrix + 18, 6);
  Mat6 out;
  carry<6, 6>(matrix, covariance.at, out.at);
  return out;
}

}  // namespace fleetmap
