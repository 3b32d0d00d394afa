// What the core offers Python in place of numpy's functions of arrays.
#pragma once

#include <Python.h>

namespace hmt {

// A module that gets such functions, and the table of numpy's C interface that makes them.
struct UfuncModule {
  PyObject* object;
  void** numpy;
};

void bind_elementary_functions(const UfuncModule& module);
void bind_matrix_functions(const UfuncModule& module);

}  // namespace hmt
