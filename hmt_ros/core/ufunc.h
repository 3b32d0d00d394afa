// numpy ufuncs, which broadcast, convert and loop like numpy's own functions.
//
// They are created by numpy's C API, whose table is in a capsule, as pybind11 does for arrays. So
// the build needs no headers of numpy here, and none of pybind11, which are slow to compile.
#pragma once

#include <Python.h>

#include <cfenv>

#ifdef __SSE2__
#include <xmmintrin.h>
#endif

#include "array_functions.h"
#include "arrays.h"

namespace hmt {

// A loop of numpy: pointers to the first elements, the count, strides in bytes, and `data`.
using UfuncLoop = void (*)(char** pointers, const Index* counts, const Index* strides, void* data);

// Sets the exceptions that numpy reads after a loop: overflow, division by zero, invalid operation.
inline void report_only(int exceptions) {
#ifdef __SSE2__
  _mm_setcsr(_mm_getcsr() & ~63u);  // ten times as fast as the portable call
#else
  std::feclearexcept(FE_ALL_EXCEPT);
#endif
  if (exceptions) std::feraiseexcept(exceptions);
}

// Blocks of contiguous numbers: what a function of the core fills.
using UnaryBlock = void (*)(const double* x, double* result, Index count);
using BinaryBlock = void (*)(const double* x, const double* y, double* result, Index count);

struct Elementwise {
  void* block;
  int at_infinity;  // exception for an infinite result of finite arguments
};

inline constexpr Index block_size = 256;

// Strided numbers as a contiguous block; they are copied to `room` unless they are contiguous.
template <class T>
const double* gathered(const char* from, Index stride, Index count, double* room) {
  if (std::is_same_v<T, double> && stride == sizeof(double)) {
    return reinterpret_cast<const double*>(from);
  }
  for (Index i = 0; i < count; ++i) {
    room[i] = *reinterpret_cast<const T*>(from + i * stride);
  }
  return room;
}

// Calls the function for blocks of N arguments of type T, float or double; it computes in double.
template <class T, int N>
void elementwise_loop(char** pointers, const Index* counts, const Index* strides, void* data) {
  const auto& function = *static_cast<const Elementwise*>(data);
  double room[N + 1][block_size];
  int exceptions = 0;
  for (Index start = 0; start < counts[0]; start += block_size) {
    const Index count = std::min(block_size, counts[0] - start);
    const double* x[N];
    for (int a = 0; a < N; ++a) {
      x[a] = gathered<T>(pointers[a] + start * strides[a], strides[a], count, room[a]);
    }
    // numpy's results are either the arguments' memory or do not overlap it.
    char* to = pointers[N] + start * strides[N];
    bool direct = std::is_same_v<T, double> && strides[N] == sizeof(T);
    for (int a = 0; a < N; ++a) direct = direct && to != static_cast<const void*>(x[a]);
    double* result = direct ? reinterpret_cast<double*>(to) : room[N];
    if constexpr (N == 1) {
      reinterpret_cast<UnaryBlock>(function.block)(x[0], result, count);
    } else {
      reinterpret_cast<BinaryBlock>(function.block)(x[0], x[1], result, count);
    }
    int doubt = 0;
    for (Index i = 0; i < count; ++i) doubt |= !(std::abs(result[i]) < infinity);
    for (Index i = 0; doubt && i < count; ++i) {
      bool finite = true, number = true;
      for (int a = 0; a < N; ++a) {
        finite = finite && std::isfinite(x[a][i]);
        number = number && !std::isnan(x[a][i]);
      }
      if (std::isnan(result[i]) && number) exceptions |= FE_INVALID;
      if (std::isinf(result[i]) && finite) {
        exceptions |= x[0][i] == 0.0 ? FE_DIVBYZERO : function.at_infinity;
      }
    }
    for (Index i = 0; !direct && i < count; ++i) {
      *reinterpret_cast<T*>(to + i * strides[N]) = static_cast<T>(result[i]);
    }
  }
  report_only(exceptions);
}

// Adds an object that numpy has created to a module.
inline void add(const UfuncModule& module, const char* name, PyObject* made) {
  if (!made || PyModule_AddObject(module.object, name, made) < 0) throw std::runtime_error(name);
}

template <int N>
void bind_block(const UfuncModule& module, const char* name, const Elementwise& function,
                const char* doc) {
  static UfuncLoop loops[] = {elementwise_loop<float, N>, elementwise_loop<double, N>};
  static char types[2 * (N + 1)];
  std::fill_n(types, N + 1, 11);          // NPY_FLOAT
  std::fill_n(types + N + 1, N + 1, 12);  // NPY_DOUBLE
  using Make = PyObject* (*)(UfuncLoop*, void**, const char*, int, int, int, int, const char*,
                             const char*, int);
  auto* kept = new Elementwise(function);  // lives as long as the module
  auto** data = new void*[2]{kept, kept};
  const auto make = reinterpret_cast<Make>(module.numpy[1]);
  constexpr int no_identity = -1;
  add(module, name, make(loops, data, types, 2, N, 1, no_identity, name, doc, 0));
}

// Binds a function of blocks as a ufunc of float32 and float64.
inline void bind_elementwise(const UfuncModule& module, const char* name, UnaryBlock block,
                             const char* doc, int at_infinity = FE_OVERFLOW) {
  bind_block<1>(module, name, {reinterpret_cast<void*>(block), at_infinity}, doc);
}
inline void bind_elementwise(const UfuncModule& module, const char* name, BinaryBlock block,
                             const char* doc, int at_infinity = FE_OVERFLOW) {
  bind_block<2>(module, name, {reinterpret_cast<void*>(block), at_infinity}, doc);
}

// Binds loops over matrices as a generalised ufunc: one of float64, or those of float32 and
// float64. The signature is numpy's, such as "(n,n),(n,m)->(n,m)"; a loop gets the counts and the
// strides of these axes after those of the items.
inline void bind_matrix_function(const UfuncModule& module, const char* name,
                                 std::initializer_list<UfuncLoop> loops, const char* signature,
                                 int inputs, int outputs, const char* doc) {
  using Make = PyObject* (*)(UfuncLoop*, void**, const char*, int, int, int, int, const char*,
                             const char*, int, const char*);
  const int kinds = int(loops.size()), arrays = inputs + outputs;
  // These live as long as the module.
  auto* kept = new std::vector<UfuncLoop>(loops);
  auto* data = new std::vector<void*>(kinds, nullptr);
  auto* types = new std::vector<char>(kinds * arrays, 12);        // NPY_DOUBLE
  if (kinds == 2) std::fill_n(types->begin(), arrays, char{11});  // NPY_FLOAT
  const auto make = reinterpret_cast<Make>(module.numpy[31]);
  add(module, name,
      make(kept->data(), data->data(), types->data(), kinds, inputs, outputs, -1, name, doc, 0,
           signature));
}

}  // namespace hmt
