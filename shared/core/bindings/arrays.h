// numpy arrays in and out of the core. Arguments are unconverted views; results own their data.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <initializer_list>
#include <utility>
#include <vector>

#include "allocations.h"
#include "camera.h"

namespace nb = nanobind;
using namespace nb::literals;

template <typename T, int64_t... kShape>
using Array = nb::ndarray<const T, nb::shape<kShape...>, nb::c_contig, nb::device::cpu>;
template <typename T, int64_t... kShape>
using MutableArray = nb::ndarray<T, nb::shape<kShape...>, nb::c_contig, nb::device::cpu>;

// A numpy array that owns the vector's numbers. Element: what the vector's hold, such as float for pixels.
template <typename Element, int kDimensions, typename T>
nb::ndarray<nb::numpy, Element, nb::ndim<kDimensions>> as_numpy(std::vector<T>&& values, std::initializer_list<size_t> shape) {
  auto* kept = new std::vector<T>(std::move(values));
  nb::capsule owner(kept, [](void* held) noexcept { delete static_cast<std::vector<T>*>(held); });
  return {reinterpret_cast<Element*>(kept->data()), shape, owner};
}

template <typename Element, typename T>
nb::ndarray<nb::numpy, Element, nb::ndim<1>> as_numpy(std::vector<T>&& values) {
  const size_t count = values.size();
  return as_numpy<Element, 1>(std::move(values), {count});
}

// A numpy array with a copy of a few numbers.
template <int kDimensions>
nb::ndarray<nb::numpy, double, nb::ndim<kDimensions>> copied(const double* from, std::initializer_list<size_t> shape) {
  size_t count = 1;
  for (size_t length : shape) count *= length;
  return as_numpy<double, kDimensions>(std::vector<double>(from, from + count), shape);
}

// The result of a computation that needs no Python, done without its lock. Checks of whole arrays belong in it, too.
template <typename Compute>
auto unlocked(Compute&& compute) {
  nb::gil_scoped_release release;
  const fleetmap::CountedStep counted;
  return compute();
}

// So many zeros: those of pictures and maps are handed out page by page.
template <typename T>
std::vector<T> zeros(size_t count) {
  return unlocked([&] { return std::vector<T>(count); });
}

using Lens = Array<double, 4>;
inline fleetmap::StereoLens lens_of(const Lens& lens) { return {lens(0), lens(1), lens(2), lens(3)}; }
