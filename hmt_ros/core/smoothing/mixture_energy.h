// -log of mixtures p(r_t | x) = sum_k w_k N(x; m_k, S_k); see hmt_ros/smoothing/likelihood.py.
#pragma once

#include "../elementary.h"
#include "../lanes.h"
#include "../wide.h"

namespace hmt {

// Modes whose density is below exp(-60) of the greatest are left out: less than rounding.
inline constexpr double negligible_mode = 60.0;

// Writes value (N,), gradient (N, d) and, if `second`, Hessian (N, d, d) at poses (N, d) of times
// (N,); with `exact` the Hessian has its negative part. The modes of time t are first[t] to first[t
// + 1] - 1; log_scales (K,), means (K, d), whiteners and precisions (K, d, d).
HMT_WIDE inline void add_mixture_energy(const Table& poses, const Places& times,
                                        const Places& first, const Numbers& log_scales,
                                        const Table& means, const Tables& whiteners,
                                        const Tables& precisions, bool second, bool exact,
                                        const Vector& value, const Matrix& gradient,
                                        const Tensor& hessian) {
  const Index poses_count = poses.size(), d = poses.size(1), modes = means.size();
  expect_shape("times", times, {poses_count});
  expect_range("times", times, 0, first.size() - 1);
  expect_range("first", first, 0, modes + 1);
  expect_shape("log_scales", log_scales, {modes});
  expect_shape("means", means, {modes, d});
  expect_shape("whiteners", whiteners, {modes, d, d});
  expect_shape("precisions", precisions, {modes, d, d});
  expect_shape("value", value, {poses_count});
  expect_shape("gradient", gradient, {poses_count, d});
  if (second) expect_shape("hessian", hessian, {poses_count, d, d});
  Index greatest = 0;
  for (Index t = 0; t + 1 < first.size(); ++t) {
    expect(first[t] <= first[t + 1], "first", "numbers that do not fall");
    greatest = std::max(greatest, first[t + 1] - first[t]);
  }

  const Scratch<double, 2> white(greatest, d), pull(greatest, d);
  const Scratch<double, 1> logs(greatest), near(greatest), delta(d);
  for (Index i = 0; i < poses_count; ++i) {
    const Index start = first[times[i]], count = first[times[i] + 1] - start;
    const double* pose = poses[i].data;
    // Find a mode that explains the pose well, so that the others are rejected early.
    Index leading = 0;
    for (Index k = 0; k < count; ++k) {
      const Index mode = start + k;
      const double* mean = means[mode].data;
      const double* precision = precisions[mode].data;
      double total = 0.0;
      for (Index a = 0; a < d; ++a) {
        const double offset = pose[a] - mean[a];
        total += offset * offset * precision[a * (d + 1)];
      }
      near[k] = log_scales[mode] - 0.5 * total / static_cast<double>(d);
      if (near[k] > near[leading]) leading = k;
    }
    double best = -infinity;
    for (Index order = 0; order < count; ++order) {
      const Index k = order == 0 ? leading : order <= leading ? order - 1 : order;
      const Index mode = start + k;
      const double* mean = means[mode].data;
      const double* whitener = whiteners[mode].data;
      double* difference = delta.view().data;
      double* own = white[k].data;
      for (Index a = 0; a < d; ++a) difference[a] = pose[a] - mean[a];
      double log = log_scales[mode];
      const double floor = best - negligible_mode;
      for (Index a = 0; a < d; ++a) {
        const double y = dot(whitener + a * d, difference, a + 1);
        own[a] = y;
        log -= 0.5 * y * y;
        if (log < floor) {
          log = -infinity;
          break;
        }
      }
      logs[k] = log;
      best = most(best, log);
    }
    double total = 0.0;
    for (Index k = 0; k < count; ++k) {
      logs[k] = logs[k] > best - negligible_mode ? elementary::exp(logs[k] - best) : 0.0;
      total += logs[k];
    }
    value[i] = -(best + elementary::log(total));
    double* slope = gradient[i].data;
    std::fill(slope, slope + d, 0.0);
    for (Index k = 0; k < count; ++k) {
      logs[k] /= total;
      if (logs[k] == 0.0) continue;
      const double* whitener = whiteners[start + k].data;
      double* own = pull[k].data;
      std::fill(own, own + d, 0.0);
      for (Index a = 0; a < d; ++a) {
        const double factor = white(k, a);
        const double* row = whitener + a * d;
        for (Index b = 0; b <= a; ++b) own[b] += factor * row[b];
      }
      for (Index a = 0; a < d; ++a) slope[a] += logs[k] * own[a];
    }
    if (!second) continue;
    double* curvature = hessian[i].data;
    bool opened = false;
    for (Index k = 0; k < count; ++k) {
      if (logs[k] == 0.0) continue;
      const double share = logs[k];
      const double* precision = precisions[start + k].data;
      if (opened) {
        for (Index a = 0; a < d * d; ++a) curvature[a] += share * precision[a];
      } else {
        for (Index a = 0; a < d * d; ++a) curvature[a] = share * precision[a];
        opened = true;
      }
    }
    if (!exact) continue;
    for (Index k = 0; k < count; ++k) {
      if (logs[k] == 0.0 || logs[k] == 1.0) continue;
      const double* own = pull[k].data;
      for (Index a = 0; a < d; ++a) {
        const double one = logs[k] * (own[a] - slope[a]);
        double* row = curvature + a * d;
        for (Index b = 0; b < d; ++b) row[b] -= one * (own[b] - slope[b]);
      }
    }
  }
}

}  // namespace hmt
