// Small dense linear algebra on matrices row by row. Sums go in the order of their terms: the same bits everywhere.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace fleetmap {

// A matrix that owns its numbers, zero at first. Those that every frame needs are kept and resized, so that nothing is allocated.
struct Matrix {
  std::vector<double> values;
  size_t rows = 0, columns = 0;

  Matrix() = default;
  Matrix(size_t rows, size_t columns) : values(rows * columns), rows(rows), columns(columns) {}
  void resize(size_t new_rows, size_t new_columns) {
    rows = new_rows, columns = new_columns;
    values.assign(rows * columns, 0.0);
  }
  double* operator[](size_t row) { return values.data() + row * columns; }
  const double* operator[](size_t row) const { return values.data() + row * columns; }
};

// out (n, m) = a (n, k) b (k, m), all without gaps; out is neither of them.
inline void multiply(const double* a, const double* b, double* __restrict out, size_t n, size_t k, size_t m) {
  for (size_t i = 0; i < n; ++i) {
    double* __restrict row = out + i * m;
    for (size_t j = 0; j < m; ++j) row[j] = 0.0;
    size_t at = 0;
    for (; at + 4 <= k; at += 4) {  // so that a row is read and written once for four additions
      const double x0 = a[i * k + at], x1 = a[i * k + at + 1], x2 = a[i * k + at + 2], x3 = a[i * k + at + 3];
      if (x0 == 0.0 && x1 == 0.0 && x2 == 0.0 && x3 == 0.0) continue;
      const double *b0 = b + at * m, *b1 = b0 + m, *b2 = b1 + m, *b3 = b2 + m;
      for (size_t j = 0; j < m; ++j) row[j] = row[j] + x0 * b0[j] + x1 * b1[j] + x2 * b2[j] + x3 * b3[j];
    }
    for (; at < k; ++at) {
      const double x = a[i * k + at];
      if (x == 0.0) continue;
      for (size_t j = 0; j < m; ++j) row[j] += x * b[at * m + j];
    }
  }
}

inline void multiply(const Matrix& a, const Matrix& b, Matrix& out) {
  out.resize(a.rows, b.columns);
  multiply(a.values.data(), b.values.data(), out.values.data(), a.rows, a.columns, b.columns);
}

// out (n, n) = a p a^T, for a (n, k) and p (k, k).
template <size_t n, size_t k>
void carry(const double* a, const double* p, double* out) {
  double turned[k * n], part[n * k];
  for (size_t i = 0; i < k; ++i)
    for (size_t j = 0; j < n; ++j) turned[i * n + j] = a[j * k + i];
  multiply(a, p, part, n, k, k);
  multiply(part, turned, out, n, k, n);
}

inline void transpose(const Matrix& a, Matrix& out) {
  out.resize(a.columns, a.rows);
  for (size_t i = 0; i < a.rows; ++i)
    for (size_t j = 0; j < a.columns; ++j) out[j][i] = a[i][j];
}

inline bool is_finite(const double* values, size_t count) {
  return std::all_of(values, values + count, [](double value) { return std::isfinite(value); });
}

// a <- (a + a^T) / 2.
inline void symmetrise(Matrix& a) {
  for (size_t i = 0; i < a.rows; ++i)
    for (size_t j = 0; j < i; ++j) a[i][j] = a[j][i] = 0.5 * (a[i][j] + a[j][i]);
}

// Solves a x = b in place by Gaussian elimination with the largest pivot of each column; a (n, n) is destroyed, b (n, m) becomes x.
// Singular matrices give numbers that are not finite.
inline void solve_in_place(Matrix& a, Matrix& b) {
  const size_t n = a.rows, m = b.columns;
  for (size_t k = 0; k < n; ++k) {
    size_t pivot = k;
    for (size_t i = k + 1; i < n; ++i)
      if (std::abs(a[i][k]) > std::abs(a[pivot][k])) pivot = i;
    if (pivot != k) {
      std::swap_ranges(a[k], a[k] + n, a[pivot]);
      std::swap_ranges(b[k], b[k] + m, b[pivot]);
    }
    for (size_t i = k + 1; i < n; ++i) {
      if (a[i][k] == 0.0) continue;
      const double factor = a[i][k] / a[k][k];
      double* const __restrict row = a[i], * const __restrict right = b[i];
      const double* const __restrict top = a[k], * const __restrict top_right = b[k];
      for (size_t j = k + 1; j < n; ++j) row[j] -= factor * top[j];
      for (size_t j = 0; j < m; ++j) right[j] -= factor * top_right[j];
    }
  }
  for (size_t k = n; k-- > 0;) {
    double* const __restrict row = b[k];
    for (size_t i = k + 1; i < n; ++i) {
      const double factor = a[k][i];
      const double* const __restrict below = b[i];
      for (size_t j = 0; j < m; ++j) row[j] -= factor * below[j];
    }
    for (size_t j = 0; j < m; ++j) row[j] /= a[k][k];
  }
}

// Fills the lower triangle of symmetric a (n, n), rows `stride` apart, with its Cholesky factor; false where it is not positive definite.
inline bool cholesky_in_place(double* a, size_t n, size_t stride) {
  for (size_t j = 0; j < n; ++j) {
    double* const row = a + j * stride;
    double diagonal = row[j];
    for (size_t k = 0; k < j; ++k) diagonal -= row[k] * row[k];
    if (!(diagonal > 0.0)) return false;
    diagonal = std::sqrt(diagonal);
    row[j] = diagonal;
    for (size_t i = j + 1; i < n; ++i) {
      double total = a[i * stride + j];
      for (size_t k = 0; k < j; ++k) total -= a[i * stride + k] * row[k];
      a[i * stride + j] = total / diagonal;
    }
  }
  return true;
}

// Solves lower x = b in place, b (n,).
inline void forward_substitute(const double* lower, double* b, size_t n, size_t stride) {
  for (size_t i = 0; i < n; ++i) {
    double total = b[i];
    for (size_t k = 0; k < i; ++k) total -= lower[i * stride + k] * b[k];
    b[i] = total / lower[i * stride + i];
  }
}

// Solves lower^T x = b in place, b (n,).
inline void back_substitute(const double* lower, double* b, size_t n, size_t stride) {
  for (size_t i = n; i-- > 0;) {
    double total = b[i];
    for (size_t k = i + 1; k < n; ++k) total -= lower[k * stride + i] * b[k];
    b[i] = total / lower[i * stride + i];
  }
}

// Solves a x = b in place for symmetric positive definite a (n, n), which it destroys; false where a is not definite.
inline bool solve_spd(double* a, double* b, size_t n, size_t stride) {
  if (!cholesky_in_place(a, n, stride)) return false;
  forward_substitute(a, b, n, stride);
  back_substitute(a, b, n, stride);
  return true;
}

}  // namespace fleetmap
