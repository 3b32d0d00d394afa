// Configurations of limbs on trunks, and their best products (KJS 3); see
// hmt_ros/flips/limb_products.py.
//
//     cost of a product = share * sum of the changes in energy + penalties - log weight
#pragma once

#include "../kinematics.h"
#include "../log_sum_exp.h"
#include "distinct.h"
#include "tree_growth.h"

namespace hmt {

// Distance by which a ray may miss its sphere if the start of the limb has moved, m.
inline constexpr double elsewhere_slack = 0.1;

// The C limbs of a body, of at most K links, D degrees of freedom and J joints that move.
struct Limbs {
  Places links, dofs, joints;  // (C,) numbers of each limb
  // Arrays of `ChainLinks`, padded to the size of the largest limb.
  Array<const Index, 2> segments;  // (C, K)
  Places parents;                  // (C,)
  Array<const double, 4> mounts;
  Array<const bool, 2> mounted;
  Table lengths;
  Array<const Index, 2> first_dofs, own;  // (C, K + 1), (C, D)
  Table lower, upper;
  Array<const bool, 3> sides;
  Array<const Index, 2> joint_segments;  // (C, J)
  Tables joint_offsets;                  // (C, J, 3)
  Places siblings;                       // (C,) index of the limb of the other side; -1: none

  Index size() const { return links.size(); }
  Index width() const { return own.size(1); }
  Index most_leaves() const { return Index{1} << segments.size(1); }
  ChainLinks chain(Index c) const {
    const Index k = links[c], d = dofs[c];
    return {segments[c].rows(0, k), parents[c],
            mounts[c].rows(0, k),   mounted[c].rows(0, k),
            lengths[c].rows(0, k),  first_dofs[c].rows(0, k + 1),
            own[c].rows(0, d),      lower[c].rows(0, d),
            upper[c].rows(0, d),    sides[c].rows(0, k)};
  }
  void check() const {
    const Index c = size(), k = segments.size(1), d = width(), j = joint_segments.size(1);
    expect(k <= ChainLinks::most_links, "segments", "at most 20 links");
    expect_range("links", links, 1, k + 1);
    expect_shape("dofs", dofs, {c});
    expect_range("dofs", dofs, 0, d + 1);
    expect_shape("joints", joints, {c});
    expect_range("joints", joints, 0, j + 1);
    expect_shape("segments", segments, {c, k});
    expect_shape("parents", parents, {c});
    expect_shape("mounts", mounts, {c, k, 3, 3});
    expect_shape("mounted", mounted, {c, k});
    expect_shape("lengths", lengths, {c, k});
    expect_shape("first_dofs", first_dofs, {c, k + 1});
    expect_shape("own", own, {c, d});
    expect_shape("lower", lower, {c, d});
    expect_shape("upper", upper, {c, d});
    expect_shape("sides", sides, {c, k, 2});
    expect_shape("joint_segments", joint_segments, {c, j});
    expect_shape("joint_offsets", joint_offsets, {c, j, 3});
    expect_shape("siblings", siblings, {c});
    expect_range("siblings", siblings, -1, c);
    for (Index i = 0; i < c; ++i) {
      chain(i).check();
      const Index other = siblings[i];
      expect(other < 0 || (other != i && siblings[other] == i && links[other] == links[i]),
             "siblings", "pairs of limbs with equally many links");
    }
  }
};

// Configurations of limbs on T trunks; G modes share the first trunk.
struct Configurations {
  Table trunks;                   // (T, d) a pose of each trunk
  Array<const double, 4> angles;  // (T, C, A, D)
  Array<const Index, 2> counts;   // (T, C) number of configurations; 0: those on the first trunk
  Tables penalties;  // (G, C, A) minus the log probability of each on the first trunk, by mode

  Index size() const { return trunks.size(); }
  Index limbs() const { return angles.size(1); }
  Index most() const { return angles.size(2); }
  void check() const {
    expect_shape("angles", angles, {size(), -1, -1, -1});
    expect_shape("counts", counts, {size(), limbs()});
    expect_range("counts", counts, 0, most() + 1);
    expect_shape("penalties", penalties, {-1, limbs(), most()});
  }
};

// Configurations as a result to be filled.
struct NewConfigurations {
  Matrix trunks;
  Array<double, 4> angles;
  Array<Index, 2> counts;
  Tensor penalties;

  operator Configurations() const { return {trunks, angles, counts, penalties}; }
  void check() const { Configurations(*this).check(); }
};

// Checks that configurations fit the limbs, and poses with d degrees of freedom.
inline void expect_configurations(const char* name, const Configurations& found, const Limbs& limbs,
                                  Index d) {
  const std::string text(name);
  expect_shape((text + ".trunks").c_str(), found.trunks, {-1, d});
  expect_shape((text + ".angles").c_str(), found.angles, {-1, limbs.size(), -1, limbs.width()});
  expect_range("limbs.own", limbs.own, 0, d);
}

// The number of poses with at most one configuration: trunks alone, and each configuration.
inline Index poses_alone(const Configurations& found) {
  Index total = found.size();
  for (Index count : found.counts) total += count;
  return total;
}

// Fills the configurations of a group of modes.
class ConfigurationFiller {
 public:
  ConfigurationFiller(const Placing& tree, const Limbs& limbs, const Table& modes,
                      const Tables& found, const Places& found_counts, double price, double apart,
                      const NewConfigurations& result)
      : tree_(tree),
        limbs_(limbs),
        modes_(modes),
        found_(found),
        found_counts_(found_counts),
        price_(price),
        apart_(apart),
        result_(result) {
    place(modes[0], lead_);
  }

  // On the first trunk: limbs of the modes, further limbs, and limbs in the other side's place.
  // Each is followed by its flips, so that small differences between modes do not displace flips.
  void fill_first() {
    result_.trunks[0].copy_from(modes_[0]);
    for (Index c = 0; c < limbs_.size(); ++c) {
      const Index sources = gather(c), n = flip_all(c, sources);
      keep(0, c, lead_, modes_[0], n);
      for (Index i = 0; i < n; ++i) {
        if (owner_[i] < 0) continue;
        for (Index g = 0; g < modes_.size(); ++g) {
          double& penalty = result_.penalties(g, c, owner_[i]);
          penalty = least(penalty, i == firsts_[g] ? 0.0 : price_);
        }
      }
    }
  }

  // On trunk t: a pair of limbs, each in the other's place; false if a limb cannot reach it.
  bool fill_exchanged(Index t, Index c) {
    result_.trunks[t].copy_from(modes_[0]);
    result_.counts[t].fill(0);
    for (Index own : {c, limbs_.siblings[c]}) {
      const Index n =
          hang(own, lead_, modes_[0], limbs_.siblings[own], lead_, elsewhere_slack, angles_);
      if (n == 0) return false;
      write_limb(own, angles_[0], result_.trunks[t]);
      keep(t, own, lead_, modes_[0], n);
    }
    return true;
  }

  // On trunk t: the pose `flipped` (d,), with each limb on its rays.
  void fill_flipped(Index t, const Numbers& flipped) {
    result_.trunks[t].copy_from(flipped);
    place(flipped, moved_);
    for (Index c = 0; c < limbs_.size(); ++c) {
      Index n = hang(c, moved_, flipped, c, lead_, elsewhere_slack, angles_);
      if (n == 0) {
        read_limb(c, flipped, angles_[0]);
        n = 1;
      }
      write_limb(c, angles_[0], result_.trunks[t]);
      keep(t, c, moved_, flipped, n);
    }
  }

 private:
  // Frames of the segments of a pose.
  struct Placed {
    Scratch<double, 3> columns;
    Scratch<double, 2> origins;
    explicit Placed(Index segments) : columns(segments, 3, 3), origins(segments, 3) {}
  };

  const Placing& tree_;
  const Limbs& limbs_;
  Table modes_;
  Tables found_;
  Places found_counts_;
  double price_, apart_;
  const NewConfigurations& result_;
  const Index segments_ = tree_.segments(), d_ = tree_.dimension();
  const Index links_ = limbs_.segments.size(1), width_ = limbs_.width();
  const Index leaf_count_ = limbs_.most_leaves();
  const Index sources_ = modes_.size() + found_.size(1) + leaf_count_;  // maximum number for a limb
  Placed lead_{segments_}, moved_{segments_}, tried_{segments_};
  Scratch<double, 2> axes_{d_, 3}, dof_origins_{d_, 3};
  Scratch<double, 1> pose_{d_};
  Scratch<double, 2> ends_{links_, 3}, leaves_{leaf_count_, width_};
  Scratch<bool, 1> valid_{leaf_count_};
  TreeGrowth growth_{links_, width_};
  Scratch<double, 2> given_{sources_, width_};  // configurations without their flips
  Scratch<Index, 1> firsts_{sources_};          // index of each among all configurations
  Scratch<double, 2> angles_{sources_ * (1 + leaf_count_), width_};
  Scratch<double, 2> points_{angles_.size(), 3 * limbs_.joint_segments.size(1)};
  Scratch<Index, 1> kept_{angles_.size()}, owner_{angles_.size()};

  void place(const Numbers& pose, const Placed& placed) {
    place_pose(tree_, pose, placed.columns, placed.origins, axes_, dof_origins_);
  }

  void read_limb(Index c, const Numbers& pose, const Vector& angles) const {
    for (Index j = 0; j < limbs_.dofs[c]; ++j) angles[j] = pose[limbs_.own(c, j)];
  }

  void write_limb(Index c, const Numbers& angles, const Vector& pose) const {
    for (Index j = 0; j < limbs_.dofs[c]; ++j) pose[limbs_.own(c, j)] = angles[j];
  }

  // Gathers configurations of limb c without flips; returns their number.
  Index gather(Index c) {
    Index count = 0;
    for (Index g = 0; g < modes_.size(); ++g) read_limb(c, modes_[g], given_[count++]);
    for (Index i = 0; i < found_counts_[c]; ++i) given_[count++].copy_from(found_[c][i]);
    if (limbs_.siblings[c] >= 0) {
      count += hang(c, lead_, modes_[0], limbs_.siblings[c], lead_, elsewhere_slack,
                    given_.view().rows(count, sources_));
    }
    return count;
  }

  // Lists the gathered configurations of limb c, each followed by its flips; returns their number.
  Index flip_all(Index c, Index sources) {
    Index n = 0;
    for (Index i = 0; i < sources; ++i) {
      firsts_[i] = n;
      angles_[n++].copy_from(given_[i]);
      pose_.view().copy_from(modes_[0]);
      write_limb(c, given_[i], pose_);
      place(pose_, moved_);
      n += hang(c, moved_, pose_, c, moved_, 0.0, angles_.view().rows(n, angles_.size()));
    }
    return n;
  }

  // Writes the leaves of the tree of limb c on a trunk into rows (A, D) of out; returns their
  // number. The joints lie on the rays of the joints of limb `other` in the frames `seen`. Of
  // equivalent angles, those nearest to the pose (d,) are taken. With slack 0 the joints are those
  // of the pose, and the pose itself is left out.
  Index hang(Index c, const Placed& trunk, const Numbers& pose, Index other, const Placed& seen,
             double slack, const Matrix& out) {
    const ChainLinks chain = limbs_.chain(c);
    const Index d = chain.dofs.size();
    for (Index k = 0; k < chain.links(); ++k) {
      const Index s = limbs_.segments(other, k);
      for (int x = 0; x < 3; ++x) {
        ends_(k, x) = seen.origins(s, x) - limbs_.lengths(other, k) * seen.columns(s, 2, x);
      }
    }
    const Matrix leaves{leaves_.view().data, {chain.leaves(), d}};
    const auto valid = valid_.view().rows(0, chain.leaves());
    valid.fill(false);
    growth_.grow(chain, trunk.origins[chain.segments[0]].data, trunk.columns[chain.parent].data,
                 ends_, pose, slack, slack == 0.0, leaves, valid);
    Index n = 0;
    for (Index leaf = slack == 0.0; leaf < chain.leaves(); ++leaf) {
      if (valid[leaf]) std::copy_n(leaves[leaf].data, d, out[n++].data);
    }
    return n;
  }

  // Keeps the distinct ones of the first n configurations of limb c for trunk t, the trunk of a
  // pose (d,).
  void keep(Index t, Index c, const Placed& trunk, const Numbers& pose, Index n) {
    tried_.columns.view().copy_from(trunk.columns);
    tried_.origins.view().copy_from(trunk.origins);
    pose_.view().copy_from(pose);
    const Index joints = limbs_.joints[c];
    const Matrix points{points_.view().data, {n, 3 * joints}};
    for (Index i = 0; i < n; ++i) {
      write_limb(c, angles_[i], pose_);
      for (Index k = 0; k < limbs_.links[c]; ++k) {
        place_segment(tree_, limbs_.segments(c, k), pose_, tried_.columns, tried_.origins, axes_,
                      dof_origins_);
      }
      for (Index j = 0; j < joints; ++j) {
        const Index s = limbs_.joint_segments(c, j);
        const double *axes = tried_.columns[s].data, *offset = limbs_.joint_offsets[c][j].data;
        for (int x = 0; x < 3; ++x) {
          points(i, 3 * j + x) = axes[x] * offset[0] + axes[3 + x] * offset[1] +
                                 axes[6 + x] * offset[2] + tried_.origins(s, x);
        }
      }
    }
    const Matrix angles = result_.angles[t][c];
    const Index count = keep_distinct(points, apart_, angles.size(), kept_.view().rows(0, n),
                                      owner_.view().rows(0, n));
    for (Index i = 0; i < count; ++i) angles[i].copy_from(angles_[kept_[i]]);
    result_.counts(t, c) = count;
  }
};

// Fills the configurations of G modes (G, d), see `LimbProducts.of`: found (C, F, D) are further
// angles of the limbs, found_counts (C,) their numbers; flipped (M, d) are poses with other torsos.
// Trunks are left out from the end, so that at most `most` poses with one configuration remain, not
// counting the first trunk. Returns the number of trunks, and the number of trunks with exchanged
// limbs, which follow the first trunk.
inline std::tuple<Index, Index> fill_configurations(const Placing& tree, const Limbs& limbs,
                                                    const Table& modes, const Tables& found,
                                                    const Places& found_counts,
                                                    const Table& flipped, double price,
                                                    double apart, Index most,
                                                    const NewConfigurations& result) {
  const Index d = tree.dimension(), c = limbs.size(), segments = tree.segments();
  expect_shape("modes", modes, {-1, d});
  expect(modes.size() > 0, "modes", "at least one");
  expect_shape("found", found, {c, -1, limbs.width()});
  expect_shape("found_counts", found_counts, {c});
  expect_range("found_counts", found_counts, 0, found.size(1) + 1);
  expect_shape("flipped", flipped, {-1, d});
  expect_configurations("result", result, limbs, d);
  expect_shape("result.penalties", result.penalties, {modes.size(), c, -1});
  expect_range("limbs.segments", limbs.segments, 0, segments);
  expect_range("limbs.parents", limbs.parents, 0, segments);
  expect_range("limbs.joint_segments", limbs.joint_segments, 0, segments);
  Index trunks = 1 + flipped.size();
  for (Index i = 0; i < c; ++i) trunks += limbs.siblings[i] > i;
  expect(result.trunks.size() >= trunks, "result.trunks",
         "one for each exchange and each flip of a torso");
  ConfigurationFiller filler(tree, limbs, modes, found, found_counts, price, apart, result);
  Index left = std::max<Index>(most, 0);
  const auto fits = [&](Index t) {
    --left;
    for (Index count : result.counts[t]) left -= count;
    return left >= 0;
  };
  filler.fill_first();
  if (!fits(0)) return {1, 0};
  Index t = 1;
  for (Index i = 0; i < c; ++i) {
    if (limbs.siblings[i] <= i || !filler.fill_exchanged(t, i)) continue;
    if (!fits(t)) return {t, t - 1};
    ++t;
  }
  const Index exchanged = t - 1;
  for (Index f = 0; f < flipped.size(); ++f, ++t) {
    filler.fill_flipped(t, flipped[f]);
    if (!fits(t)) break;
  }
  return {t, exchanged};
}

// Fills poses (R, d) with each trunk, and with each configuration that differs from its trunk;
// returns their number. `rows` (R,) become the pose of each trunk, then of its configurations.
inline Index place_alone(const Limbs& limbs, const Configurations& found, const Matrix& poses,
                         const Array<Index, 1>& rows) {
  expect_configurations("found", found, limbs, poses.size(1));
  expect_shape("poses", poses, {poses_alone(found), -1});
  expect_shape("rows", rows, {poses.size()});
  Index row = 0, count = 0;
  for (Index t = 0; t < found.size(); ++t) {
    const Index trunk = count++;
    poses[trunk].copy_from(found.trunks[t]);
    rows[row++] = trunk;
    for (Index c = 0; c < limbs.size(); ++c) {
      for (Index i = 0; i < found.counts(t, c); ++i) {
        bool same = true;
        const Vector pose = poses[count];
        pose.copy_from(found.trunks[t]);
        for (Index j = 0; j < limbs.dofs[c]; ++j) {
          double& own = pose[limbs.own(c, j)];
          same &= own == found.angles(t, c, i, j);
          own = found.angles(t, c, i, j);
        }
        rows[row++] = same ? trunk : count++;
      }
    }
  }
  return count;
}

// Finds the choices of one entry per list with the smallest sums, in order. Lists are added one by
// one: each entry of a list has a position in the sorted previous sums, and the smallest total is
// taken next. Ties are broken by the order of the previous sums.
class LeastSums {
 public:
  LeastSums(Index lists, Index longest, Index limit)
      : sums_(limit), picks_(limit, lists), heads_(longest) {}

  // Fills sums (limit,) and picks (limit, C) from costs (C, A) of lists of these sizes (C,);
  // returns their number.
  Index find(const Table& costs, const Places& sizes, const Vector& sums,
             const Array<Index, 2>& picks) {
    Index n = 1;
    sums[0] = 0.0;
    for (Index c = 0; c < sizes.size(); ++c) {
      std::copy_n(sums.data, n, sums_.view().data);
      for (Index k = 0; k < n; ++k) std::copy_n(picks[k].data, c, picks_[k].data);
      std::fill_n(heads_.view().data, sizes[c], 0);
      const Index more = std::min(sums.size(), n * sizes[c]);
      for (Index k = 0; k < more; ++k) {
        const Index best = least_head(costs[c].data, sizes[c], n);
        sums[k] = sums_[heads_[best]] + costs(c, best);
        std::copy_n(picks_[heads_[best]].data, c, picks[k].data);
        picks(k, c) = best;
        ++heads_[best];
      }
      n = more;
    }
    return n;
  }

 private:
  // Sums and picks of the previous lists, and the position of each entry of a list among them.
  Scratch<double, 1> sums_;
  Scratch<Index, 2> picks_;
  Scratch<Index, 1> heads_;

  Index least_head(const double* costs, Index size, Index n) const {
    const double* sums = sums_.view().data;
    const Index* heads = heads_.view().data;
    Index best = -1;
    double least = infinity;
    for (Index a = 0; a < size; ++a) {
      if (heads[a] == n) continue;
      const double total = sums[heads[a]] + costs[a];
      if (best < 0 || total < least || (total == least && heads[a] < heads[best])) {
        best = a;
        least = total;
      }
    }
    return best;
  }
};

// The best products of configurations on each trunk.
class Combiner {
 public:
  Combiner(const Limbs& limbs, const Table& modes, const Configurations& found,
           const Numbers& energies, double share, Index count)
      : limbs_(limbs), modes_(modes), found_(found), share_(share), count_(count) {
    Index row = 0;
    for (Index t = 0; t < found.size(); ++t) {
      bases_[t] = energies[row++];
      for (Index c = 0; c < limbs.size(); ++c) {
        const bool own = found.counts(t, c) > 0;
        for (Index i = 0; i < found.counts(t, c); ++i) {
          changes_(t, c, i) = energies[row++] - bases_[t];
        }
        counts_(t, c) = own ? found.counts(t, c) : counts_(0, c);
        origin_(t, c) = own ? t : 0;
      }
    }
  }

  // Finds the best products on trunk t for mode g of the given log weight.
  void find(Index t, Index g, double log_weight) {
    for (Index c = 0; c < limbs_.size(); ++c) {
      const Index at = origin_(t, c);
      for (Index i = 0; i < counts_(t, c); ++i) {
        const double penalty = at == 0 ? found_.penalties(g, c, i) : 0.0;
        costs_(c, i) = share_ * changes_(at, c, i) + penalty;
      }
    }
    sizes_[g] = least_sums_.find(costs_, counts_[t], sums_[g], picks_[g]);
    for (Index i = 0; i < sizes_[g]; ++i) sums_(g, i) -= log_weight;
  }

  // Merges the products of the first modes on trunk t into the rows of poses, parents and values;
  // returns their number. If several modes have the same product, the best one is its parent.
  Index merge(Index t, Index modes, const Matrix& poses, const Array<Index, 1>& parents,
              const Vector& values) {
    heads_.fill(0);
    Index n = 0;
    for (Index g; n < count_ && (g = best_mode(modes)) >= 0;) {
      const Array<Index, 1> pick = picks_[g][heads_[g]++];
      if (is_taken(pick, n)) continue;
      taken_[n].copy_from(pick);
      parents[n] = g;
      poses[n].copy_from(t == 0 ? modes_[g] : found_.trunks[t]);
      values[n] = bases_[t];
      for (Index c = 0; c < limbs_.size(); ++c) {
        const Index at = origin_(t, c), i = pick[c];
        values[n] += changes_(at, c, i);
        for (Index j = 0; j < limbs_.dofs[c]; ++j) {
          poses(n, limbs_.own(c, j)) = found_.angles(at, c, i, j);
        }
      }
      ++n;
    }
    return n;
  }

 private:
  const Limbs& limbs_;
  Table modes_;
  const Configurations& found_;
  double share_;
  Index count_;
  const Index trunks_ = found_.size(), limit_ = limbs_.size(), most_ = found_.most();
  Scratch<double, 1> bases_{trunks_};                   // energies of the trunks
  Scratch<double, 3> changes_{trunks_, limit_, most_};  // energy change by each configuration
  // Numbers of configurations, and the trunk that has them.
  Scratch<Index, 2> counts_{trunks_, limit_}, origin_{trunks_, limit_};
  Scratch<double, 2> costs_{limit_, most_};
  // Products of each mode, and the first that is not taken yet.
  Scratch<double, 2> sums_{modes_.size(), count_};
  Scratch<Index, 3> picks_{modes_.size(), count_, limit_};
  Scratch<Index, 1> sizes_{modes_.size()}, heads_{modes_.size()};
  Scratch<Index, 2> taken_{count_, limit_};
  LeastSums least_sums_{limit_, most_, count_};

  // The mode whose next product is the best; -1 if none is left.
  Index best_mode(Index modes) const {
    Index best = -1;
    for (Index g = 0; g < modes; ++g) {
      if (heads_[g] < sizes_[g] && (best < 0 || sums_(g, heads_[g]) < sums_(best, heads_[best]))) {
        best = g;
      }
    }
    return best;
  }

  bool is_taken(const Array<Index, 1>& pick, Index n) const {
    for (Index i = 0; i < n; ++i) {
      if (std::equal(pick.begin(), pick.end(), taken_[i].begin())) return true;
    }
    return false;
  }
};

// Fills poses (T count, d), parents and values (T count,) with the best products on each trunk, see
// `LimbProducts.best`; returns their number. Energies (R,) belong to poses with at most one
// configuration, log_weights (G,) to the modes (G, d). The first trunk is followed by `exchanged`
// trunks, at one price, and then by trunks with other torsos, at another price.
inline Index combine(const Limbs& limbs, const Table& modes, const Configurations& found,
                     const Numbers& energies, const Numbers& log_weights, Index exchanged,
                     double exchange, double flip, double share, Index count, const Matrix& poses,
                     const Array<Index, 1>& parents, const Vector& values) {
  const Index group = modes.size(), d = modes.size(1), trunks = found.size();
  expect(group > 0, "modes", "at least one");
  expect(count > 0 && count <= values.size(), "count", "at least one, and a row for each");
  expect_configurations("found", found, limbs, d);
  expect_shape("found.penalties", found.penalties, {group, -1, -1});
  expect_shape("energies", energies, {poses_alone(found)});
  expect_shape("log_weights", log_weights, {group});
  expect_shape("poses", poses, {trunks * count, d});
  expect_shape("parents", parents, {trunks * count});
  expect_shape("values", values, {trunks * count});
  Combiner combiner(limbs, modes, found, energies, share, count);
  const Scratch<double, 1> weights(group);
  weights.view().copy_from(log_weights);
  const double all = log_sum_exp(weights.view().data, group);
  Index n = 0;
  for (Index t = 0; t < trunks; ++t) {
    const Index own = t == 0 ? group : 1;
    for (Index g = 0; g < own; ++g) {
      combiner.find(t, g, t == 0 ? log_weights[g] : all - (t <= exchanged ? exchange : flip));
    }
    n += combiner.merge(t, own, poses.rows(n, n + count), parents.rows(n, n + count),
                        values.rows(n, n + count));
  }
  return n;
}

}  // namespace hmt
