// Steps of the bounded damped Newton method; see hmt_ros/inference/bounded_newton.py.
#pragma once

#include "lanes.h"
#include "wide.h"

namespace hmt {

inline constexpr double damping_limit = 1e12;
inline constexpr double least_factor = 1.0 / 3.0;  // minimum factor on a damping in a step
inline constexpr double least_ratio = 1e-3;        // minimum share of the predicted decrease

// Decrease that the quadratic model predicts for a step (d,); `curve` (d,) becomes H step.
inline double predicted_decrease(const Numbers& gradient, const Table& hessian, const Numbers& step,
                                 const Vector& curve) {
  const Index d = step.size();
  curve.fill(0.0);
  for (Index j = 0; j < d; ++j) {  // along rows of a symmetric matrix, many entries at once
    const double moved = step[j];
    const double* row = hessian[j].data;
    for (Index i = 0; i < d; ++i) curve[i] += row[i] * moved;
  }
  double total = 0.0;
  for (Index i = 0; i < d; ++i) total -= step[i] * (gradient[i] + 0.5 * curve[i]);
  return total;
}

// Whether a variable at a limit is pushed outwards.
inline bool rests(double low, double high, double slope) {
  return (low >= 0.0 && slope > 0.0) || (high <= 0.0 && slope < 0.0);
}

// The minimiser of the damped model in a box around 0, by an active set.
class BoxStep {
 public:
  explicit BoxStep(Index d)
      : bound_(d), solution_(d), curve_(d), best_(d), factor_(d, d), free_(d) {}

  // Sets the step (d,) and returns the decrease that the undamped model predicts. If the limits
  // leave a step without gain, steepest descent replaces it.
  HMT_WIDE double take(const Numbers& gradient, const Table& hessian, const Numbers& low,
                       const Numbers& high, double damping, const Numbers& metric,
                       const Vector& step) {
    minimise(gradient, hessian, low, high, damping, metric, step);
    const double predicted = predicted_decrease(gradient, hessian, step, curve_);
    return predicted <= 0.0 ? descend(gradient, hessian, low, high, metric, step) : predicted;
  }

 private:
  static double least_shift(const Table& hessian, const Numbers& metric) {
    double largest = 0.0, smallest = infinity;
    for (Index i = 0; i < metric.size(); ++i) {
      smallest = least(smallest, metric[i]);
      for (double entry : hessian[i]) largest = most(largest, std::abs(entry));
    }
    return 1e-3 * largest / smallest;
  }

  void minimise(const Numbers& gradient, const Table& hessian, const Numbers& low,
                const Numbers& high, double shift, const Numbers& metric, const Vector& step) {
    const Index d = gradient.size();
    best_.fill(0.0);
    for (Index i = 0; i < d; ++i) {
      bound_[i] = rests(low[i], high[i], gradient[i]);
      step[i] = bound_[i] ? between(0.0, low[i], high[i]) : 0.0;
    }
    double best_gain = -infinity;
    for (Index turn = 0; turn < 3 * d + 3; ++turn) {
      Index count = 0;
      for (Index i = 0; i < d; ++i) {
        if (!bound_[i]) free_[count++] = i;
      }
      while (!solve(gradient, hessian, shift, metric, count, step)) {
        // Not positive definite: increase the damping in steps, because Gershgorin's bound is too
        // large.
        const double more = most(4.0 * shift, least_shift(hessian, metric));
        if (shift > damping_limit || !(more > shift)) break;
        shift = more;
      }
      bool across = false;
      for (Index c = 0; c < count; ++c) {
        const Index i = free_[c];
        step[i] = solution_[c];
        if (step[i] < low[i] || step[i] > high[i]) {
          across = bound_[i] = true;
          step[i] = between(step[i], low[i], high[i]);
        }
      }
      if (count == d && !across) return;
      const double gain = predicted_decrease(gradient, hessian, step, curve_);
      if (gain > best_gain) {
        best_gain = gain;
        best_.view().copy_from(step);
      }
      if (across) continue;
      double worst = 0.0;
      Index released = -1;
      for (Index i = 0; i < d; ++i) {
        if (!bound_[i] || !(low[i] < high[i])) continue;
        const double slope = gradient[i] + curve_[i] + shift * metric[i] * step[i];
        const bool away = (step[i] <= low[i] && slope < 0.0) || (step[i] >= high[i] && slope > 0.0);
        if (away && std::abs(slope) > worst) {
          worst = std::abs(slope);
          released = i;
        }
      }
      if (released < 0) return;
      bound_[released] = false;
    }
    step.copy_from(best_);
  }

  // Solves the damped model for the free variables, with bound variables fixed at their steps, by a
  // row-wise Cholesky factorisation; false if the matrix is not positive definite.
  bool solve(const Numbers& gradient, const Table& hessian, double shift, const Numbers& metric,
             Index count, const Vector& step) {
    for (Index a = 0; a < count; ++a) {
      const Index i = free_[a];
      for (Index b = a; b < count; ++b) factor_(a, b) = hessian(i, free_[b]);
      factor_(a, a) += shift * metric[i];
      double right = -gradient[i];
      for (Index j = 0; j < step.size(); ++j) {
        if (bound_[j]) right -= hessian(i, j) * step[j];
      }
      solution_[a] = right;
    }
    // Eliminate two rows at a time, one after the other.
    for (Index a = 0; a < count; a += 2) {
      const Index b = a + 1;
      const double *row = factor_[a].data, *next = row;
      bool positive = scale_row(a, count);
      if (b < count) {
        next = factor_[b].data;
        subtract(row, a, b, count);
        positive &= scale_row(b, count);
      }
      if (!positive) return false;
      for (Index c = b + 1; c < count; ++c) {
        const double first = row[c], second = next[c];
        solution_[c] = solution_[c] - first * solution_[a] - second * solution_[b];
        double* other = factor_[c].data;
#pragma omp simd
        for (Index i = c; i < count; ++i) other[i] = other[i] - first * row[i] - second * next[i];
      }
    }
    for (Index a = count - 1; a >= 0; --a) {
      const double* row = factor_[a].data;
      solution_[a] =
          (solution_[a] - dot(row + a + 1, &solution_[0] + a + 1, count - a - 1)) / row[a];
    }
    return true;
  }

  // Divides row a of the factor by the root of its pivot; false if the pivot is not positive.
  bool scale_row(Index a, Index count) {
    double* row = factor_[a].data;
    if (!(row[a] > 0.0)) return false;
    const double root = 1.0 / std::sqrt(row[a]);
    for (Index i = a; i < count; ++i) row[i] *= root;
    solution_[a] *= root;
    return true;
  }
  // Subtracts the product with row a from row b.
  void subtract(const double* row, Index a, Index b, Index count) {
    solution_[b] -= row[b] * solution_[a];
    add_scaled(-row[b], row + b, factor_[b].data + b, count - b);
  }

  // Steepest descent in the metric, projected onto the box; returns its gain.
  double descend(const Numbers& gradient, const Table& hessian, const Numbers& low,
                 const Numbers& high, const Numbers& metric, const Vector& step) {
    const Index d = gradient.size();
    const Vector& direction = solution_;
    double slope = 0.0;
    for (Index i = 0; i < d; ++i) {
      direction[i] = rests(low[i], high[i], gradient[i]) ? 0.0 : -gradient[i] / metric[i];
      slope -= direction[i] * gradient[i];
    }
    double curvature = slope - predicted_decrease(gradient, hessian, direction, curve_);
    curvature *= 2.0;
    double length = curvature > 0.0 ? slope / curvature : 1.0, gain = 0.0;
    for (int turn = 0; turn < 60; ++turn) {
      for (Index i = 0; i < d; ++i) step[i] = between(length * direction[i], low[i], high[i]);
      gain = predicted_decrease(gradient, hessian, step, curve_);
      if (gain > 0.0 || slope <= 0.0) break;
      length *= 0.5;
    }
    return gain;
  }

  Scratch<bool, 1> bound_;
  Scratch<double, 1> solution_, curve_, best_;
  Scratch<double, 2> factor_;
  Scratch<Index, 1> free_;
};

// Steps from the points of some problems, and the decrease that the undamped model predicts.
//
// x, gradient, lower, upper: (N, d). hessian: (N, d, d). lam: (N,) damping; increased if the
// Hessian is not positive definite. metric: (d,) diagonal of W. rows: (n,) the problems.
// step, predicted: (n, d), (n,) become the steps and the decreases.
void box_steps(const Table& x, const Table& gradient, const Tables& hessian, const Table& lower,
               const Table& upper, const Numbers& lam, const Numbers& metric, const Places& rows,
               const Matrix& step, const Vector& predicted);

}  // namespace hmt
