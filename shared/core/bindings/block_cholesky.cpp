#include "arrays.h"  // first: Python's header comes before the system's

#include "solvers.h"

#include "block_cholesky.h"
#include "lapack.h"

using namespace fleetmap;

namespace fleetmap {
Lapack lapack;
}

// scipy hands out its LAPACK as capsules, for Cython, of Fortran's interface with 32-bit integers.
void find_lapack() {
  if (lapack.dpotrf) return;
  auto found = [](const char* library, const char* name, auto& function) {
    const nb::object capsule = nb::module_::import_(library).attr("__pyx_capi__")[name];
    void* address = PyCapsule_GetPointer(capsule.ptr(), PyCapsule_GetName(capsule.ptr()));
    if (!address) throw nb::python_error();
    function = reinterpret_cast<std::remove_reference_t<decltype(function)>>(address);
  };
  found("scipy.linalg.cython_blas", "dtrsm", lapack.dtrsm);
  found("scipy.linalg.cython_blas", "dsyrk", lapack.dsyrk);
  found("scipy.linalg.cython_blas", "dtrsv", lapack.dtrsv);
  found("scipy.linalg.cython_blas", "dgemv", lapack.dgemv);
  found("scipy.linalg.cython_lapack", "dpotrs", lapack.dpotrs);
  found("scipy.linalg.cython_lapack", "dpotrf", lapack.dpotrf);
}

void check_order(const Array<int64_t, -1>& order, size_t count) {
  std::vector<bool> seen(count, false);
  for (size_t n = 0; n < order.shape(0); ++n) {
    if (order(n) < 0 || size_t(order(n)) >= count || seen[size_t(order(n))]) throw nb::value_error("order: each node once");
    seen[size_t(order(n))] = true;
  }
  if (order.shape(0) != count) throw nb::value_error("order: each node once");
}

namespace {

using Indices = Array<int64_t, -1>;

void make(BlockCholesky* self, const Indices& sizes, const Array<int64_t, -1, 2>& pairs, const Indices& order) {
  constexpr int64_t kMostEach = 1 << 12, kMost = 1 << 24;
  const int64_t count = int64_t(sizes.shape(0));
  find_lapack();
  const nb::gil_scoped_release others_run;
  int64_t total = 0;
  for (int64_t n = 0; n < count; ++n) {
    if (sizes(n) < 1 || sizes(n) > kMostEach || (total += sizes(n)) > kMost) throw nb::value_error("sizes: 1 to 4096, at most 2^24 in all");
  }
  std::vector<std::pair<int64_t, int64_t>> coupled;
  for (size_t n = 0; n < pairs.shape(0); ++n) {
    const int64_t a = pairs(n, 0), b = pairs(n, 1);
    if (a < 0 || b < 0 || a >= count || b >= count) throw nb::value_error("pairs: of nodes");
    coupled.emplace_back(a, b);
  }
  check_order(order, size_t(count));
  new (self) BlockCholesky({sizes.data(), sizes.data() + count}, coupled, {order.data(), order.data() + count});
}

auto places_of(const BlockCholesky& pattern, const Indices& rows, const Indices& cols) {
  const size_t count = rows.shape(0);
  const int64_t nodes = int64_t(pattern.nodes());
  if (cols.shape(0) != count) throw nb::value_error("cols: one for each row");
  std::vector<BlockPlace> places;
  unlocked([&] {
    for (size_t n = 0; n < count; ++n) {
      if (rows(n) < 0 || cols(n) < 0 || rows(n) >= nodes || cols(n) >= nodes) throw nb::value_error("rows, cols: nodes");
      places.push_back(pattern.place(rows(n), cols(n)));
      if (places.back().first < 0) throw nb::value_error("rows, cols: nodes that are coupled");
    }
  });
  return as_numpy<int64_t, 2>(std::move(places), {count, 3});
}

bool factorise(const BlockCholesky& pattern, const MutableArray<double, -1>& values) {
  if (values.size() != pattern.size()) throw nb::value_error("values: as many as size says");
  return unlocked([&] { return pattern.factorise(values.data()); });
}

auto solve(const BlockCholesky& pattern, const Array<double, -1>& values, const Array<double, -1>& rhs) {
  if (values.size() != pattern.size()) throw nb::value_error("values: as many as size says");
  if (rhs.size() != pattern.unknowns()) throw nb::value_error("rhs: one for each unknown");
  std::vector<double> x;
  unlocked([&] {
    x.assign(rhs.data(), rhs.data() + rhs.size());
    pattern.solve(values.data(), x.data());
  });
  return as_numpy<double>(std::move(x));
}

}  // namespace

void bind_block_cholesky(nb::module_& module) {
  const auto values = "values"_a.noconvert();
  nb::class_<BlockCholesky>(module, "BlockCholesky")
      .def("__init__", &make, "sizes"_a.noconvert(), "pairs"_a.noconvert(), "order"_a.noconvert())
      .def_prop_ro("size", &BlockCholesky::size)
      .def("order",
           [](const BlockCholesky& pattern) {
             return as_numpy<int64_t, 1>(unlocked([&] { return std::vector<int64_t>(pattern.order()); }), {pattern.unknowns()});
           })
      .def("places", &places_of, "rows"_a.noconvert(), "cols"_a.noconvert())
      .def("factorise", &factorise, values)
      .def("solve", &solve, values, "rhs"_a.noconvert());
}
