// What the core offers Python in place of numpy's functions of arrays.
#pragma once

#include <pybind11/pybind11.h>

namespace hmt {

void bind_elementary_functions(pybind11::module_& module);
void bind_matrix_functions(pybind11::module_& module);

}  // namespace hmt
