// States of modes: predicted with damped velocities and conditioned on fitted poses, and
// covariances of jumps; equations in hmt_ros/inference/motion_states.py and damped_velocity.py.
#pragma once

#include "../arrays.h"
#include "../small_matrix.h"

namespace hmt {

namespace matrices {

// Equal blocks of n columns side by side, each padded, for `factorise` and `solve_upper`.
class Blocks {
 public:
  Blocks(Index rows, std::initializer_list<Index> columns) : starts_{0} {
    for (Index count : columns) starts_.push_back(starts_.back() + in_whole_lanes(count));
    numbers_ = std::make_unique<double[]>(rows * starts_.back());
  }
  Rows rows() const { return {numbers_.get(), starts_.back()}; }
  Index start(int block) const { return starts_[block]; }
  double* row(int block, Index i) const { return rows()[i] + starts_[block]; }
  Strided<double> matrix(int block) const { return view(block, false); }
  Strided<double> transposed(int block) const { return view(block, true); }

 private:
  Strided<double> view(int block, bool turned) const {
    const Index down = starts_.back() * Index(sizeof(double)), right = sizeof(double);
    char* data = reinterpret_cast<char*>(row(block, 0));
    return turned ? Strided<double>{data, right, down} : Strided<double>{data, down, right};
  }
  std::vector<Index> starts_;
  std::unique_ptr<double[]> numbers_;
};

inline Strided<double> rows_of(double* data, Index columns) {
  return {reinterpret_cast<char*>(data), columns * Index(sizeof(double)), sizeof(double)};
}
inline void expect_factor(bool good, const char* name) {
  expect(good, name, "a positive definite covariance of poses");
}

}  // namespace matrices

// Predicts K states (K, 2 d) with their covariances: x + a v and b v, with a, b (d,) and the noise
// (2 d, 2 d).
inline void predict_damped(const Numbers& a, const Numbers& b, const Table& noise,
                           const Table& means, const Tables& covariances, const Matrix& moved,
                           const Tensor& result) {
  const Index d = a.size(), n = 2 * d, count = means.size();
  expect_shape("b", b, {d});
  expect_shape("noise", noise, {n, n});
  expect_shape("means", means, {count, n});
  expect_shape("covariances", covariances, {count, n, n});
  expect_shape("moved", moved, {count, n});
  expect_shape("result", result, {count, n, n});
  for (Index k = 0; k < count; ++k) {
    const Table known = covariances[k];
    const Matrix spread = result[k];
    for (Index i = 0; i < d; ++i) {
      moved(k, i) = means(k, i) + a[i] * means(k, d + i);
      moved(k, d + i) = b[i] * means(k, d + i);
      for (Index j = 0; j < d; ++j) {
        const double carried = known(i, d + j) + a[i] * known(d + i, d + j);
        spread(i, d + j) = carried * b[j];
        spread(d + j, i) = carried * b[j];
        spread(d + i, d + j) = b[i] * b[j] * known(d + i, d + j);
        // The mirrored iteration sets the transposed half.
        spread(j, i) = carried * a[j];
      }
    }
    for (Index i = 0; i < d; ++i) {
      for (Index j = 0; j < d; ++j) spread(i, j) += known(i, j) + known(i, d + j) * a[j];
    }
    for (Index i = 0; i < n * n; ++i) spread.data[i] += noise.data[i];
  }
}

// Fills the inverses (N, d, d) of the ancestors' covariances with `wandered` (d,) added to
// variables that jumped, from the inverses (K, d, d) of the ancestors' covariances:
//
//     (C + W)^-1 = P - P S (I + S P S)^-1 S P,    W = S S, over the variables that jumped
inline void widen_precisions(const Tables& precisions, const Places& ancestors,
                             const Array<const bool, 2>& jumped, const Numbers& wandered,
                             const Tensor& result) {
  using namespace matrices;
  const Index count = ancestors.size(), d = wandered.size();
  expect_shape("precisions", precisions, {-1, d, d});
  expect_range("ancestors", ancestors, 0, precisions.size());
  expect_shape("jumped", jumped, {count, d});
  expect_shape("result", result, {count, d, d});
  const Scratch<double, 1> room((d + 1) * lanes);
  const Scratch<double, 2> loss(d, d);
  std::vector<Index> rows;
  for (Index n = 0; n < count; ++n) {
    const Table own = precisions[ancestors[n]];
    const Matrix to = result[n];
    to.copy_from(own);
    rows.clear();
    for (Index j = 0; j < d; ++j) {
      if (jumped(n, j) && wandered[j] > 0.0) rows.push_back(j);
    }
    const Index m = Index(rows.size());
    if (m == 0) continue;
    const Blocks blocks(m, {m, d});
    for (Index i = 0; i < m; ++i) {
      const double sigma = std::sqrt(wandered[rows[i]]);
      for (Index j = 0; j < m; ++j) {
        blocks.row(0, i)[j] =
            sigma * own(rows[i], rows[j]) * std::sqrt(wandered[rows[j]]) + (i == j ? 1.0 : 0.0);
      }
      for (Index j = 0; j < d; ++j) blocks.row(1, i)[j] = sigma * own(rows[i], j);
    }
    expect_factor(factorise(blocks.rows(), m), "precisions");
    multiply(blocks.transposed(1), blocks.matrix(1), rows_of(loss[0].data, d), d, m, d,
             room.view().data);
    for (Index i = 0; i < d * d; ++i) to.data[i] -= loss.view().data[i];
  }
}

// Fills the covariances a - a (a + b)^-1 a (N, d, d) of products of Gaussians.
inline void fuse(const Tables& a, const Tables& b, const Tensor& result) {
  using namespace matrices;
  const Index d = a.size(1);
  expect_shape("a", a, {-1, d, d});
  expect_shape("b", b, {a.size(), d, d});
  expect_shape("result", result, {a.size(), d, d});
  const Scratch<double, 1> room((d + 1) * lanes);
  const Scratch<double, 2> loss(d, d);
  const Blocks blocks(d, {d, d});
  for (Index n = 0; n < a.size(); ++n) {
    for (Index i = 0; i < d; ++i) {
      for (Index j = 0; j < d; ++j) {
        blocks.row(0, i)[j] = a(n, i, j) + b(n, i, j);
        blocks.row(1, i)[j] = a(n, i, j);
      }
    }
    expect_factor(factorise(blocks.rows(), d), "a");
    multiply(blocks.transposed(1), blocks.matrix(1), rows_of(loss[0].data, d), d, d, d,
             room.view().data);
    for (Index i = 0; i < d; ++i) {
      for (Index j = 0; j < d; ++j) {
        result(n, i, j) = 0.5 * (a(n, i, j) + a(n, j, i)) - loss(i, j);
      }
    }
  }
}

// Predicted states of K modes, as input of the next function.
struct Predicted {
  Table means;         // (K, 2 d)
  Tables covariances;  // (K, 2 d, 2 d)
  double unknown_variance;
  Table unknown_velocity;  // (d, d)
};

// Fills the velocities (N, d) and covariances (N, 2 d, 2 d) of states, given their poses (N, d)
// with covariances (N, d, d).
inline void correct_states(const Predicted& predicted, const Places& ancestors,
                           const Array<const bool, 2>& jumped, const Table& poses,
                           const Tables& found, const Matrix& velocities, const Tensor& result) {
  using namespace matrices;
  const Index count = poses.size(), d = poses.size(1), modes = predicted.means.size();
  expect_shape("predicted.means", predicted.means, {-1, 2 * d});
  expect_shape("predicted.covariances", predicted.covariances, {modes, 2 * d, 2 * d});
  expect_shape("predicted.unknown_velocity", predicted.unknown_velocity, {d, d});
  expect_shape("ancestors", ancestors, {count});
  expect_range("ancestors", ancestors, 0, modes);
  expect_shape("jumped", jumped, {count, d});
  expect_shape("found", found, {count, d, d});
  expect_shape("velocities", velocities, {count, d});
  expect_shape("result", result, {count, 2 * d, 2 * d});
  const Scratch<double, 1> room((d + 1) * lanes), offset(d);
  const Scratch<double, 2> loss(d, d), together(d, d), gain(d, d);
  const Blocks blocks(d, {d, d});
  for (Index n = 0; n < count; ++n) {
    const Table known = predicted.covariances[ancestors[n]];
    const Numbers mean = predicted.means[ancestors[n]];
    const bool* fresh = jumped[n].data;
    for (Index i = 0; i < d; ++i) {
      offset[i] = poses(n, i) - mean[i];
      std::copy_n(&known(i, 0), d, blocks.row(0, i));
      std::copy_n(&known(i, d), d, blocks.row(1, i));
      if (fresh[i]) blocks.row(0, i)[i] += predicted.unknown_variance;
    }
    // With P_xx = U' U the block to its right becomes Y = U'^-1 P_xv, so that G P_xv = Y' Y; then
    // G'.
    expect_factor(factorise(blocks.rows(), d), "predicted.covariances");
    multiply(blocks.transposed(1), blocks.matrix(1), rows_of(loss[0].data, d), d, d, d,
             room.view().data);
    solve_upper(blocks.rows(), d, blocks.start(1));
    multiply(blocks.transposed(1), rows_of(const_cast<double*>(found[n].data), d),
             rows_of(together[0].data, d), d, d, d, room.view().data);
    multiply(rows_of(together[0].data, d), blocks.matrix(1), rows_of(gain[0].data, d), d, d, d,
             room.view().data);
    const Matrix to = result[n];
    for (Index i = 0; i < d; ++i) {
      double moved = 0.0;
      for (Index j = 0; j < d; ++j) moved += blocks.row(1, j)[i] * offset[j];
      velocities(n, i) = fresh[i] ? 0.0 : mean[d + i] + moved;
      for (Index j = 0; j < d; ++j) {
        to(i, j) = found(n, i, j);
        to(d + i, j) = to(j, d + i) = fresh[i] ? 0.0 : together(i, j);
        // An unknown velocity is not correlated with others.
        if (fresh[i] || fresh[j]) {
          to(d + i, d + j) = fresh[i] && fresh[j] ? predicted.unknown_velocity(i, j) : 0.0;
        } else {
          to(d + i, d + j) = 0.5 * (known(d + i, d + j) + known(d + j, d + i)) - loss(i, j) +
                             0.5 * (gain(i, j) + gain(j, i));
        }
      }
    }
  }
}

}  // namespace hmt
