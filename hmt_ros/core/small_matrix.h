// Linear algebra of matrices with up to a few hundred rows, with identical results on every
// processor.
//
// BLAS and LAPACK select kernels by processor, which sum in different orders. Here every sum has a
// fixed order; vectors run across columns, that is, across sums, so their width does not change
// results.
#pragma once

#include "arrays.h"
#include "elementary.h"
#include "lanes.h"
#include "wide.h"

namespace hmt::matrices {

HMT_INLINE Group<double>& group(double* row) { return *reinterpret_cast<Group<double>*>(row); }

// Rows of numbers; their stride is a multiple of `group_size`.
struct Rows {
  double* data;
  Index stride;
  HMT_INLINE double* operator[](Index i) const { return data + i * stride; }
};

HMT_INLINE void subtract(double* row, double factor, double* other, Index first, Index last) {
  for (Index b = first; b < last; b += group_size) group(row + b) -= factor * group(other + b);
}
HMT_INLINE void divide(double* row, double divisor, Index first, Index last) {
  for (Index b = first; b < last; b += group_size) group(row + b) /= divisor;
}

// Stride of rows of whole lanes.
HMT_WIDE inline double distance(const double* one, const double* other, Index width) {
  double sums[lanes] = {};
  for (Index i = 0; i < width; i += lanes) {
#pragma omp simd
    for (int k = 0; k < lanes; ++k) sums[k] += square(one[i + k] - other[i + k]);
  }
  return std::sqrt(sum_lanes(sums));
}

// Cholesky factorisation in place, to rows of the upper factor; only entries on or right of the
// diagonal are read, and valid afterwards. False if the matrix is not positive definite.
bool factorise(Rows u, Index n);

// Gaussian elimination with partial pivoting of (n, n) and of the columns right of it, in place.
// Returns the sign of the permutation, or 0 for a singular matrix.
double eliminate(Rows u, Index n);

// Solves for the columns from `first` on, in place: upper triangle, or lower triangle of rows.
void solve_upper(Rows u, Index n, Index first);
void solve_lower(Rows l, Index n, Index first);

// Inverts a positive definite matrix in place; only entries on or right of the diagonal are read,
// and `room` has the same size. Sets the log determinant of the matrix. If the matrix is not
// positive definite, returns false, and entries are undefined.
HMT_WIDE inline bool invert_positive(Rows u, Index n, Rows room, double& log_determinant) {
  log_determinant = 0.0;
  for (Index a = 0; a < n; ++a) {
    std::fill_n(room[a], u.stride, 0.0);
    room[a][a] = 1.0;
  }
  // The upper factor in u, and the inverse of its transpose, a lower triangle, in the room.
  for (Index a = 0; a < n; ++a) {
    double *row = u[a], *own = room[a];
    if (!(row[a] > 0.0)) return false;
    log_determinant += elementary::log(row[a]);
    const double root = std::sqrt(row[a]);
    const Index filled = in_whole_lanes(a + 1);
    divide(row, root, a / group_size * group_size, u.stride);
    divide(own, root, 0, filled);
    for (Index c = a + 1; c < n; ++c) {
      subtract(room[c], row[c], own, 0, filled);
      subtract(u[c], row[c], row, c / group_size * group_size, u.stride);
    }
  }
  for (Index a = 0; a < n; ++a) {
    double* row = u[a];
    std::fill_n(row, u.stride, 0.0);
    for (Index k = a; k < n; ++k) subtract(row, -room[k][a], room[k], 0, in_whole_lanes(a + 1));
    for (Index c = 0; c < a; ++c) u[c][a] = row[c];
  }
  return true;
}

// Rotates two rows by an angle.
HMT_INLINE void rotate(double* p, double* q, double cosine, double sine, Index width) {
  for (Index b = 0; b < width; b += group_size) {
    const Group<double> old = group(p + b);
    group(p + b) = cosine * old - sine * group(q + b);
    group(q + b) = sine * old + cosine * group(q + b);
  }
}

inline constexpr int most_sweeps = 60;

// Reduces a symmetric matrix by reflections to tridiagonal form: diagonal and off-diagonal. Row k
// stores reflection k right of its diagonal, `scales` its factor; `work` has room for a row.
HMT_WIDE inline void make_tridiagonal(Rows a, Index n, double* diagonal, double* beside,
                                      double* scales, double* work) {
  for (Index k = 0; k + 1 < n; ++k) {
    double* v = a[k];
    const Index first = (k + 1) / group_size * group_size;
    diagonal[k] = v[k];
    std::fill(v + first, v + k + 1, 0.0);
    const double square = dot(v + first, v + first, a.stride - first);
    const double length = v[k + 1] > 0.0 ? -std::sqrt(square) : std::sqrt(square);
    const double own = v[k + 1] * length;
    beside[k] = length;
    scales[k] = square > 0.0 ? 1.0 / (square - own) : 0.0;
    if (!(square > 0.0)) continue;
    v[k + 1] -= length;
    std::fill(work + first, work + a.stride, 0.0);
    for (Index j = k + 1; j < n; ++j) subtract(work, -scales[k] * v[j], a[j], first, a.stride);
    std::fill(work + first, work + k + 1, 0.0);
    const double share = 0.5 * scales[k] * dot(work + first, v + first, a.stride - first);
    subtract(work, share, v, first, a.stride);
    for (Index j = k + 1; j < n; ++j) {
      subtract(a[j], v[j], work, first, a.stride);
      subtract(a[j], work[j], v, first, a.stride);
    }
  }
  diagonal[n - 1] = a[n - 1][n - 1];
  beside[n - 1] = 0.0;
}

// Rows of the product of the reflections of `make_tridiagonal`.
HMT_WIDE inline void multiply_reflections(Rows a, Index n, const double* scales, Rows result,
                                          double* work) {
  for (Index k = n - 2; k >= 0; --k) {
    const double* v = a[k];
    std::fill(work, work + a.stride, 0.0);
    for (Index j = k + 1; j < n; ++j) subtract(work, -scales[k] * v[j], result[j], 0, a.stride);
    for (Index j = k + 1; j < n; ++j) subtract(result[j], v[j], work, 0, a.stride);
  }
}

// Eigenvalues of a symmetric tridiagonal matrix by the QL method with implicit shifts; they replace
// the diagonal, unsorted. The rotations are applied to the rows of `vectors`, if there are any.
// False if the iteration does not converge.
HMT_WIDE inline bool diagonalise(double* diagonal, double* beside, Index n, Rows vectors) {
  for (Index first = 0; first < n; ++first) {
    for (int sweep = 0;; ++sweep) {
      Index last = first;  // last row of the block that cannot be split
      while (last + 1 < n &&
             !(std::abs(beside[last]) <=
               0x1p-53 * (std::abs(diagonal[last]) + std::abs(diagonal[last + 1])))) {
        ++last;
      }
      if (last == first) break;
      if (sweep == most_sweeps) return false;
      const double half = (diagonal[first + 1] - diagonal[first]) / (2.0 * beside[first]);
      const double root = std::sqrt(half * half + 1.0);
      double g =
          diagonal[last] - diagonal[first] + beside[first] / (half + (half < 0.0 ? -root : root));
      double sine = 1.0, cosine = 1.0, moved = 0.0;
      Index i = last - 1;
      for (; i >= first; --i) {
        const double f = sine * beside[i], b = cosine * beside[i], r = std::sqrt(f * f + g * g);
        beside[i + 1] = r;
        if (r == 0.0) {
          diagonal[i + 1] -= moved;
          beside[last] = 0.0;
          break;
        }
        sine = f / r;
        cosine = g / r;
        g = diagonal[i + 1] - moved;
        const double step = (diagonal[i] - g) * sine + 2.0 * cosine * b;
        moved = sine * step;
        diagonal[i + 1] = g + moved;
        g = cosine * step - b;
        if (vectors.data) rotate(vectors[i], vectors[i + 1], cosine, sine, vectors.stride);
      }
      if (i >= first) continue;
      diagonal[first] -= moved;
      beside[first] = g;
      beside[last] = 0.0;
    }
  }
  return true;
}

// Makes columns orthogonal by rotations (one-sided Jacobi); the largest should be near 1. The
// columns are rows of `columns`; the same rotations are applied to rows of `turns`, initially the
// identity. False if the iteration does not converge.
HMT_WIDE inline bool orthogonalise(Rows columns, Rows turns, Index count) {
  for (int sweep = 0; sweep < most_sweeps; ++sweep) {
    bool turned = false;
    for (Index p = 0; p < count; ++p) {
      for (Index q = p + 1; q < count; ++q) {
        const double own = dot(columns[p], columns[p], columns.stride);
        const double others = dot(columns[q], columns[q], columns.stride);
        const double x = dot(columns[p], columns[q], columns.stride);
        const double small = 0x1p-49 * std::sqrt(own) * std::sqrt(others);
        if (!(std::abs(x) > most(small, 0x1p-110))) continue;
        turned = true;
        // The smaller angle that makes [[own, x], [x, others]] diagonal.
        const double ratio = (others - own) / (2.0 * x);
        const double root = std::sqrt(ratio * ratio + 1.0);
        const double tangent = 1.0 / (ratio + (ratio < 0.0 ? -root : root));
        const double cosine = 1.0 / std::sqrt(tangent * tangent + 1.0);
        rotate(columns[p], columns[q], cosine, tangent * cosine, columns.stride);
        rotate(turns[p], turns[q], cosine, tangent * cosine, turns.stride);
      }
    }
    if (!turned) return true;
  }
  return false;
}

// The power of two that scales numbers up to this size to near 1, so that squares neither overflow
// nor vanish.
inline double scale_of(double largest) {
  int exponent = 0;
  std::frexp(largest, &exponent);
  return std::ldexp(1.0, std::clamp(-exponent, -1000, 1000));
}

// A matrix of numpy: strides in bytes.
template <class T>
struct Strided {
  char* data;
  Index row, column;
  HMT_INLINE T& operator()(Index i, Index j) const {
    return *reinterpret_cast<T*>(data + i * row + j * column);
  }
};

// Matrix product (m, inner) (inner, n); `room` for inner pairs of groups. A single column is summed
// as by `dot`.
void multiply(Strided<double> a, Strided<double> b, Strided<double> result, Index m, Index inner,
              Index n, double* room);
void multiply(Strided<float> a, Strided<float> b, Strided<float> result, Index m, Index inner,
              Index n, float* room);

}  // namespace hmt::matrices
