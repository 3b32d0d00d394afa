// Functions of the core that replace numpy's functions of arrays.
#pragma once

#include <Python.h>

namespace hmt {

// The module that gets these functions, and the table of numpy's C API that creates them.
struct UfuncModule {
  PyObject* object;
  void** numpy;
};

void bind_elementary_functions(const UfuncModule& module);
void bind_matrix_functions(const UfuncModule& module);

}  // namespace hmt
