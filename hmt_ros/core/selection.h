// Choice of few hypotheses that stand for all; see hmt_ros/tracking/selection.py.
//
//     min over S, |S| = K:   sum_i w_i min_{s in S} d(i, s)
//
// The K are chosen greedily, the heaviest first; d is the mean distance of the joints, each capped,
// less what counts as none.
#pragma once

#include <bit>

#include "arrays.h"
#include "elementary.h"
#include "lanes.h"
#include "wide.h"

namespace hmt {

// Single precision is micrometres here.
using Place = std::array<float, 3>;

// The places of the joints (N, J, 3) of hypotheses: combinations of limbs share most of them.
struct JointPlaces {
  std::vector<Place> distinct;  // joint by joint
  std::vector<std::size_t> ends;
  Scratch<std::uint32_t, 2> numbers;  // (N, J) of places in `distinct`

  explicit JointPlaces(const Tables& joints) : numbers(joints.size(), joints.size(1)) {
    const std::size_t slots = std::bit_ceil(2 * std::size_t(joints.size()) + 1);
    // A table of places by their bits; one more than the number of a place, 0: none.
    std::vector<std::uint32_t> found;
    for (Index k = 0; k < joints.size(1); ++k) {
      found.assign(slots, 0);
      for (Index i = 0; i < joints.size(); ++i) numbers(i, k) = number_of(joints[i][k], found);
      ends.push_back(distinct.size());
    }
  }

 private:
  std::uint32_t number_of(const Numbers& joint, std::vector<std::uint32_t>& found) {
    Place place;
    std::uint64_t slot = 0;
    for (int x = 0; x < 3; ++x) {
      place[x] = static_cast<float>(joint[x]);
      slot = (slot ^ std::bit_cast<std::uint32_t>(place[x])) * 0x9e3779b97f4a7c15;
    }
    for (slot >>= 32;; ++slot) {
      std::uint32_t& number = found[slot & (found.size() - 1)];
      const bool is_new = number == 0;
      if (is_new) {
        distinct.push_back(place);
        number = static_cast<std::uint32_t>(distinct.size());
      }
      if (is_new || distinct[number - 1] == place) return number - 1;
    }
  }
};

// So many hypotheses are compared with another one at once.
inline constexpr Index strip = 32;

// Fills how far a place is from others (3, strip), capped, (strip,).
HMT_WIDE inline void fill_gaps(const Place& place, const float* others, float cap, float* gaps) {
  for (Index b = 0; b < strip; ++b) {
    const float x = place[0] - others[b], y = place[1] - others[strip + b];
    const float z = place[2] - others[2 * strip + b];
    const float gap = std::sqrt(x * x + y * y + z * z);
    gaps[b] = gap < cap ? gap : cap;
  }
}

// Fills the distances of a hypothesis from others (strip,), of rows (J,) of gaps.
HMT_WIDE inline void add_gaps(const float* const* rows, Index joints, float same,
                              float* distances) {
  constexpr Index groups = strip / Lanes<float>::count;
  Group<float> totals[groups] = {};
  for (Index k = 0; k < joints; ++k) {
    const auto* row = reinterpret_cast<const Group<float>*>(rows[k]);
    for (Index g = 0; g < groups; ++g) totals[g] += row[g];
  }
  for (Index g = 0; g < groups; ++g) {
    const Group<float> none{}, distance = totals[g] / static_cast<float>(joints) - same;
    *reinterpret_cast<Group<float>*>(distances + g * Lanes<float>::count) =
        none > distance ? none : distance;
  }
}

// Fills the distances (N, N) of hypotheses by their joints (N, J, 3), m.
inline void fill_distances(const Tables& joints, float same, float cap,
                           const Array<float, 2>& distances) {
  const Index n = joints.size(), count = joints.size(1);
  const JointPlaces places(joints);
  const Scratch<float, 2> gaps(places.distinct.size(), strip), others(3, strip);
  const Scratch<float, 2> tile(strip, strip);
  const Scratch<const float*, 1> rows(count);
  for (Index first = 0; first < n; first += strip) {
    const Index last = std::min(first + strip, n);
    std::size_t place = 0;
    for (Index k = 0; k < count; ++k) {
      for (Index b = first; b < last; ++b) {
        for (int x = 0; x < 3; ++x) {
          others(x, b - first) = places.distinct[places.numbers(b, k)][x];
        }
      }
      for (; place < places.ends[k]; ++place) {
        fill_gaps(places.distinct[place], others[0].data, cap, gaps[place].data);
      }
    }
    for (Index start = 0; start <= first; start += strip) {
      const Index end = std::min(start + strip, n);
      for (Index a = start; a < end; ++a) {
        for (Index k = 0; k < count; ++k) rows[k] = gaps[places.numbers(a, k)].data;
        add_gaps(rows.view().data, count, same, tile[a - start].data);
        std::copy_n(tile[a - start].data, last - first, distances[a].data + first);
      }
      for (Index b = first; b < last; ++b) {
        for (Index a = start; a < end; ++a) distances(b, a) = tile(a - start, b - first);
      }
    }
  }
}

// Adds to `gains` (N,) what hypothesis i, at `nearest` from those that are kept, gains if any of N
// at distances `away` is kept, too.
HMT_WIDE inline void add_gains(const float* away, Index n, double weight, float nearest,
                               double* gains) {
  for (Index c = 0; c < n; ++c) {
    gains[c] += weight * most(static_cast<double>(nearest - away[c]), 0.0);
  }
}

// So many candidates are looked at together.
inline constexpr Index together = 8;

// Fills what N hypotheses gain if one that is `away` from them is kept, too, for several. Sums are
// in order; only what is summed can be computed side by side, so it is put down first.
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

// The choice as it grows.
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

  // Takes the gains of all; it is to be called before the first `best`.
  void weigh() {
    const Index n = weights_.size();
    gains_.fill(0.0);
    for (Index i = 0; i < n; ++i) {
      add_gains(distances_[i].data, n, weights_[i], nearest_[i], gains_.view().data);
    }
  }

  // The hypothesis that lessens the expected distance most, the first of these; -1: none does.
  Index best() {
    // Gains only shrink as more are kept: a candidate whose last gain is smaller than the best of
    // this round need not be looked at again. The one with the largest last gain comes first.
    for (Index c = 0; c < weights_.size(); ++c) {
      if (nearest_[c] == 0.0f) gains_[c] = 0.0;  // kept, or the same as one that is
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

  // Keeps a hypothesis as number `kept` of the chosen, the owner of those that it is nearest to.
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
  // Takes the present gains of a few.
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
  Scratch<float, 1> nearest_;    // distances to the nearest that is kept
  Scratch<double, 1> gains_;     // of the candidates, when they were last looked at
};

// Fills the log weights (K,) of groups of hypotheses, each with the place of its group.
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

// Chooses hypotheses that stand for all, by their joints (N, J, 3) and log weights (N,); returns
// how many, at most as `chosen` (K,) has place for.
//
// `same` and `cap` are the mean distance of hypotheses that are one, and the largest that a joint
// counts with, m. Those in `first` are kept in any case, after the heaviest. `owner` (N,) becomes
// the place in `chosen` of the one that stands for each, `groups` (K,) the log weights of all that
// each stands for.
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

// Fills `kept` (N,) with the hypotheses whose joints (N, J, 3) are `same` m or more from those of
// all that were kept before, in the mean, and returns their number. They are looked at in `order`.
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
