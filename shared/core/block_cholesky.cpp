#include "block_cholesky.h"
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <cmath>

namespace fleetmap {
namespace {

using NodeList = std::vector<int32_t>;

// A row of numbers for each node.
struct Lists {
  std::vector<int64_t> starts;
  NodeList entries;
};

// For each position in the order of elimination the coupled ones before it, or after it.
Lists neighbours(const NodePairs& pairs, const NodeList& position, bool after) {
  Lists lists{std::vector<int64_t>(position.size() + 1), NodeList(pairs.size())};
  auto ends = [&](const std::array<int64_t, 2>& pair) {
    const auto [early, late] = std::minmax({position[size_t(pair[0])], position[size_t(pair[1])]});
    return after ? std::pair(early, late) : std::pair(late, early);
  };
  for (const auto& pair : pairs) ++lists.starts[size_t(ends(pair).first) + 1];
  for (size_t n = 0; n < position.size(); ++n) lists.starts[n + 1] += lists.starts[n];
  std::vector<int64_t> next(lists.starts.begin(), lists.starts.end() - 1);
  for (const auto& pair : pairs) lists.entries[size_t(next[size_t(ends(pair).first)]++)] = ends(pair).second;
  return lists;
}

NodeList positions_of(const std::vector<int64_t>& order) {
  NodeList position(order.size());
  for (size_t n = 0; n < order.size(); ++n) position[size_t(order[n])] = int32_t(n);
  return position;
}

// The parent of each node, -1 for roots. Source: Davis 2006, section 4.1.
NodeList elimination_tree(const Lists& before) {
  const int32_t count = int32_t(before.starts.size()) - 1;
  NodeList parent(size_t(count), -1), ancestor(size_t(count), -1);
  for (int32_t n = 0; n < count; ++n)
    for (int64_t entry = before.starts[n]; entry < before.starts[n + 1]; ++entry)
      for (int32_t m = before.entries[entry]; m != -1 && m < n;) {
        const int32_t above = ancestor[m];
        ancestor[m] = n;  // the path is shortened for the next walk
        if (above == -1) parent[m] = n;
        m = above;
      }
  return parent;
}

// Nodes so that every subtree is in one piece, its root last; children in the order that they had.
NodeList postorder(const NodeList& parent) {
  const int32_t count = int32_t(parent.size());
  NodeList head(size_t(count), -1), following(size_t(count), -1), order, stack;
  for (int32_t n = count - 1; n >= 0; --n)
    if (parent[n] >= 0) following[n] = std::exchange(head[parent[n]], n);
  for (int32_t root = 0; root < count; ++root) {
    if (parent[root] >= 0) continue;
    stack.push_back(root);
    while (!stack.empty()) {
      const int32_t n = stack.back(), child = head[n];
      if (child >= 0) {
        head[n] = following[child];
        stack.push_back(child);
      } else {
        order.push_back(n);
        stack.pop_back();
      }
    }
  }
  return order;
}

// The rows of each column of the factor below its diagonal, ascending: those of its own matrix, and of its children in the tree.
Lists column_structures(const Lists& after, const NodeList& parent) {
  const int32_t count = int32_t(parent.size());
  NodeList head(size_t(count), -1), following(size_t(count), -1), marked(size_t(count), -1);
  Lists columns{{0}, {}};
  for (int32_t n = 0; n < count; ++n) {
    auto take = [&](int32_t row) {
      if (row > n && marked[row] != n) {
        marked[row] = n;
        columns.entries.push_back(row);
      }
    };
    for (int64_t entry = after.starts[n]; entry < after.starts[n + 1]; ++entry) take(after.entries[entry]);
    for (int32_t child = head[n]; child >= 0; child = following[child])
      for (int64_t entry = columns.starts[child]; entry < columns.starts[child + 1]; ++entry) take(columns.entries[entry]);
    std::sort(columns.entries.begin() + columns.starts[n], columns.entries.end());
    columns.starts.push_back(int64_t(columns.entries.size()));
    if (parent[n] >= 0) following[n] = std::exchange(head[parent[n]], n);
  }
  return columns;
}

// Largest share of zeros in a front, by its number of columns: arithmetic on zeros is cheaper than many calls. Limits as CHOLMOD's
// (Chen, Davis, Hager and Rajamanickam 2008).
double allowed_zeros(double columns) { return columns <= 24 ? 0.8 : columns <= 96 ? 0.1 : 0.05; }

// The first node of each run of columns that are kept as one dense front, and N at the end. below: unknowns below each column of
// nodes; unknowns (N + 1,): where those of each node begin. Source: Ashcraft and Grimes 1989, The influence of relaxed supernode
// partitions on the multifrontal method.
NodeList supernodes(const NodeList& parent, const std::vector<int64_t>& below, const std::vector<int64_t>& unknowns) {
  NodeList firsts;
  std::vector<double> exact;  // numbers of each front that are not zero for certain
  for (int32_t n = 0; n < int32_t(parent.size()); ++n) {
    auto numbers = [&](double columns) { return columns * (columns + 1.0) / 2.0 + columns * double(below[n]); };
    firsts.push_back(n);
    exact.push_back(numbers(double(unknowns[n + 1] - unknowns[n])));
    while (firsts.size() > 1) {
      const int32_t last = firsts.back() - 1;
      if (parent[last] < firsts.back() || parent[last] > n) break;
      const double columns = double(unknowns[n + 1] - unknowns[firsts[firsts.size() - 2]]);
      const double whole = numbers(columns), filled = exact[exact.size() - 2] + exact.back();
      if ((whole - filled) / whole > allowed_zeros(columns)) break;
      firsts.pop_back();
      exact.pop_back();
      exact.back() = filled;
    }
  }
  firsts.push_back(int32_t(parent.size()));
  return firsts;
}

// Adds a child's update (m, m), of which the lower triangle counts, to its parent's front at rows (m,).
void add_child(const std::vector<double>& child, const NodeList& rows, double* diagonal, int own, double* lower, double* rest, int below) {
  const size_t m = rows.size();
  for (size_t c = 0; c < m; ++c) {
    const int32_t col = rows[c];
    const double* from = child.data() + c * m;
    size_t r = c;
    if (col < own) {
      double *to = diagonal + ptrdiff_t(col) * own, *under = lower + ptrdiff_t(col) * below - own;
      for (; r < m && rows[r] < own; ++r) to[rows[r]] += from[r];
      for (; r < m; ++r) under[rows[r]] += from[r];
    } else {
      double* to = rest + ptrdiff_t(col - own) * below - own;
      for (; r < m; ++r) to[rows[r]] += from[r];
    }
  }
}

constexpr int kOne = 1;
constexpr double kPlus = 1.0, kMinus = -1.0, kNone = 0.0;

}  // namespace

BlockCholesky::BlockCholesky(const std::vector<int64_t>& sizes, const NodePairs& pairs, std::vector<int64_t> order)
    : position_(positions_of(order)) {
  const size_t count = sizes.size();
  const std::vector<int64_t> given = order;
  const NodeList after_order = postorder(elimination_tree(neighbours(pairs, position_, false)));
  for (size_t n = 0; n < count; ++n) order[n] = given[size_t(after_order[n])];
  position_ = positions_of(order);
  const NodeList parent = elimination_tree(neighbours(pairs, position_, false));
  const Lists columns = column_structures(neighbours(pairs, position_, true), parent);

  std::vector<int64_t> begins(count + 1), unknowns(count + 1), below(count);  // of nodes, and by position
  for (size_t n = 0; n < count; ++n) begins[n + 1] = begins[n] + sizes[n], unknowns[n + 1] = unknowns[n] + sizes[size_t(order[n])];
  auto size_at = [&](int32_t position) { return int32_t(unknowns[size_t(position) + 1] - unknowns[size_t(position)]); };
  for (size_t n = 0; n < count; ++n) {
    for (int64_t unknown = begins[size_t(order[n])]; unknown < begins[size_t(order[n]) + 1]; ++unknown) order_.push_back(unknown);
    for (int64_t entry = columns.starts[n]; entry < columns.starts[n + 1]; ++entry) below[n] += size_at(columns.entries[size_t(entry)]);
  }

  const NodeList firsts = supernodes(parent, below, unknowns);
  front_.resize(count), offset_.resize(count);
  for (size_t s = 0; s + 1 < firsts.size(); ++s) {
    const size_t first = size_t(firsts[s]), end = size_t(firsts[s + 1]);
    for (size_t n = first; n < end; ++n) front_[n] = int32_t(s), offset_[n] = int32_t(unknowns[n] - unknowns[first]);
    Front front{int64_t(size_), int(unknowns[end] - unknowns[first]), int(below[end - 1]), int(unknowns[first]), {}, {}, {}, {}, {}};
    front.nodes.assign(columns.entries.begin() + columns.starts[end - 1], columns.entries.begin() + columns.starts[end]);
    for (const int32_t node : front.nodes) {
      front.offsets.push_back(int32_t(front.rows.size()));
      for (int32_t a = 0; a < size_at(node); ++a) front.rows.push_back(int32_t(unknowns[size_t(node)]) + a);
    }
    size_ += size_t(front.own) * size_t(front.own + front.below);
    fronts_.push_back(std::move(front));
  }
  for (size_t s = 0; s < fronts_.size(); ++s) {  // a front's parent is that of the first node below
    Front& front = fronts_[s];
    if (front.nodes.empty()) continue;
    const int32_t above = front_[size_t(front.nodes[0])];
    Front& parent_front = fronts_[size_t(above)];
    parent_front.children.push_back(int32_t(s));
    for (const int32_t node : front.nodes) {
      int32_t at = offset_[size_t(node)];
      if (front_[size_t(node)] != above) {
        const auto found = std::lower_bound(parent_front.nodes.begin(), parent_front.nodes.end(), node);
        at = parent_front.own + parent_front.offsets[size_t(found - parent_front.nodes.begin())];
      }
      for (int32_t a = 0; a < size_at(node); ++a) front.at.push_back(at + a);
    }
  }
}

BlockPlace BlockCholesky::place(int64_t row, int64_t col) const {
  const int32_t from = position_[size_t(row)], to = position_[size_t(col)], late = std::max(from, to), early = std::min(from, to);
  const Front& front = fronts_[size_t(front_[size_t(early)])];
  int64_t step = front.own, here = offset_[size_t(late)];
  if (front_[size_t(late)] != front_[size_t(early)]) {
    const auto found = std::lower_bound(front.nodes.begin(), front.nodes.end(), late);
    step = front.below;
    here = int64_t(front.own) * front.own + front.offsets[size_t(found - front.nodes.begin())];
  }
  const int64_t first = front.start + here + offset_[size_t(early)] * step;
  return from < to ? BlockPlace{first, step, 1} : BlockPlace{first, 1, step};
}

bool BlockCholesky::factorise(double* values) const {
  std::vector<std::vector<double>> updates(fronts_.size());
  for (size_t number = 0; number < fronts_.size(); ++number) {
    const Front& front = fronts_[number];
    const int own = front.own, below = front.below;
    double *diagonal = values + front.start, *lower = diagonal + ptrdiff_t(own) * own;
    std::vector<double> rest(size_t(below) * size_t(below));
    for (const int32_t child : front.children) {
      add_child(updates[size_t(child)], fronts_[size_t(child)].at, diagonal, own, lower, rest.data(), below);
      updates[size_t(child)] = {};
    }
    if (!dense_cholesky("L", own, diagonal)) return false;
    double trace = 0.0;
    for (int a = 0; a < own; ++a) trace += diagonal[ptrdiff_t(a) * (own + 1)];
    if (!std::isfinite(trace)) return false;
    if (below == 0) continue;
    lapack.dtrsm("R", "L", "T", "N", &below, &own, &kPlus, diagonal, &own, lower, &below);
    lapack.dsyrk("L", "N", &below, &own, &kMinus, lower, &below, &kPlus, rest.data(), &below);
    updates[number] = std::move(rest);
  }
  return true;
}

double BlockCholesky::log_determinant(const double* values) const {
  double sum = 0.0;
  for (const Front& front : fronts_)
    for (int a = 0; a < front.own; ++a) sum += 2.0 * std::log(values[front.start + ptrdiff_t(a) * (front.own + 1)]);
  return sum;
}

void BlockCholesky::solve(const double* values, double* b) const {
  std::vector<double> x(order_.size()), gathered, pulled;
  for (size_t n = 0; n < x.size(); ++n) x[n] = b[order_[n]];
  for (const Front& front : fronts_) {
    const double *diagonal = values + front.start, *lower = diagonal + ptrdiff_t(front.own) * front.own;
    double* here = x.data() + front.column;
    lapack.dtrsv("L", "N", "N", &front.own, diagonal, &front.own, here, &kOne);
    if (front.below == 0) continue;
    gathered.assign(size_t(front.below), 0.0);
    lapack.dgemv("N", &front.below, &front.own, &kPlus, lower, &front.below, here, &kOne, &kNone, gathered.data(), &kOne);
    for (size_t r = 0; r < gathered.size(); ++r) x[size_t(front.rows[r])] -= gathered[r];
  }
  for (size_t number = fronts_.size(); number-- > 0;) {
    const Front& front = fronts_[number];
    const double *diagonal = values + front.start, *lower = diagonal + ptrdiff_t(front.own) * front.own;
    double* here = x.data() + front.column;
    if (front.below > 0) {
      gathered.resize(size_t(front.below));
      for (size_t r = 0; r < gathered.size(); ++r) gathered[r] = x[size_t(front.rows[r])];
      pulled.resize(size_t(front.own));
      lapack.dgemv("T", &front.below, &front.own, &kPlus, lower, &front.below, gathered.data(), &kOne, &kNone, pulled.data(), &kOne);
      for (int c = 0; c < front.own; ++c) here[c] -= pulled[size_t(c)];
    }
    lapack.dtrsv("L", "T", "N", &front.own, diagonal, &front.own, here, &kOne);
  }
  for (size_t n = 0; n < x.size(); ++n) b[order_[n]] = x[n];
}

Lapack lapack;

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

}  // namespace fleetmap
