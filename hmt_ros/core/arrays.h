// Non-owning arrays, scratch space, and checks of arguments from Python.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <initializer_list>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace hmt {

using Index = std::int64_t;  // numpy.intp
inline constexpr double infinity = std::numeric_limits<double>::infinity();
inline constexpr double nan = std::numeric_limits<double>::quiet_NaN();
inline constexpr double pi = 3.14159265358979323846;

// A contiguous row-major array with N axes; arrays of `const` elements are inputs.
template <class T, int N>
struct Array {
  T* data = nullptr;
  std::array<Index, N> shape{};

  Index size(int axis = 0) const { return shape[axis]; }
  Index count() const {
    Index product = 1;
    for (Index extent : shape) product *= extent;
    return product;
  }
  bool empty() const { return count() == 0; }

  // An element of a vector, or a row of an array, which is an array with one axis fewer.
  decltype(auto) operator[](Index i) const {
    if constexpr (N == 1) {
      return static_cast<T&>(data[i]);
    } else {
      Array<T, N - 1> row{data, {}};
      Index stride = 1;
      for (int axis = 1; axis < N; ++axis) stride *= row.shape[axis - 1] = shape[axis];
      row.data += i * stride;
      return row;
    }
  }
  template <class... I>
  T& operator()(I... indices) const {
    static_assert(sizeof...(I) == N);
    const std::array<Index, N> at{static_cast<Index>(indices)...};
    Index offset = at[0];
    for (int axis = 1; axis < N; ++axis) offset = offset * shape[axis] + at[axis];
    return data[offset];
  }
  T* begin() const { return data; }
  T* end() const { return data + count(); }

  // The rows from `first` to `last` - 1.
  Array rows(Index first, Index last) const {
    Array part = *this;
    Index stride = 1;
    for (int axis = 1; axis < N; ++axis) stride *= shape[axis];
    part.data += first * stride;
    part.shape[0] = last - first;
    return part;
  }
  void fill(std::remove_const_t<T> value) const { std::fill(begin(), end(), value); }
  void copy_from(const Array<const std::remove_const_t<T>, N>& other) const {
    std::copy(other.begin(), other.end(), data);
  }
  operator Array<const T, N>() const
    requires(!std::is_const_v<T>)
  {
    return {data, shape};
  }
};

using Vector = Array<double, 1>;
using Matrix = Array<double, 2>;
using Tensor = Array<double, 3>;
using Numbers = Array<const double, 1>;  // a read-only vector
using Table = Array<const double, 2>;
using Tables = Array<const double, 3>;
using Places = Array<const Index, 1>;
using Mask = Array<const bool, 1>;

// An invalid argument; Python raises it as ValueError.
struct Misfit : std::invalid_argument {
  using std::invalid_argument::invalid_argument;
};

inline std::string in_brackets(const Index* shape, int axes) {
  std::string text = "(";
  for (int axis = 0; axis < axes; ++axis) {
    text += (axis ? ", " : "") + std::to_string(shape[axis]);
  }
  return text + (axes == 1 ? ",)" : ")");
}

// Number of elements of scratch space, with a limit because wrong extents may be huge.
[[gnu::noinline]] inline std::size_t scratch_size(const Index* shape, int axes) {
  constexpr Index limit = Index(1) << 27;
  Index count = 1;
  for (int axis = 0; axis < axes; ++axis) {
    if (shape[axis] < 0 || (shape[axis] > 0 && count > limit / shape[axis])) {
      throw Misfit("arguments: wanted at most " + std::to_string(limit) +
                   " numbers of scratch space, saw " + in_brackets(shape, axes));
    }
    count *= shape[axis];
  }
  return static_cast<std::size_t>(count);
}

// Scratch space: an array that owns its elements, initially zero.
template <class T, int N>
class Scratch {
 public:
  template <class... I>
  explicit Scratch(I... extents) {
    view_.shape = {static_cast<Index>(extents)...};
    // Not std::vector, because std::vector<bool> contains no array of bool.
    elements_ = std::make_unique<T[]>(scratch_size(view_.shape.data(), N));
    view_.data = elements_.get();
  }
  operator const Array<T, N>&() const { return view_; }
  operator Array<const T, N>() const { return view_; }
  const Array<T, N>& view() const { return view_; }
  template <class... I>
  T& operator()(I... indices) const {
    return view_(indices...);
  }
  decltype(auto) operator[](Index i) const { return view_[i]; }
  void fill(T value) const { view_.fill(value); }
  Index size(int axis = 0) const { return view_.size(axis); }

 private:
  std::unique_ptr<T[]> elements_;
  Array<T, N> view_;
};

// Comparisons as in Python: they return the first number if neither is smaller or one is NaN.
inline double least(double a, double b) { return b < a ? b : a; }
inline double most(double a, double b) { return b > a ? b : a; }
inline double between(double x, double low, double high) { return least(most(x, low), high); }
inline double square(double x) { return x * x; }
inline double dot(const double* a, const double* b) {  // of vectors (3,)
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
inline std::array<double, 3> cross(const double* a, const double* b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}
inline double sign(double x) { return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : x; }

// Index of the first largest number, or of the first NaN, as numpy.argmax.
inline Index place_of_largest(const Numbers& numbers) {
  Index place = 0;
  for (Index i = 0; i < numbers.size(); ++i) {
    if (std::isnan(numbers[i])) return i;
    if (numbers[i] > numbers[place]) place = i;
  }
  return place;
}

// Checks that an array has the wanted extents; -1 allows any extent.
template <class T, int N>
[[gnu::noinline]] void expect_shape(const char* name, const Array<T, N>& array,
                                    std::array<Index, N> wanted) {
  for (int axis = 0; axis < N; ++axis) {
    if (wanted[axis] >= 0 && wanted[axis] != array.shape[axis]) {
      throw Misfit(std::string(name) + ": wanted shape " + in_brackets(wanted.data(), N) +
                   ", saw " + in_brackets(array.shape.data(), N));
    }
  }
}

// Checks that all entries are at least `low` and less than `high`.
template <class T, int N>
[[gnu::noinline]] void expect_range(const char* name, const Array<T, N>& array, Index low,
                                    Index high) {
  for (Index entry : array) {
    if (entry < low || entry >= high) {
      throw Misfit(std::string(name) + ": wanted numbers from " + std::to_string(low) + " up to " +
                   std::to_string(high - 1) + ", saw " + std::to_string(entry));
    }
  }
}

[[gnu::noinline]] inline void expect(bool fits, const char* name, const char* wanted) {
  if (!fits) throw Misfit(std::string(name) + ": wanted " + wanted);
}

}  // namespace hmt
