// Choice of a few representative hypotheses; see hmt_ros/tracking/selection.py.
//
//     min over S, |S| = K:   sum_i w_i min_{s in S} d(i, s)
//
// The K are chosen greedily, the heaviest first; d is the mean of the capped joint distances, minus
// a tolerance.
#pragma once

#include "arrays.h"
#include "elementary.h"
#include "lanes.h"
#include "wide.h"

namespace hmt {

// Adds to `totals` the capped distances of the J joints of N hypotheses (J, 3, N) from those of
// hypothesis a, for hypothesis a and all later ones.
HMT_WIDE inline void add_distances(const float* rows, Index joints, Index n, Index a, float cap,
                                   float* totals) {
  for (Index k = 0; k < joints; ++k, rows += 3 * n) {
    const float *xs = rows, *ys = rows + n, *zs = rows + 2 * n;
    const float xa = xs[a], ya = ys[a], za = zs[a];
    for (Index b = a; b < n; ++b) {
      const float x = xa - xs[b], y = ya - ys[b], z = za - zs[b];
      const float gap = std::sqrt(x * x + y * y + z * z);
      totals[b] += gap < cap ? gap : cap;
    }
  }
}

// Fills the distances (N, N) of hypotheses by their joints (N, J, 3), m.
inline void fill_distances(const Tables& joints, float same, float cap,
                           const Array<float, 2>& distances) {
  const Index n = joints.size(), count = joints.size(1);
  // One row per coordinate, so that inner loops run along memory. Single precision is exact to
  // micrometres.
  Scratch<float, 3> rows(count, 3, n);
  for (Index k = 0; k < count; ++k) {
    for (int x = 0; x < 3; ++x) {
      for (Index a = 0; a < n; ++a) rows(k, x, a) = static_cast<float>(joints(a, k, x));
    }
  }
  for (Index a = 0; a < n; ++a) {
    float* own = distances[a].data;
    add_distances(rows.view().data, count, n, a, cap, own);
    for (Index b = a; b < n; ++b) {
      const float distance = own[b] / static_cast<float>(count) - same;
      own[b] = distances(b, a) = 0.0f > distance ? 0.0f : distance;
    }
  }
}

// Adds to `gains` (N,) the gain of one hypothesis if one of N candidates is kept, too. `nearest` is
// its distance from the kept hypotheses, `away` from the candidates.
HMT_WIDE inline void add_gains(const float* away, Index n, double weight, float nearest,
                               double* gains) {
  for (Index c = 0; c < n; ++c) {
    gains[c] += weight * most(static_cast<double>(nearest - away[c]), 0.0);
  }
}

// Number of candidates evaluated together, and number of hypotheses in a strip.
inline constexpr Index together = 8, strip = 32;

// Fills the gain of N hypotheses if a candidate at distances `away` is kept, too, for several
// candidates. Sums have a fixed order; summands are stored first, so that they are vectorised.
HMT_WIDE inline void fill_gains(const float* const* away, const float* nearest,
                                const double* weights, Index n, double* gains) {
  double parts[together][strip];
  std::fill_n(gains, together, 0.0);
  for (Index first = 0; first < n; first += strip) {
    const Index count = std::min(strip, n - first);
    for (Index c = 0; c < together; ++c) {
      for (Index i = 0; i < count; ++i) {
        const float less = nearest[first + i] - away[c][first + i];
        parts[c][i] = weights[first + i] * most(static_cast<double>(less), 0.0);
      }
    }
    for (Index i = 0; i < count; ++i) {
      for (Index c = 0; c < together; ++c) gains[c] += parts[c][i];
    }
  }
}

// State of the greedy choice.
class Selection {
 public:
  Selection(const Tables& joints, const Numbers& weights, float same, float cap)
      : weights_(weights),
        distances_(joints.size(), joints.size()),
        nearest_(joints.size()),
        gains_(joints.size()) {
    fill_distances(joints, same, cap, distances_);
    nearest_.fill(cap);
  }

  // Computes the gains of all; must be called before the first `best`.
  void weigh() {
    const Index n = weights_.size();
    gains_.fill(0.0);
    for (Index i = 0; i < n; ++i) {
      add_gains(distances_[i].data, n, weights_[i], nearest_[i], gains_.view().data);
    }
  }

  // The first hypothesis that reduces the expected distance most; -1 if none reduces it.
  Index best() {
    // Gains only shrink as more are kept, so candidates whose last gain is below the best of this
    // round are skipped. The candidate with the largest last gain is evaluated first.
    for (Index c = 0; c < weights_.size(); ++c) {
      if (nearest_[c] == 0.0f) gains_[c] = 0.0;  // kept, or equal to a kept one
    }
    Index best = place_of_largest(gains_);
    if (gains_[best] > 0.0) update({best});
    std::vector<Index> some;
    for (Index c = 0; c < weights_.size(); ++c) {
      if (c != best && gains_[c] > 0.0 && gains_[c] >= gains_[best]) some.push_back(c);
      if (some.empty() || (some.size() < together && c + 1 < weights_.size())) continue;
      update(some);
      for (Index other : some) {
        if (gains_[other] > gains_[best] || (gains_[other] == gains_[best] && other < best)) {
          best = other;
        }
      }
      some.clear();
    }
    return gains_[best] > 0.0 ? best : -1;
  }

  // Keeps a hypothesis as number `kept`; it becomes the owner of hypotheses that are nearest to it.
  void keep(Index hypothesis, Index kept, const Array<Index, 1>& owner) {
    const float* away = distances_[hypothesis].data;
    for (Index i = 0; i < weights_.size(); ++i) {
      if (away[i] < nearest_[i]) {
        nearest_[i] = away[i];
        owner[i] = kept;
      }
    }
    owner[hypothesis] = kept;
  }

 private:
  // Updates the gains of a few candidates.
  void update(const std::vector<Index>& some) {
    const float* away[together];
    double gains[together];
    for (std::size_t i = 0; i < together; ++i) {
      away[i] = distances_[some[std::min(i, some.size() - 1)]].data;
    }
    fill_gains(away, nearest_.view().data, weights_.data, weights_.size(), gains);
    for (std::size_t i = 0; i < some.size(); ++i) gains_[some[i]] = gains[i];
  }

  const Numbers weights_;
  Scratch<float, 2> distances_;  // (N, N)
  Scratch<float, 1> nearest_;    // distances to the nearest kept hypothesis
  Scratch<double, 1> gains_;     // of the candidates, at their last evaluation
};

// Fills the log weights (K,) of groups of hypotheses; `owner` (N,) is the group of each.
inline void sum_groups(const Numbers& log_weights, const Places& owner, const Vector& groups) {
  Scratch<double, 1> tops(groups.size()), sums(groups.size());
  tops.fill(-infinity);
  for (Index i = 0; i < owner.size(); ++i) tops[owner[i]] = most(tops[owner[i]], log_weights[i]);
  for (Index i = 0; i < owner.size(); ++i) {
    sums[owner[i]] += elementary::exp(log_weights[i] - tops[owner[i]]);
  }
  for (Index k = 0; k < groups.size(); ++k) {
    groups[k] = tops[k] > -infinity ? tops[k] + elementary::log(sums[k]) : -infinity;
  }
}

// Fills `chosen` (K,) with representatives of hypotheses with joints (N, J, 3) and log weights
// (N,); returns the number of representatives.
//
// `same` is the mean distance below which hypotheses count as equal, `cap` the maximum distance of
// a joint, m. Hypotheses in `first` are always kept, after the heaviest. `owner` (N,) becomes the
// place in `chosen` of each hypothesis's representative, `groups` (K,) the log weight that each
// representative stands for.
inline Index choose_representatives(const Tables& joints, const Numbers& log_weights, double same,
                                    double cap, const Places& first, const Array<Index, 1>& chosen,
                                    const Array<Index, 1>& owner, const Vector& groups) {
  const Index n = joints.size();
  expect_shape("joints", joints, {-1, -1, 3});
  expect(joints.size(1) > 0, "joints", "one joint at least");
  expect_shape("log_weights", log_weights, {n});
  expect_range("first", first, 0, n);
  expect(chosen.size() <= n, "chosen", "no more than there are hypotheses");
  expect_shape("owner", owner, {n});
  expect_shape("groups", groups, {chosen.size()});
  owner.fill(0);
  if (chosen.empty()) return 0;
  Scratch<double, 1> weights(n);
  const double top = log_weights[place_of_largest(log_weights)];
  double total = 0.0;
  for (Index i = 0; i < n; ++i) total += weights[i] = elementary::exp(log_weights[i] - top);
  for (double& weight : weights.view()) weight /= total;
  Selection selection(joints, weights, static_cast<float>(same), static_cast<float>(cap));
  Index kept = 0;
  for (; kept < chosen.size(); ++kept) {
    if (kept == 1 + first.size()) selection.weigh();
    const Index best = kept == 0              ? place_of_largest(weights)
                       : kept <= first.size() ? first[kept - 1]
                                              : selection.best();
    if (best < 0) break;
    chosen[kept] = best;
    selection.keep(best, kept, owner);
  }
  sum_groups(log_weights, owner, groups);
  return kept;
}

// Fills `kept` (N,) with hypotheses whose joints (N, J, 3) have a mean distance of at least `same`,
// m, from all hypotheses kept before, in the given `order`; returns their number.
inline Index keep_apart(const Tables& joints, const Places& order, double same,
                        const Array<Index, 1>& kept) {
  const Index n = joints.size(), count = joints.size(1);
  expect_shape("joints", joints, {-1, -1, 3});
  expect_shape("order", order, {n});
  expect_range("order", order, 0, n);
  expect_shape("kept", kept, {n});
  Index number = 0;
  for (Index i : order) {
    const double* own = joints[i].data;
    bool apart = true;
    for (Index place = 0; place < number && apart; ++place) {
      const double* other = joints[kept[place]].data;
      double total = 0.0;
      for (Index j = 0; j < 3 * count; j += 3) {
        const double x = own[j] - other[j], y = own[j + 1] - other[j + 1];
        const double z = own[j + 2] - other[j + 2];
        total += std::sqrt(x * x + y * y + z * z);
      }
      apart = total / static_cast<double>(count) >= same;
    }
    if (apart) kept[number++] = i;
  }
  return number;
}

}  // namespace hmt
