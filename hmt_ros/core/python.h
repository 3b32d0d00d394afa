// From Python to the core: arrays, numbers, and named tuples as the structs that read them.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <string>
#include <tuple>
#include <utility>

#include "arrays.h"

namespace hmt {

namespace py = pybind11;

// Where a value comes from, for errors: "placing.offsets". Its text is made only when needed.
struct Name {
  const char* text = "";
  const Name* outer = nullptr;
  [[gnu::noinline]] std::string full() const {
    return outer ? outer->full() + (text[0] == '[' ? "" : ".") + text : std::string(text);
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

// Raises the error of an array of another kind than is wanted.
[[noreturn, gnu::noinline]] inline void refuse_array(py::handle value, const Name& name, char kind,
                                                     int bytes, int axes, bool written) {
  std::string wanted = kind == 'b' ? "bool" : kind == 'f' ? "float" : kind == 'u' ? "uint" : "int";
  if (kind != 'b') wanted += std::to_string(8 * bytes);
  throw py::type_error(name.full() + ": wanted a contiguous array of " + wanted + " with " +
                       std::to_string(axes) + (axes == 1 ? " axis" : " axes") +
                       (written ? " that can be written" : "") + ", saw " + seen(value));
}

template <class T, int N>
[[gnu::noinline]] Array<T, N> load_array(py::handle value, const Name& name) {
  using Element = std::remove_const_t<T>;
  constexpr char kind = std::is_same_v<Element, bool>       ? 'b'
                        : std::is_floating_point_v<Element> ? 'f'
                        : std::is_unsigned_v<Element>       ? 'u'
                                                            : 'i';
  if (py::isinstance<py::array>(value)) {
    auto array = py::reinterpret_borrow<py::array>(value);
    const auto type = array.dtype();
    const bool right = type.kind() == kind && type.itemsize() == sizeof(Element) &&
                       (type.byteorder() == '=' || type.byteorder() == '|');
    if (right && array.ndim() == N && (array.flags() & py::array::c_style) &&
        (std::is_const_v<T> || array.writeable())) {
      Array<T, N> result;
      result.data = static_cast<T*>(const_cast<void*>(array.data()));
      for (int axis = 0; axis < N; ++axis) result.shape[axis] = array.shape(axis);
      return result;
    }
  }
  refuse_array(value, name, kind, int(sizeof(Element)), N, !std::is_const_v<T>);
}

template <class T, std::size_t... I>
T load_members(py::handle value, const Name& name, std::index_sequence<I...>);

template <class T, std::size_t... I>
T load_tuple(py::handle value, const Name& name, std::index_sequence<I...>) {
  const std::string places[] = {std::string("[") + std::to_string(I) + "]" ...};
  return T{load<std::tuple_element_t<I, T>>(PyTuple_GET_ITEM(value.ptr(), I),
                                            Name{places[I].c_str(), &name})...};
}

[[gnu::noinline]] inline void expect_tuple(py::handle value, const Name& name,
                                           std::size_t members) {
  if (PyTuple_Check(value.ptr()) && py::len(value) == members) return;
  throw py::type_error(name.full() + ": wanted a tuple of " + std::to_string(members) + ", saw " +
                       seen(value));
}

template <class T>
[[gnu::noinline]] T load(py::handle value, const Name& name) {
  if constexpr (ArrayOf<T>::value) {
    return load_array<typename ArrayOf<T>::Element, ArrayOf<T>::axes>(value, name);
  } else if constexpr (std::is_arithmetic_v<T>) {
    try {
      if constexpr (std::is_same_v<T, bool>) {
        const int truth = PyObject_IsTrue(value.ptr());
        if (truth < 0) throw py::error_already_set();
        return truth != 0;
      } else {
        return value.cast<T>();
      }
    } catch (const std::exception&) {
      PyErr_Clear();
      throw py::type_error(name.full() + ": wanted a number, saw " + seen(value));
    }
  } else {
    constexpr std::size_t members = [] {
      if constexpr (TupleOf<T>::value)
        return std::tuple_size_v<T>;
      else
        return member_count<T>();
    }();
    expect_tuple(value, name, members);
    if constexpr (TupleOf<T>::value) {
      return load_tuple<T>(value, name, std::make_index_sequence<members>());
    } else {
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
}

// A member of a named tuple, converted to the type of the member that it initialises.
struct Member {
  py::handle tuple;
  std::size_t index;
  const Name* outer;
  template <class T>
  operator T() const {
    try {
      return load<T>(PyTuple_GET_ITEM(tuple.ptr(), index), Name{"", nullptr});
    } catch (const py::builtin_exception& error) {
      throw py::type_error(full(error.what()));
    } catch (const Misfit& error) {
      throw Misfit(full(error.what()));
    }
  }
  std::string full(const std::string& rest) const {
    std::string own = std::string("[") + std::to_string(index) + "]";
    if (py::hasattr(tuple, "_fields")) {
      own = "." + std::string(py::str(tuple.attr("_fields")[py::int_(index)]));
    }
    return outer->full() + own + rest;
  }
};

template <class T, std::size_t... I>
T load_members(py::handle value, const Name& name, std::index_sequence<I...>) {
  return T{Member{value, I, &name}...};
}

template <class Result, class... A, std::size_t... I>
py::object call(Result (*function)(A...), const py::args& arguments, const std::string* names,
                std::index_sequence<I...>) {
  std::tuple<std::remove_cvref_t<A>...> loaded{
      load<std::remove_cvref_t<A>>(arguments[I], Name{names[I].c_str(), nullptr})...};
  if constexpr (std::is_void_v<Result>) {
    py::gil_scoped_release unlocked;
    std::apply(function, loaded);
  } else {
    Result result;
    {
      py::gil_scoped_release unlocked;
      result = std::apply(function, loaded);
    }
    return py::cast(result);
  }
  return py::none();
}

// Binds a function of arrays, numbers and structs. `names` are those of its arguments, in order.
// It runs without the interpreter's lock.
template <class Result, class... A>
void bind(py::module_& module, const char* name, Result (*function)(A...), const char* names) {
  std::vector<std::string> split;
  for (const char* start = names; *start;) {
    const char* end = start;
    while (*end && *end != ' ') ++end;
    split.emplace_back(start, end);
    start = *end ? end + 1 : end;
  }
  if (split.size() != sizeof...(A)) throw std::logic_error(std::string(name) + ": names");
  const std::string doc = std::string(name) + "(" + names + ")";
  module.def(
      name,
      [function, split, name](const py::args& arguments) {
        if (arguments.size() != sizeof...(A)) {
          throw py::type_error(std::string(name) + ": wanted " + std::to_string(sizeof...(A)) +
                               " arguments, saw " + std::to_string(arguments.size()));
        }
        return call(function, arguments, split.data(), std::index_sequence_for<A...>());
      },
      doc.c_str());
}

}  // namespace hmt
