// numpy arrays in and out of the core. Arguments are unconverted views, small ones of fixed size are copied; results own their data.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <initializer_list>
#include <type_traits>
#include <utility>
#include <vector>

#include "allocations.h"
#include "camera.h"
#include "matching.h"

namespace nb = nanobind;
using namespace nb::literals;

// An array among the arguments, as the core's functions take it.
template <typename T, int64_t... kShape>
struct View : nb::ndarray<T, nb::shape<kShape...>, nb::c_contig, nb::device::cpu> {
  operator fleetmap::Picture<T>() const
    requires(sizeof...(kShape) == 2)
  {
    return {this->data(), ptrdiff_t(this->shape(0)), ptrdiff_t(this->shape(1))};
  }
  operator fleetmap::Descriptors() const
    requires std::is_same_v<T, const uint64_t>
  {
    return {this->data(), this->shape(0)};
  }
  const fleetmap::Vec3* rows() const
    requires std::is_same_v<T, const double>
  {
    return reinterpret_cast<const fleetmap::Vec3*>(this->data());
  }
  T* begin() const { return this->data(); }
  T* end() const { return this->data() + this->size(); }
};
template <typename T, int64_t... kShape>
using Array = View<const T, kShape...>;
template <typename T, int64_t... kShape>
using MutableArray = View<T, kShape...>;

using Packed = Array<uint64_t, -1, 4>;  // descriptors
using Image = Array<uint8_t, -1, -1>;
using Reals = Array<double, -1>;
using Places = Array<double, -1, 2>;  // pixels
using Points = Array<double, -1, 3>;
using Indices = Array<int64_t, -1>;
using Numbers = Array<int32_t, -1>;
using Flags = MutableArray<bool, -1>;

// What values consist of.
template <typename T>
struct NumberOf {
  using Type = T;
};
template <typename T, size_t kCount>
struct NumberOf<std::array<T, kCount>> : NumberOf<T> {};
template <>
struct NumberOf<fleetmap::Vec3> : NumberOf<double> {};

// A numpy array that owns the vector's numbers. Element: what the vector's hold.
template <typename Element, int kDimensions, typename T>
nb::ndarray<nb::numpy, Element, nb::ndim<kDimensions>> as_numpy(std::vector<T>&& values, std::initializer_list<size_t> shape) {
  auto* kept = new std::vector<T>(std::move(values));
  nb::capsule owner(kept, [](void* held) noexcept { delete static_cast<std::vector<T>*>(held); });
  return {reinterpret_cast<Element*>(kept->data()), shape, owner};
}

// The same, with a row for each of the vector's values that is several of its elements.
template <typename Element, typename T>
auto as_numpy(std::vector<T>&& values) {
  const size_t count = values.size();
  if constexpr (sizeof(T) == sizeof(Element))
    return as_numpy<Element, 1>(std::move(values), {count});
  else
    return as_numpy<Element, 2>(std::move(values), {count, sizeof(T) / sizeof(Element)});
}

// A numpy array with a copy of a few numbers.
template <int kDimensions>
nb::ndarray<nb::numpy, double, nb::ndim<kDimensions>> copied(const double* from, std::initializer_list<size_t> shape) {
  size_t count = 1;
  for (size_t length : shape) count *= length;
  return as_numpy<double, kDimensions>(std::vector<double>(from, from + count), shape);
}

namespace nanobind::detail {

template <typename T, int64_t... kShape>
struct type_caster<View<T, kShape...>> {
  using Base = make_caster<ndarray<T, shape<kShape...>, c_contig, device::cpu>>;
  using Held = View<T, kShape...>;
  NB_TYPE_CASTER(Held, Base::Name)
  bool from_python(handle source, uint32_t flags, cleanup_list* cleanup) noexcept {
    Base base;
    const uint32_t refused = cast_flags::convert | cast_flags::accepts_none;  // None is for std::optional, not for an array in it
    if (!base.from_python(source, flags & ~refused, cleanup)) return false;
    static_cast<typename Base::Value&>(value) = std::move(base.value);
    return true;
  }
};

// A value of a few numbers, which kLoad reads from memory.
template <typename Value_, Value_ (*kLoad)(const double*), int64_t... kShape>
struct copied_caster {
  using Numbers = make_caster<View<const double, kShape...>>;
  NB_TYPE_CASTER(Value_, Numbers::Name)
  bool from_python(handle source, uint32_t flags, cleanup_list* cleanup) noexcept {
    Numbers numbers;
    if (!numbers.from_python(source, flags, cleanup)) return false;
    value = kLoad(numbers.value.data());
    return true;
  }
  static handle from_cpp(const Value_& value, rv_policy, cleanup_list* cleanup) noexcept {
    double numbers[(kShape * ...)];
    fleetmap::store(value, numbers);
    const auto array = copied<sizeof...(kShape)>(numbers, {size_t(kShape)...});
    return make_caster<decltype(array)>::from_cpp(array, rv_policy::automatic, cleanup);
  }
};
template <>
struct type_caster<fleetmap::Vec3> : copied_caster<fleetmap::Vec3, fleetmap::vec3, 3> {};
template <>
struct type_caster<fleetmap::Mat3> : copied_caster<fleetmap::Mat3, fleetmap::mat3, 3, 3> {};
template <>
struct type_caster<fleetmap::SE3> : copied_caster<fleetmap::SE3, fleetmap::se3, 4, 4> {};
template <>
struct type_caster<fleetmap::Mat6> : copied_caster<fleetmap::Mat6, fleetmap::mat6, 6, 6> {};
template <>
struct type_caster<fleetmap::StereoLens> : copied_caster<fleetmap::StereoLens, fleetmap::stereo_lens, 4> {};

// A vector becomes an array, with a row for each of its values.
template <typename T>
  requires std::is_trivially_copyable_v<T>
struct type_caster<std::vector<T>> {
  using Made = decltype(as_numpy<typename NumberOf<T>::Type>(std::vector<T>()));
  NB_TYPE_CASTER(std::vector<T>, make_caster<Made>::Name)
  static handle from_cpp(std::vector<T> values, rv_policy, cleanup_list* cleanup) noexcept {
    return make_caster<Made>::from_cpp(as_numpy<typename NumberOf<T>::Type>(std::move(values)), rv_policy::automatic, cleanup);
  }
};

}  // namespace nanobind::detail

// The result of a computation that needs no Python, done without its lock. Checks of whole arrays belong in it, too.
template <typename Compute>
auto unlocked(Compute&& compute) {
  nb::gil_scoped_release release;
  const fleetmap::CountedStep counted;
  return compute();
}

template <typename A, typename B>
bool same_size(const A& a, const B& b) {
  return a.shape(0) == b.shape(0) && a.shape(1) == b.shape(1);
}

// Refuses columns that have not so many rows.
template <typename... Columns>
void check_rows(size_t count, const char* refusal, const Columns&... columns) {
  if (((columns.shape(0) != count) || ...)) throw nb::value_error(refusal);
}

// Refuses columns with numbers that are not from 0 to below a count.
template <typename... Columns>
void check_below(size_t count, const char* refusal, const Columns&... columns) {
  const auto is_below = [&](auto number) { return number >= 0 && size_t(number) < count; };
  if (!(std::all_of(columns.begin(), columns.end(), is_below) && ...)) throw nb::value_error(refusal);
}

// So many zeros: those of pictures and maps are handed out page by page.
template <typename T>
std::vector<T> zeros(size_t count) {
  return unlocked([&] { return std::vector<T>(count); });
}

// A section of settings: an object of Python's with a number for each name.
struct Settings {
  nb::object section;
  struct Number {
    nb::object value;
    template <typename T>
    operator T() const {
      return nb::cast<T>(value);
    }
  };
  Number operator[](const char* name) const { return {section.attr(name)}; }
};
