// The elementary functions for arrays, with numpy's names.
#include "array_functions.h"
#include "elementary.h"
#include "ufunc.h"

namespace hmt {

void bind_elementary_functions(const UfuncModule& m) {
  using namespace elementary;
  bind_elementwise(m, "sin", map_angles<sin_near, elementary::sin>, "Sine of an angle, rad.");
  bind_elementwise(m, "cos", map_angles<cos_near, elementary::cos>, "Cosine of an angle, rad.");
  bind_elementwise(m, "exp", map<elementary::exp>, "Exponential.");
  bind_elementwise(m, "expm1", map<elementary::expm1>, "Exponential less one.");
  bind_elementwise(m, "log", map<elementary::log>, "Natural logarithm.", FE_DIVBYZERO);
  bind_elementwise(m, "log1p", map<elementary::log1p>, "Natural logarithm of 1 + x.", FE_DIVBYZERO);
  bind_elementwise(m, "tanh", map<elementary::tanh>, "Hyperbolic tangent.");
  bind_elementwise(m, "arctan", map<elementary::atan>, "Inverse tangent, rad.");
  bind_elementwise(m, "arcsin", map<elementary::asin>, "Inverse sine, rad.");
  bind_elementwise(m, "arccos", map<elementary::acos>, "Inverse cosine, rad.");
  bind_elementwise(m, "arctan2", map<elementary::atan2>, "Angle of the point (y, x), rad.");
  bind_elementwise(m, "hypot", map<elementary::hypot>, "Length of the vector (x, y).");
  bind_elementwise(m, "power", map<elementary::pow>,
                   "x to the power y; no number for x < 0, unless y is 0.");
}

}  // namespace hmt
