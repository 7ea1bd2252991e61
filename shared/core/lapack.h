// Dense factorisation by LAPACK and BLAS, of the library that scipy carries. Matrices are column by column, as in Fortran.
#pragma once

#include <algorithm>

namespace fleetmap {

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
