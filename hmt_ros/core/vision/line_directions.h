// Likelihoods of straight lines for frames of directions; see hmt_ros/image/vertical_lines.py.
#pragma once

#include <numbers>

#include "../arrays.h"
#include "../elementary.h"
#include "../lanes.h"

namespace hmt {

// Number of deviations beyond which the density of an angle is negligible compared to 1.
inline constexpr double farthest_angle = 9.0;
// Squared sine of the minimum angle between a direction and the ray to a line that is used.
inline constexpr double least_across = 1e-4;

// N lines, a vector for each coordinate: normals of planes through the camera, and rays (3, N).
struct LineVectors {
  Scratch<double, 2> normals, middles;
  Numbers deviations;  // (N,) of their angles, rad

  LineVectors(const Table& normal, const Table& middle, const Numbers& deviation)
      : normals(3, normal.size()), middles(3, normal.size()), deviations(deviation) {
    for (Index i = 0; i < normal.size(); ++i) {
      for (int k = 0; k < 3; ++k) {
        normals(k, i) = normal(i, k);
        middles(k, i) = middle(i, k);
      }
    }
  }
};

// The cosines (N,) of the angles of lines to the normal of a direction (3,), and the squares of the
// sines of those to the direction itself.
HMT_WIDE inline void turn_lines(const LineVectors& lines, const double* direction,
                                double* __restrict cosines, double* __restrict squares) {
  const double x = direction[0], y = direction[1], z = direction[2];
  const double *a = lines.normals[0].data, *b = lines.normals[1].data, *c = lines.normals[2].data;
  const double *d = lines.middles[0].data, *e = lines.middles[1].data, *f = lines.middles[2].data;
  for (Index i = 0; i < lines.deviations.size(); ++i) {
    const double along = x * d[i] + y * e[i] + z * f[i], rest = 1.0 - along * along;
    cosines[i] = elementary::absolute(x * a[i] + y * b[i] + z * c[i]);
    squares[i] = rest > least_across ? rest : least_across;
  }
}

// Densities of angles, which replace their sines.
HMT_WIDE inline void fill_densities(const double* deviations, double* angles, Index count) {
  const double root = std::sqrt(std::numbers::pi / 2.0);
  for (Index i = 0; i < count; ++i) {
    const double sine = angles[i] < 1.0 ? angles[i] : 1.0;
    const double off = elementary::asin(sine) / deviations[i];
    angles[i] = root / deviations[i] * elementary::exp(-0.5 * (off * off));
  }
}

// Densities (D, N), relative to uniform, of the angles of lines with deviations (N,) if the lines
// had the directions (D, 3).
inline void rate_lines(const Table& directions, const Table& normals, const Table& middles,
                       const Numbers& deviations, const Matrix& result) {
  const Index n = deviations.size();
  expect_shape("directions", directions, {-1, 3});
  expect_shape("normals", normals, {n, 3});
  expect_shape("middles", middles, {n, 3});
  expect_shape("result", result, {directions.size(), n});
  const LineVectors lines(normals, middles, deviations);
  Scratch<double, 1> cosines(n), squares(n), own(n), angles(n);
  std::vector<Index> near(n);
  for (Index k = 0; k < directions.size(); ++k) {
    turn_lines(lines, directions[k].data, cosines.view().data, squares.view().data);
    Index count = 0;
    for (Index i = 0; i < n; ++i) {
      const double farthest = farthest_angle * deviations[i];
      if (cosines[i] * cosines[i] > farthest * farthest * squares[i]) continue;
      near[count] = i;
      own[count] = deviations[i];
      angles[count++] = cosines[i] / std::sqrt(squares[i]);
    }
    fill_densities(own.view().data, angles.view().data, count);
    result[k].fill(0.0);
    for (Index j = 0; j < count; ++j) result(k, near[j]) = angles[j];
  }
}

// Log likelihoods (F, A) of frames, each of a vertical and one of A pairs of other directions among
// D: a share of the lines follows each direction, with densities (D, N), and the rest is uniform.
inline void rate_frames(const Table& densities, const Places& vertical,
                        const Array<const Index, 2>& first, const Array<const Index, 2>& second,
                        double share, const Matrix& result) {
  constexpr Index together = 128;  // number of lines whose product stays finite
  const Index d = densities.size(), n = densities.size(1), frames = vertical.size();
  const Index padded = (n + group_size - 1) / group_size * group_size;
  expect_range("vertical", vertical, 0, d);
  expect_range("first", first, 0, d);
  expect_range("second", second, 0, d);
  expect_shape("first", first, {frames, -1});
  expect_shape("second", second, {frames, first.size(1)});
  expect_shape("result", result, {frames, first.size(1)});
  // Each direction has a third of the share; missing lines have a likelihood of 1.
  Scratch<double, 2> parts(d, padded);
  for (Index k = 0; k < d; ++k) {
    for (Index i = 0; i < padded; ++i) parts(k, i) = share / 3.0 * (i < n ? densities(k, i) : 1.0);
  }
  for (Index k = 0; k < frames; ++k) {
    const double* up = parts[vertical[k]].data;
    for (Index m = 0; m < first.size(1); ++m) {
      const double *a = parts[first(k, m)].data, *b = parts[second(k, m)].data;
      double sum = 0.0;
      for (Index start = 0; start < padded; start += together) {
        double products[group_size] = {1.0, 1.0, 1.0, 1.0};
        for (Index i = start; i < std::min(start + together, padded); i += group_size) {
          for (Index j = 0; j < group_size; ++j) {
            products[j] *= 1.0 - share + up[i + j] + (a[i + j] + b[i + j]);
          }
        }
        sum += elementary::log(products[0] * products[1] * (products[2] * products[3]));
      }
      result(k, m) = sum;
    }
  }
}

}  // namespace hmt
