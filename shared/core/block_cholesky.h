// Cholesky factorisation of large sparse symmetric matrices whose unknowns come in blocks, such as poses.
//
// Multifrontal and supernodal: fill-in and order are computed once for each pattern, over blocks; the arithmetic is dense
// LAPACK on runs of columns with the same rows. Sources: Davis 2006, Direct methods for sparse linear systems, chapters 4 and 7;
// Liu 1992, The multifrontal method for sparse matrix solution.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace fleetmap {

// Position of a block among the values of a factor: its number (a, b) at first + a * down + b * right.
struct BlockPlace {
  int64_t first, down, right;
};

using NodePairs = std::vector<std::array<int64_t, 2>>;

class BlockCholesky {
 public:
  // The pattern of nodes with sizes[n] unknowns each, numbered consecutively, coupled in pairs. order: elimination order of the nodes with
  // little fill-in; every subtree of their elimination tree is then made contiguous.
  BlockCholesky(const std::vector<int64_t>& sizes, const NodePairs& pairs, std::vector<int64_t> order);

  // Number of values of a factor.
  size_t size() const { return size_; }

  // The place of the block of coupled nodes (row, col). A block is added once; its mirror image must not be. Of blocks on the diagonal the
  // lower triangle counts.
  BlockPlace place(int64_t row, int64_t col) const;

  // Values become those of the factor; false where the matrix is not positive definite.
  bool factorise(double* values) const;

  // log det A by the values of the factor.
  double log_determinant(const double* values) const;

  // b (U,) becomes the x of A x = b, by the values of the factor.
  void solve(const double* values, double* b) const;

 private:
  // One run of columns, `own` unknowns wide from `column` on in the order of elimination, over `below` unknowns of later nodes. Its
  // triangle (own, own) begins at `start` among the values, then follow the (below, own) rows under it, both column by column.
  struct Front {
    int64_t start;
    int own, below, column;
    std::vector<int32_t> rows;            // (below,) its unknowns there, in the order of elimination
    std::vector<int32_t> at;              // (below,) those rows in the front of its parent
    std::vector<int32_t> nodes, offsets;  // positions of the nodes below, rising, and where their unknowns begin among the rows
    std::vector<int32_t> children;        // the fronts that update it
  };

  std::vector<Front> fronts_;            // children first
  std::vector<int64_t> order_;           // the matrix's unknowns in the order of elimination
  std::vector<int32_t> position_;        // (N,) of the nodes in the order of elimination
  std::vector<int32_t> front_, offset_;  // by position: front of a node, and where its unknowns begin there
  size_t size_ = 0;
};

// Dense factorisation by LAPACK and BLAS, of the library that scipy carries. Matrices are column by column, as in Fortran.
struct Lapack {
  void (*dpotrf)(const char* uplo, const int* n, double* a, const int* lda, int* info);
  void (*dpotrs)(const char* uplo, const int* n, const int* nrhs, const double* a, const int* lda, double* b, const int* ldb, int* info);
  void (*dtrsm)(const char* side, const char* uplo, const char* trans, const char* diag, const int* m, const int* n, const double* alpha,
                const double* a, const int* lda, double* b, const int* ldb);
  void (*dsyrk)(const char* uplo, const char* trans, const int* n, const int* k, const double* alpha, const double* a, const int* lda,
                const double* beta, double* c, const int* ldc);
  void (*dtrsv)(const char* uplo, const char* trans, const char* diag, const int* n, const double* a, const int* lda, double* x,
                const int* incx);
  void (*dgemv)(const char* trans, const int* m, const int* n, const double* alpha, const double* a, const int* lda, const double* x,
                const int* incx, const double* beta, double* y, const int* incy);
};
extern Lapack lapack;

// Fetches LAPACK from scipy, the first time that it is called.
void find_lapack();

// a (n, n) becomes its factor, in the half that uplo, "L" or "U", names; false where it is not positive definite.
inline bool dense_cholesky(const char* uplo, int n, double* a) {
  const int lda = std::max(n, 1);
  int failed = 0;
  lapack.dpotrf(uplo, &n, a, &lda, &failed);
  return failed == 0;
}

}  // namespace fleetmap
