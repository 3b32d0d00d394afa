// The log density of a mixture over trajectories at samples of its own components, with gradients,
//
//     q(X) = sum_j a_j N(X; M_j, s_j^2 P_j^-1),  P_j = L_j L_j'
//
// see hmt_ros/smoothing/variational_mixture.py. L_j' is read column by column from the band. The
// distance to another component is summed from the column at which it is greatest, until the
// overlap is negligible.
#pragma once

#include "../elementary.h"
#include "../lanes.h"
#include "../wide.h"

namespace hmt {

inline constexpr double negligible_overlap = 40.0;  // a difference of log densities
inline constexpr Index overlap_stride = 32;         // columns between checks of negligible overlap

// Adds L y, (D,), of a band L (D, width) and y (D,) to the first entries of a sum (D + width,). Two
// columns are added at once, because loads that are shifted by one entry must wait for the stores
// before.
[[gnu::always_inline]] inline void add_columns(const Table& band, const Numbers& y,
                                               const Vector& sum) {
  const Index total = band.size(), width = band.size(1);
  Index c = 0;
  for (; c + 1 < total; c += 2) {
    const double* column = band[c].data;
    const double* next = column + width - 1;
    double* to = sum.data + c;
    const double one = y[c], two = y[c + 1];
    to[0] += one * column[0];
    for (Index b = 1; b < width; ++b) to[b] = to[b] + one * column[b] + two * next[b];
    to[width] += two * next[width];
  }
  for (; c < total; ++c) sum[c] += y[c] * band(c, 0);
}

// Evaluates log q at the samples of component `own`, and adds its derivatives.
//
// samples, noise: (S, D) M + s L'^-1 z, and z, with D = T n.
// log_weights, log_scales: (M,) log a_j, and log |P_j|^(1/2) - D log s_j - D log(2 pi) / 2.
// means, inflation: (M, D) and (M,) s_j.
// bands: (M, D, width) L_j: [c, r - c] = L[r, c].
// near: (M,) components that may overlap with `own`; the others are left out.
// begin: (M,) column at which the comparison with each begins.
// derivatives: whether they are wanted; else only `log_density` is written.
// share: weight of a sample in the sums over samples below.
// log_density, gradient: (S,), (S, D) log q and its gradient by the sample, written.
// mean_gradient, inflation_gradient, weight_gradient: (M, D), (M,), (M,); the derivatives of the
// sum of log q by means, log s and log a at fixed samples are added.
HMT_WIDE inline void add_component_overlaps(
    Index own, const Table& samples, const Table& noise, const Numbers& log_weights,
    const Numbers& log_scales, const Table& means, const Numbers& inflation, const Tables& bands,
    const Mask& near, const Places& begin, bool derivatives, double share,
    const Vector& log_density, const Matrix& gradient, const Matrix& mean_gradient,
    const Vector& inflation_gradient, const Vector& weight_gradient) {
  const Index count = samples.size(), total = samples.size(1);
  const Index components = means.size(), width = bands.size(2);
  expect(own >= 0 && own < components, "own", "one of the components");
  expect_shape("noise", noise, {count, total});
  expect_shape("log_weights", log_weights, {components});
  expect_shape("log_scales", log_scales, {components});
  expect_shape("means", means, {components, total});
  expect_shape("inflation", inflation, {components});
  expect_shape("bands", bands, {components, total, -1});
  expect(width > 0, "bands", "a diagonal");
  expect_shape("near", near, {components});
  expect_shape("begin", begin, {components});
  expect_range("begin", begin, 0, std::max(total, Index{1}));
  expect_shape("log_density", log_density, {count});
  expect_shape("gradient", gradient, {count, total});
  expect_shape("mean_gradient", mean_gradient, {components, total});
  expect_shape("inflation_gradient", inflation_gradient, {components});
  expect_shape("weight_gradient", weight_gradient, {components});

  const Scratch<double, 2> white(components, total);
  const Scratch<double, 1> delta(total + width), pull(total + width);  // `width` zeros at the end
  const Scratch<double, 1> squares(components), logs(components);
  for (Index s = 0; s < count; ++s) {
    const double* sample = samples[s].data;
    double best = -infinity;
    for (Index order = 0; order < components; ++order) {
      const Index j = order == 0 ? own : order <= own ? order - 1 : order;
      double log = log_weights[j] + log_scales[j], square = 0.0;
      double* own_white = white[j].data;
      if (j == own) {
        std::copy(noise[s].begin(), noise[s].end(), own_white);
        square = dot(own_white, own_white, total);
      } else if (!near[j]) {
        logs[j] = -infinity;
        continue;
      } else {
        const double inverse = 1.0 / inflation[j];
        const double* mean = means[j].data;
        double* difference = delta.view().data;
        for (Index c = 0; c < total; ++c) difference[c] = (sample[c] - mean[c]) * inverse;
        const double* band = bands[j].data;
        for (Index i = 0; i < total; ++i) {
          const Index c = begin[j] + i < total ? begin[j] + i : begin[j] + i - total;
          const double y = dot(band + c * width, difference + c, width);
          own_white[c] = y;
          square += y * y;
          if (i % overlap_stride == 0 && log - 0.5 * square < best - negligible_overlap) break;
        }
      }
      log -= 0.5 * square;
      squares[j] = square;
      logs[j] = log;
      best = most(best, log);
    }
    double density = 0.0;
    for (Index j = 0; j < components; ++j) {
      logs[j] = logs[j] > best - negligible_overlap ? elementary::exp(logs[j] - best) : 0.0;
      density += logs[j];
    }
    log_density[s] = best + elementary::log(density);
    if (!derivatives) continue;
    double* slope = gradient[s].data;
    std::fill(slope, slope + total, 0.0);
    for (Index j = 0; j < components; ++j) {
      const double responsibility = logs[j] / density;
      if (responsibility < 1e-15) continue;
      // P (x - M) / s^2 = L (L' (x - M) / s) / s
      pull.fill(0.0);
      add_columns(bands[j], white[j], pull);
      const double factor = responsibility / inflation[j];
      double* mean_slope = mean_gradient[j].data;
      for (Index c = 0; c < total; ++c) {
        const double move = factor * pull[c];
        slope[c] -= move;
        mean_slope[c] += share * move;
      }
      inflation_gradient[j] += share * responsibility * (squares[j] - static_cast<double>(total));
      weight_gradient[j] += share * responsibility;
    }
  }
}

}  // namespace hmt
