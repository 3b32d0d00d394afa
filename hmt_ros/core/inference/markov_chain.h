// Joint probabilities of chains of two states; hmt_ros/inference/markov_chain.py has the equations.
#pragma once

#include "../arrays.h"
#include "../elementary.h"

namespace hmt {

// Predicts a joint probability (2^n,) of n chains over dt seconds; the rates (n, 2), 1/s, are those
// of entering and leaving the second state. The first chain has the outer axis.
inline void step_chains(const Table& rates, double dt, const Vector& joint) {
  const Index chains = rates.size(), states = joint.size();
  expect_shape("rates", rates, {-1, 2});
  expect(chains < 40 && states == Index{1} << chains, "joint", "a probability for each state");
  for (Index axis = 0; axis < chains; ++axis) {
    const double total = rates(axis, 0) + rates(axis, 1), is = rates(axis, 0) / total;
    const double share = -elementary::expm1(-total * dt), begins = share * is;
    const double ends = share * (rates(axis, 1) / total);
    const Index stride = states >> (axis + 1);
    for (Index i = 0; i < states; ++i) {
      if (i & stride) continue;
      const double no = joint[i], yes = joint[i + stride];
      joint[i] = no * ((1.0 - share) + ends) + yes * ends;
      joint[i + stride] = no * begins + yes * ((1.0 - share) + begins);
    }
  }
}

}  // namespace hmt
