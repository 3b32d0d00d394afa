// Conversion from Python to the core: arrays, numbers, and named tuples to structs.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <string>
#include <tuple>
#include <utility>

#include "arrays.h"

namespace hmt {

namespace py = pybind11;

// Path of a value, for error messages: "placing.offsets", "by_cue[1]". The text is only made when
// needed, from the names of arguments and tuple members along the path.
struct Name {
  const char* text;
  const Name* outer = nullptr;
  py::handle tuple = {};
  std::size_t place = 0;
  [[gnu::noinline]] std::string full() const {
    if (!outer) return text;
    if (!py::hasattr(tuple, "_fields")) return outer->full() + "[" + std::to_string(place) + "]";
    return outer->full() + "." + std::string(py::str(tuple.attr("_fields")[py::int_(place)]));
  }
};

struct Anything {
  template <class T>
  constexpr operator T() const;
};

// The number of members of an aggregate.
template <class T, class... A>
constexpr std::size_t member_count() {
  if constexpr (requires { T{std::declval<A>()..., Anything{}}; }) {
    return member_count<T, A..., Anything>();
  } else {
    return sizeof...(A);
  }
}

template <class T>
T load(py::handle value, const Name& name);

template <class T>
struct ArrayOf : std::false_type {};
template <class T, int N>
struct ArrayOf<Array<T, N>> : std::true_type {
  using Element = T;
  static constexpr int axes = N;
};
template <class T>
struct TupleOf : std::false_type {};
template <class... T>
struct TupleOf<std::tuple<T...>> : std::true_type {};
template <class T, std::size_t N>
struct TupleOf<std::array<T, N>> : std::true_type {};

[[gnu::noinline]] inline std::string seen(py::handle value) {
  if (!py::isinstance<py::array>(value)) return py::str(py::type::of(value).attr("__name__"));
  auto array = py::reinterpret_borrow<py::array>(value);
  std::string text = py::str(array.dtype());
  text += " ";
  text += in_brackets(reinterpret_cast<const Index*>(array.shape()), int(array.ndim()));
  if (!(array.flags() & py::array::c_style)) text += ", not contiguous";
  if (!array.writeable()) text += ", read-only";
  return text;
}

// Raises the error for an array of the wrong kind.
[[noreturn, gnu::noinline]] inline void refuse_array(py::handle value, const Name& name, char kind,
                                                     int bytes, int axes, bool written) {
  std::string wanted = kind == 'b' ? "bool" : kind == 'f' ? "float" : kind == 'u' ? "uint" : "int";
  if (kind != 'b') wanted += std::to_string(8 * bytes);
  throw py::type_error(name.full() + ": wanted a contiguous array of " + wanted + " with " +
                       std::to_string(axes) + (axes == 1 ? " axis" : " axes") +
                       (written ? " that can be written" : "") + ", saw " + seen(value));
}

// Returns an argument as an array of the wanted kind.
[[gnu::noinline]] inline py::array expect_array(py::handle value, const Name& name, char kind,
                                                int bytes, int axes, bool written) {
  if (py::isinstance<py::array>(value)) {
    auto array = py::reinterpret_borrow<py::array>(value);
    const auto type = array.dtype();
    const bool right = type.kind() == kind && type.itemsize() == bytes &&
                       (type.byteorder() == '=' || type.byteorder() == '|');
    if (right && array.ndim() == axes && (array.flags() & py::array::c_style) &&
        (!written || array.writeable())) {
      return array;
    }
  }
  refuse_array(value, name, kind, bytes, axes, written);
}

template <class T, int N>
[[gnu::noinline, gnu::cold]] Array<T, N> load_array(py::handle value, const Name& name) {
  using Element = std::remove_const_t<T>;
  constexpr char kind = std::is_same_v<Element, bool>       ? 'b'
                        : std::is_floating_point_v<Element> ? 'f'
                        : std::is_unsigned_v<Element>       ? 'u'
                                                            : 'i';
  const auto array = expect_array(value, name, kind, sizeof(Element), N, !std::is_const_v<T>);
  Array<T, N> result;
  result.data = static_cast<T*>(const_cast<void*>(array.data()));
  std::copy_n(array.shape(), N, result.shape.begin());
  return result;
}

// A member of a tuple, converted to the type of the struct member that it initialises.
struct Member {
  py::handle tuple;
  std::size_t place;
  const Name* outer;
  template <class T>
  operator T() const {
    return load<T>(PyTuple_GET_ITEM(tuple.ptr(), place), Name{"", outer, tuple, place});
  }
};

template <class T, std::size_t... I>
T load_members(py::handle value, const Name& name, std::index_sequence<I...>) {
  if constexpr (TupleOf<T>::value) {
    return T{static_cast<std::tuple_element_t<I, T>>(Member{value, I, &name})...};
  } else {
    return T{Member{value, I, &name}...};
  }
}

[[gnu::noinline]] inline void expect_tuple(py::handle value, const Name& name,
                                           std::size_t members) {
  if (PyTuple_Check(value.ptr()) && py::len(value) == members) return;
  throw py::type_error(name.full() + ": wanted a tuple of " + std::to_string(members) + ", saw " +
                       seen(value));
}

template <class T>
[[gnu::noinline, gnu::cold]] T load_number(py::handle value, const Name& name) {
  if constexpr (std::is_same_v<T, bool>) {
    const int truth = PyObject_IsTrue(value.ptr());
    if (truth >= 0) return truth != 0;
    PyErr_Clear();
  } else {
    py::detail::make_caster<T> caster;
    if (caster.load(value, true)) return caster;
  }
  throw py::type_error(name.full() + ": wanted a number, saw " + seen(value));
}

template <class T>
[[gnu::noinline, gnu::cold]] T load(py::handle value, const Name& name) {
  if constexpr (ArrayOf<T>::value) {
    return load_array<typename ArrayOf<T>::Element, ArrayOf<T>::axes>(value, name);
  } else if constexpr (std::is_arithmetic_v<T>) {
    return load_number<T>(value, name);
  } else {
    constexpr std::size_t members = [] {
      if constexpr (TupleOf<T>::value)
        return std::tuple_size_v<T>;
      else
        return member_count<T>();
    }();
    expect_tuple(value, name, members);
    T result = load_members<T>(value, name, std::make_index_sequence<members>());
    if constexpr (requires { result.check(); }) {
      try {
        result.check();
      } catch (const Misfit& error) {
        throw Misfit(name.full() + "." + error.what());
      }
    }
    return result;
  }
}

// A bound function: how to call it with its arguments, and their names.
struct Bound {
  py::object (*call)(const Bound& bound, PyObject* const* arguments);
  void (*function)();
  const char* name;
  std::vector<std::string> names;
};

template <class Result, class... A, std::size_t... I>
Result call_unlocked(Result (*function)(A...), const Bound& bound, PyObject* const* arguments,
                     std::index_sequence<I...>) {
  std::tuple<std::remove_cvref_t<A>...> loaded{
      load<std::remove_cvref_t<A>>(arguments[I], Name{bound.names[I].c_str()})...};
  py::gil_scoped_release unlocked;
  return std::apply(function, loaded);
}

template <class Result, class... A>
[[gnu::cold]] py::object call(const Bound& bound, PyObject* const* arguments) {
  const auto function = reinterpret_cast<Result (*)(A...)>(bound.function);
  constexpr auto places = std::index_sequence_for<A...>();
  if constexpr (std::is_void_v<Result>) {
    call_unlocked(function, bound, arguments, places);
    return py::none();
  } else {
    return py::cast(call_unlocked(function, bound, arguments, places));
  }
}

// `names` has one name for each argument, separated by spaces.
[[gnu::noinline]] inline void bind_by_names(py::module_& module, Bound bound, std::size_t wanted,
                                            const char* names) {
  for (const char* start = names; *start;) {
    const char* end = start;
    while (*end && *end != ' ') ++end;
    bound.names.emplace_back(start, end);
    start = *end ? end + 1 : end;
  }
  if (bound.names.size() != wanted) throw std::logic_error(std::string(bound.name) + ": names");
  const std::string doc = std::string(bound.name) + "(" + names + ")";
  const char* name = bound.name;
  module.def(
      name,
      [bound = std::move(bound)](const py::args& arguments) {
        if (arguments.size() != bound.names.size()) {
          throw py::type_error(std::string(bound.name) + ": wanted " +
                               std::to_string(bound.names.size()) + " arguments, saw " +
                               std::to_string(arguments.size()));
        }
        return bound.call(bound, PySequence_Fast_ITEMS(arguments.ptr()));
      },
      doc.c_str());
}

// Binds a function of arrays, numbers and structs. `names` are the names of its arguments, in
// order. It runs without the interpreter's lock.
template <class Result, class... A>
void bind(py::module_& module, const char* name, Result (*function)(A...), const char* names) {
  bind_by_names(module, {call<Result, A...>, reinterpret_cast<void (*)()>(function), name, {}},
                sizeof...(A), names);
}

// The table of numpy's C API, which creates its functions.
inline void** ufunc_interface() {
  py::object module;
  try {
    module = py::module_::import("numpy._core._multiarray_umath");
  } catch (py::error_already_set&) {  // before numpy 2
    module = py::module_::import("numpy.core._multiarray_umath");
  }
  return static_cast<void**>(PyCapsule_GetPointer(module.attr("_UFUNC_API").ptr(), nullptr));
}

}  // namespace hmt
