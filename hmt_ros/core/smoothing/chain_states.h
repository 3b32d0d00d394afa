// States of a chain of Gaussians, which minimise
//
//     E(X) = x_1' K x_1 / 2 - p' x_1 + sum_t s_t |x_(t+1) - A_t x_t|^2_(Q_t) / 2
//            + sum_t |x_t - z_t|^2_(R_t) / 2 + sum_t |J_(t+1) x_(t+1) + c_(t+1) - J_t x_t -
//            c_t|^2_w / 2
//
// The Hessian is block-tridiagonal; see hmt_ros/smoothing/motion_smoother.py.
#pragma once

#include "../block_tridiagonal.h"

namespace hmt {

// Prior of the states: A' Q^-1 A, Q^-1 and Q^-1 A of I intervals, (I, n, n); the interval between
// each two states, its share s; and K and p of the first state.
struct ChainPrior {
  Tables before, after, forth;
  Places which;
  Numbers shares;
  Table known;
  Numbers pull;
  void check() const {
    const Index n = pull.size(), count = before.size();
    expect_shape("before", before, {count, n, n});
    expect_shape("after", after, {count, n, n});
    expect_shape("forth", forth, {count, n, n});
    expect_range("which", which, 0, count);
    expect_shape("shares", shares, {which.size()});
    expect_shape("known", known, {n, n});
  }
};

// Points that rest from a state to the next with weights w (T - 1, R), linear in the d variables of
// poses: J (T, R, d) and c (T, R). Without any, R = 0.
struct RestingTable {
  Tables jacobians;
  Table places, weights;
};

// Adds J' W J of weights (R,) to the lower triangle of the columns of a block.
inline void add_weighed(const Matrix& columns, Index first, const Table& jacobian,
                        const Numbers& weights) {
  const Index d = jacobian.size(1);
  for (Index r = 0; r < weights.size(); ++r) {
    const double* row = jacobian[r].data;
    for (Index b = 0; b < d; ++b) {
      add_scaled(weights[r] * row[b], row + b, columns[first + b].data, d - b);
    }
  }
}

// Fills the Hessian into columns (T n, 2 n) of a band, from the last state to the first, and adds
// the linear terms to the right-hand side (T n).
HMT_WIDE inline void fill_chain(const ChainPrior& prior, const Tables& precisions,
                                const Table& means, const RestingTable& resting,
                                const Matrix& columns, const Vector& right) {
  const Index times = means.size(), d = means.size(1), n = prior.pull.size();
  const Index resting_count = resting.places.size(1);
  for (Index t = 0; t < times; ++t) {
    const Index first = (times - 1 - t) * n;
    double* pull = right.data + first;
    for (Index b = 0; b < n; ++b) {
      double* column = columns[first + b].data;
      std::fill_n(column, 2 * n, 0.0);
      if (t == 0) {
        for (Index a = b; a < n; ++a) column[a - b] += prior.known(b, a);
        pull[b] += prior.pull[b];
      }
      if (t + 1 < times) {
        const double* row = prior.before[prior.which[t]][b].data;
        add_scaled(prior.shares[t], row + b, column, n - b);
      }
      if (t > 0) {
        const Index i = prior.which[t - 1];
        const double share = prior.shares[t - 1];
        add_scaled(share, prior.after[i][b].data + b, column, n - b);
        add_scaled(-share, prior.forth[i][b].data, column + n - b, n);
      }
      if (b >= d) continue;
      const double* row = precisions[t][b].data;
      add_scaled(1.0, row + b, column, d - b);
      pull[b] += dot(row, means[t].data, d);
    }
    for (Index side : {t - 1, t}) {  // before and after this state
      if (side < 0 || side + 1 >= times) continue;
      const Numbers weights = resting.weights[side];
      add_weighed(columns, first, resting.jacobians[t], weights);
      for (Index r = 0; r < resting_count; ++r) {
        const double moved = resting.places(side + 1, r) - resting.places(side, r);
        const double factor = (side == t ? 1.0 : -1.0) * weights[r] * moved;
        add_scaled(factor, resting.jacobians[t][r].data, pull, d);
      }
    }
    for (Index r = 0; t > 0 && r < resting_count; ++r) {
      const double* own = resting.jacobians[t][r].data;
      const double* other = resting.jacobians[t - 1][r].data;
      for (Index b = 0; b < d; ++b) {
        const double factor = -resting.weights(t - 1, r) * own[b];
        add_scaled(factor, other, columns[first + b].data + n - b, d);
      }
    }
  }
}

// Factorises the Hessian into the columns of a band, and fills the states (T, n). Precisions (T, d,
// d) and means (T, d) are R^-1 and z. Returns the number of columns with a pivot, as
// `factorise_band`; if not all, states are not valid.
inline Index condition_chain(const ChainPrior& prior, const Tables& precisions, const Table& means,
                             const RestingTable& resting, const Matrix& columns,
                             const Matrix& states) {
  const Index times = states.size(), n = states.size(1), d = means.size(1);
  const Index resting_count = resting.places.size(1);
  expect(times > 0 && d <= n, "states", "a state at least, with the variables of a pose");
  expect_shape("prior.pull", prior.pull, {n});
  expect_shape("prior.which", prior.which, {times - 1});
  expect_shape("precisions", precisions, {times, d, d});
  expect_shape("means", means, {times, d});
  expect_shape("resting.jacobians", resting.jacobians, {times, resting_count, d});
  expect_shape("resting.places", resting.places, {times, resting_count});
  expect_shape("resting.weights", resting.weights, {times - 1, resting_count});
  expect_shape("columns", columns, {times * n, 2 * n});
  const Scratch<double, 2> right(1, times * n);
  fill_chain(prior, precisions, means, resting, columns, right[0]);
  const Index done = factorise_blocks(columns, n);
  if (done < times * n) return done;
  solve_band_lower(columns, right);
  solve_band_transposed(columns, right);
  for (Index t = 0; t < times; ++t) {
    std::copy_n(right[0].data + (times - 1 - t) * n, n, states[t].data);
  }
  return done;
}

}  // namespace hmt
