#include "pose_energy.h"

namespace hmt {

namespace {

// Sets the next trial from a step, between the limits: rounding must not leave a variable a hair
// away from its limit.
void try_step(const Numbers& x, const Numbers& step, const Numbers& low, const Numbers& high,
              const Table& limits, const Vector& trial) {
  for (Index i = 0; i < x.size(); ++i) {
    trial[i] = step[i] <= low[i]    ? limits(0, i)
               : step[i] >= high[i] ? limits(1, i)
                                    : between(x[i] + step[i], limits(0, i), limits(1, i));
  }
}

void check(Index first, Index last, const Terms& terms, const Numbers& point, const Places& free,
           const Places& rows, const Table& limits, const Descent& descent, const Matrix& x,
           const Vector& value, const Matrix& gradient, const Tensor& hessian, const ByCue& by_cue,
           const Array<std::int8_t, 1>& status, const Array<std::int32_t, 1>& iterations) {
  const Index n = x.size(), f = free.size(), d = terms.placing.dimension();
  expect(0 <= first && first <= last && last <= n, "last", "a range of the points x");
  expect_shape("point", point, {d});
  expect_range("free", free, 0, d);
  expect_shape("x", x, {n, f});
  expect_shape("rows", rows, {n});
  expect_range("rows", rows, 0, terms.problems());
  expect_shape("limits", limits, {2, f});
  expect_shape("descent.metric", descent.metric, {descent.most > 0 ? f : -1});
  expect_shape("value", value, {n});
  const Index wanted = gradient.size() > 0 ? n : 0;
  expect(wanted || descent.most == 0, "gradient", "room for derivatives, which minima need");
  expect_shape("gradient", gradient, {wanted, f});
  expect_shape("hessian", hessian, {wanted, f, f});
  const auto& [values, hessians] = by_cue;
  if (values.size() > 0) {
    expect(f == d, "free", "all variables where cues are wanted apart");
    expect_shape("by_cue[0]", values, {n, 3});
    expect_shape("by_cue[1]", hessians, {wanted, 3, d, d});
  }
  if (terms.centres.size() > 0) expect_shape("terms.centres", terms.centres, {-1, f});
  expect_shape("status", status, {n});
  expect_shape("iterations", iterations, {n});
}

}  // namespace

void solve(Index first, Index last, const Terms& terms, const Numbers& point, const Places& free,
           const Places& rows, bool exact, const Table& limits, const Descent& descent,
           const Matrix& x, const Vector& value, const Matrix& gradient, const Tensor& hessian,
           const ByCue& by_cue, const Array<std::int8_t, 1>& status,
           const Array<std::int32_t, 1>& iterations) {
  check(first, last, terms, point, free, rows, limits, descent, x, value, gradient, hessian, by_cue,
        status, iterations);
  const Index f = free.size();
  const auto& [values, hessians] = by_cue;
  const bool apart = values.size() > 0, wanted = gradient.size() > 0;
  PoseEnergy energy(terms, point, free, apart);
  BoxStep box(f);
  Scratch<double, 1> slope(f), low(f), high(f), step(f), trial(f);
  Scratch<double, 2> curve(f, f);
  for (Index n = first; n < last; ++n) {
    double shift = descent.damping, growth = 2.0, predicted = 0.0;
    Status result = Status::iteration_limit;
    for (Index turn = 0; turn <= descent.most; ++turn) {
      if (turn == 0) {
        trial.view().copy_from(x[n]);
      } else {
        for (Index i = 0; i < f; ++i) {
          low[i] = limits(0, i) - x(n, i);
          high[i] = limits(1, i) - x(n, i);
        }
        predicted = box.take(gradient[n], hessian[n], low, high, shift, descent.metric, step);
        if (predicted < descent.tolerance) {
          result = Status::converged;
          break;
        }
        try_step(x[n], step, low, high, limits, trial);
      }
      const double found = energy.at(n, rows[n], trial, exact, wanted, slope, curve);
      if (apart) {
        values[n].copy_from(energy.values());
        if (wanted) hessians[n].copy_from(energy.hessians());
      }
      bool better = true;
      if (turn == 0) {
        if (!std::isfinite(found)) result = Status::not_finite;
      } else {
        ++iterations[n];
        const double ratio = std::isfinite(found) ? (value[n] - found) / predicted : -infinity;
        better = ratio > least_ratio;
        if (better) {
          const double trusted = 2.0 * least(ratio, 2.0) - 1.0;
          shift *= most(least_factor, 1.0 - trusted * trusted * trusted);
          growth = 2.0;
        } else {
          shift *= growth;
          growth *= 2.0;
          if (shift > damping_limit) result = Status::stalled;
        }
      }
      if (better) {
        x[n].copy_from(trial);
        value[n] = found;
        if (wanted) {
          gradient[n].copy_from(slope);
          hessian[n].copy_from(curve);
        }
      }
      if (result != Status::iteration_limit) break;
    }
    status[n] = static_cast<std::int8_t>(result);
  }
}

}  // namespace hmt
