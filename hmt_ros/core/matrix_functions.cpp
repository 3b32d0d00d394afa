// The linear algebra as generalised ufuncs; hmt_ros/inference/linear_algebra.py calls them.
//
// If a matrix has no result, they fill it with NaN and report an invalid operation to numpy.
#include "array_functions.h"
#include "log_sum_exp.h"
#include "small_matrix.h"
#include "ufunc.h"

namespace hmt::matrices {

HMT_WIDE bool factorise(Rows u, Index n) {
  for (Index a = 0; a < n; ++a) {
    double* row = u[a];
    if (!(row[a] > 0.0)) return false;
    divide(row, std::sqrt(row[a]), a / group_size * group_size, u.stride);
    for (Index c = a + 1; c < n; ++c)
      subtract(u[c], row[c], row, c / group_size * group_size, u.stride);
  }
  return true;
}

HMT_WIDE double eliminate(Rows u, Index n) {
  double sign = 1.0;
  for (Index j = 0; j < n; ++j) {
    Index largest = j;
    for (Index i = j + 1; i < n; ++i) {
      if (std::abs(u[i][j]) > std::abs(u[largest][j])) largest = i;
    }
    double* row = u[j];
    const Index first = j / group_size * group_size;
    if (largest != j) {
      sign = -sign;
      for (Index b = first; b < u.stride; b += group_size) {
        const Group<double> other = group(row + b);
        group(row + b) = group(u[largest] + b);
        group(u[largest] + b) = other;
      }
    }
    if (row[j] == 0.0) return 0.0;
    for (Index i = j + 1; i < n; ++i) {
      if (u[i][j] != 0.0) subtract(u[i], u[i][j] / row[j], row, first, u.stride);
    }
  }
  return sign;
}

HMT_WIDE void solve_upper(Rows u, Index n, Index first) {
  for (Index i = n - 1; i >= 0; --i) {
    for (Index j = i + 1; j < n; ++j) subtract(u[i], u[i][j], u[j], first, u.stride);
    divide(u[i], u[i][i], first, u.stride);
  }
}

HMT_WIDE void solve_lower(Rows l, Index n, Index first) {
  for (Index i = 0; i < n; ++i) {
    for (Index j = 0; j < i; ++j) subtract(l[i], l[i][j], l[j], first, l.stride);
    divide(l[i], l[i][i], first, l.stride);
  }
}

// R rows and G groups of columns of a product: sums run along `inner` in order.
template <class T, int R, int G>
HMT_INLINE void multiply_rows(Strided<T> a, Index first, const T* b, Index b_stride, Index inner,
                              Strided<T> result, Index column, Index columns) {
  constexpr Index count = Lanes<T>::count;
  Group<T> sums[R][G] = {};
  for (Index k = 0; k < inner; ++k) {
    for (int c = 0; c < G; ++c) {
      const auto right = *reinterpret_cast<const Group<T>*>(b + k * b_stride + c * count);
      for (int r = 0; r < R; ++r) sums[r][c] += a(first + r, k) * right;
    }
  }
  for (int r = 0; r < R; ++r) {
    for (int c = 0; c < G; ++c) {
      T each[count];
      *reinterpret_cast<Group<T>*>(each) = sums[r][c];
      const Index start = column + c * count, wanted = std::min(count, columns - c * count);
      for (Index j = 0; j < wanted; ++j) result(first + r, start + j) = each[j];
    }
  }
}
template <class T, int G>
HMT_INLINE void multiply_columns(Strided<T> a, const T* b, Index b_stride, Index m, Index inner,
                                 Strided<T> result, Index column, Index columns) {
  Index i = 0;
  if constexpr (G == 2) {
    for (; i + 6 <= m; i += 6) {
      multiply_rows<T, 6, 2>(a, i, b, b_stride, inner, result, column, columns);
    }
    for (; i + 2 <= m; i += 2) {
      multiply_rows<T, 2, 2>(a, i, b, b_stride, inner, result, column, columns);
    }
  }
  for (; i < m; ++i) multiply_rows<T, 1, G>(a, i, b, b_stride, inner, result, column, columns);
}

template <class T>
HMT_INLINE void multiply_any(Strided<T> a, Strided<T> b, Strided<T> result, Index m, Index inner,
                             Index n, T* room) {
  constexpr Index count = 2 * Lanes<T>::count;
  if (n == 1) {
    T* other = room + inner;
    for (Index k = 0; k < inner; ++k) room[k] = b(k, 0);
    for (Index i = 0; i < m; ++i) {
      const T* row = &a(i, 0);
      if (a.column != sizeof(T)) {
        for (Index k = 0; k < inner; ++k) other[k] = a(i, k);
        row = other;
      }
      result(i, 0) = dot(row, room, inner);
    }
    return;
  }
  const bool together = b.column == sizeof(T);
  const Index stride = b.row / Index(sizeof(T));
  Index column = 0;
  for (; together && m < 6 && column + 4 * count <= n; column += 4 * count) {
    multiply_columns<T, 8>(a, &b(0, column), stride, m, inner, result, column, 4 * count);
  }
  for (; together && column + count <= n; column += count) {
    multiply_columns<T, 2>(a, &b(0, column), stride, m, inner, result, column, count);
  }
  for (; column < n; column += count) {
    const Index columns = std::min(count, n - column);
    for (Index k = 0; k < inner; ++k) {
      for (Index j = 0; j < columns; ++j) room[k * count + j] = b(k, column + j);
      for (Index j = columns; j < count; ++j) room[k * count + j] = T(0);
    }
    multiply_columns<T, 2>(a, room, count, m, inner, result, column, columns);
  }
}

HMT_WIDE void multiply(Strided<double> a, Strided<double> b, Strided<double> result, Index m,
                       Index inner, Index n, double* room) {
  multiply_any(a, b, result, m, inner, n, room);
}
HMT_WIDE void multiply(Strided<float> a, Strided<float> b, Strided<float> result, Index m,
                       Index inner, Index n, float* room) {
  multiply_any(a, b, result, m, inner, n, room);
}

}  // namespace hmt::matrices

namespace hmt {

using namespace matrices;

namespace {

// One call of a loop: the matrices of each item in turn.
class Items {
 public:
  Items(char** pointers, const Index* counts, const Index* strides, int arrays)
      : pointers_(pointers), count_(counts[0]), outer_(strides), inner_(strides + arrays) {}
  Index size() const { return count_; }
  // The part of an array for item i; the strides of its own axes start at index `at`.
  Strided<double> matrix(int array, Index i, int at) const {
    return {pointers_[array] + i * outer_[array], inner_[at], inner_[at + 1]};
  }
  Strided<double> vector(int array, Index i, int at) const {
    return {pointers_[array] + i * outer_[array], inner_[at], 0};
  }
  Strided<double> number(int array, Index i) const {
    return {pointers_[array] + i * outer_[array], 0, 0};
  }

 private:
  char** pointers_;
  Index count_;
  const Index *outer_, *inner_;
};

void read(Strided<double> from, Index m, Index n, Rows to, Index column = 0) {
  for (Index i = 0; i < m; ++i) {
    double* row = to[i] + column;
    if (from.column == sizeof(double)) {
      std::copy_n(&from(i, 0), n, row);
    } else {
      for (Index j = 0; j < n; ++j) row[j] = from(i, j);
    }
    std::fill(row + n, row + in_whole_lanes(n), 0.0);
  }
}
void write(Rows from, Index column, bool good, Index m, Index n, Strided<double> to) {
  for (Index i = 0; i < m; ++i) {
    for (Index j = 0; j < n; ++j) to(i, j) = good ? from[i][column + j] : nan;
  }
}
void set_identity(Rows rows, Index n, Index column = 0) {
  for (Index i = 0; i < n; ++i) {
    std::fill_n(rows[i] + column, in_whole_lanes(n), 0.0);
    rows[i][column + i] = 1.0;
  }
}

// (n,n)->(n,n)
void cholesky_loop(char** pointers, const Index* counts, const Index* strides, void*) {
  const Items items(pointers, counts, strides, 2);
  const Index n = counts[1];
  Scratch<double, 2> room(n, in_whole_lanes(n));
  const Rows rows{room[0].data, in_whole_lanes(n)};
  bool all = true;
  for (Index i = 0; i < items.size(); ++i) {
    const Strided<double> given = items.matrix(0, i, 0), result = items.matrix(1, i, 2);
    read({given.data, given.column, given.row}, n, n, rows);  // the lower triangle, as in numpy
    const bool good = factorise(rows, n);
    all = all && good;
    for (Index j = 0; j < n; ++j) {
      for (Index k = 0; k < n; ++k) result(j, k) = !good ? nan : k > j ? 0.0 : rows[k][j];
    }
  }
  report_only(all ? 0 : FE_INVALID);
}

// (n,n),(n,m)->(n,m)
template <int triangle>  // -1 lower, 1 upper, 0 a full matrix
void solve_loop(char** pointers, const Index* counts, const Index* strides, void*) {
  const Items items(pointers, counts, strides, 3);
  const Index n = counts[1], m = counts[2], width = in_whole_lanes(n) + in_whole_lanes(m);
  Scratch<double, 2> room(n, width);
  const Rows rows{room[0].data, width};
  bool all = true;
  for (Index i = 0; i < items.size(); ++i) {
    read(items.matrix(0, i, 0), n, n, rows);
    read(items.matrix(1, i, 2), n, m, rows, in_whole_lanes(n));
    bool good = true;
    for (Index k = 0; k < n; ++k) good = good && rows[k][k] != 0.0;
    if (triangle == 0) good = eliminate(rows, n) != 0.0;
    if (good) (triangle < 0 ? solve_lower : solve_upper)(rows, n, in_whole_lanes(n));
    all = all && good;
    write(rows, in_whole_lanes(n), good, n, m, items.matrix(2, i, 4));
  }
  report_only(all ? 0 : FE_INVALID);
}

// (n,n)->(n,n)
void inverse_loop(char** pointers, const Index* counts, const Index* strides, void*) {
  const Items items(pointers, counts, strides, 2);
  const Index n = counts[1], width = 2 * in_whole_lanes(n);
  Scratch<double, 2> room(n, width);
  const Rows rows{room[0].data, width};
  bool all = true;
  for (Index i = 0; i < items.size(); ++i) {
    read(items.matrix(0, i, 0), n, n, rows);
    set_identity(rows, n, in_whole_lanes(n));
    const bool good = eliminate(rows, n) != 0.0;
    if (good) solve_upper(rows, n, in_whole_lanes(n));
    all = all && good;
    write(rows, in_whole_lanes(n), good, n, n, items.matrix(1, i, 2));
  }
  report_only(all ? 0 : FE_INVALID);
}

// (n,n)->(),(): the determinant, and the logarithm of its absolute value.
void determinant_loop(char** pointers, const Index* counts, const Index* strides, void*) {
  const Items items(pointers, counts, strides, 3);
  const Index n = counts[1];
  Scratch<double, 2> room(n, in_whole_lanes(n));
  const Rows rows{room[0].data, in_whole_lanes(n)};
  for (Index i = 0; i < items.size(); ++i) {
    read(items.matrix(0, i, 0), n, n, rows);
    double product = eliminate(rows, n), sum = product == 0.0 ? -infinity : 0.0;
    for (Index k = 0; k < n && product != 0.0; ++k) sum += elementary::log(std::abs(rows[k][k]));
    for (Index k = 0; k < n && product != 0.0; ++k) product *= rows[k][k];
    items.number(1, i)(0, 0) = product;
    items.number(2, i)(0, 0) = sum;
  }
  report_only(0);
}

// Scales rows by a power of two, so that their largest number is near 1; returns the inverse power,
// or NaN if a number is not finite.
double scale(Rows rows, Index m, Index n) {
  double largest = 0.0;
  for (Index i = 0; i < m; ++i) {
    for (Index j = 0; j < n; ++j) {
      const double size = std::abs(rows[i][j]);
      if (!(size <= largest)) largest = size;
    }
  }
  if (!(largest < infinity)) return nan;
  const double factor = scale_of(largest);
  for (Index i = 0; i < m; ++i) {
    for (Index j = 0; j < n; ++j) rows[i][j] *= factor;
  }
  return 1.0 / factor;
}

// Indices that sort values by size.
void sort_places(const double* values, Index n, Index* places, bool falling) {
  for (Index i = 0; i < n; ++i) places[i] = i;
  std::stable_sort(places, places + n, [&](Index a, Index b) {
    return falling ? values[a] > values[b] : values[a] < values[b];
  });
}

// (n,n)->(n),(n,n), or (n,n)->(n)
template <bool with_vectors>
void eigen_loop(char** pointers, const Index* counts, const Index* strides, void*) {
  const Items items(pointers, counts, strides, with_vectors ? 3 : 2);
  const Index n = counts[1];
  Scratch<double, 2> room(n, in_whole_lanes(n)), vector_room(n, in_whole_lanes(n)),
      part(4, in_whole_lanes(n));
  Scratch<Index, 1> places(n);
  const Rows rows{room[0].data, in_whole_lanes(n)};
  const Rows vectors{with_vectors ? vector_room[0].data : nullptr, in_whole_lanes(n)};
  double* values = part[0].data;
  double *beside = part[1].data, *scales = part[2].data, *work = part[3].data;
  bool all = true;
  for (Index i = 0; n > 0 && i < items.size(); ++i) {
    read(items.matrix(0, i, 0), n, n, rows);
    for (Index j = 0; j < n; ++j) {  // the lower triangle, as in numpy
      for (Index k = 0; k < j; ++k) rows[k][j] = rows[j][k];
    }
    const double unit = scale(rows, n, n);
    bool good = unit > 0.0;
    if (good) make_tridiagonal(rows, n, values, beside, scales, work);
    if (good && with_vectors) {
      set_identity(vectors, n);
      multiply_reflections(rows, n, scales, vectors, work);
      for (Index j = 0; j < n; ++j) {
        for (Index k = 0; k < j; ++k) std::swap(vectors[j][k], vectors[k][j]);
      }
    }
    good = good && diagonalise(values, beside, n, vectors);
    all = all && good;
    sort_places(values, n, places.view().data, false);
    for (Index j = 0; j < n; ++j) {
      items.vector(1, i, 2)(j, 0) = good ? unit * values[places[j]] : nan;
      for (Index k = 0; with_vectors && k < n; ++k) {
        items.matrix(2, i, 3)(k, j) = good ? vectors[places[j]][k] : nan;
      }
    }
  }
  report_only(all ? 0 : FE_INVALID);
}

// (m,n)->(m,n),(n),(n,n): U, the singular values and V, for m >= n. Columns of U are 0 for singular
// values of 0.
void svd_loop(char** pointers, const Index* counts, const Index* strides, void*) {
  const Items items(pointers, counts, strides, 4);
  const Index m = counts[1], n = counts[2];
  Scratch<double, 2> room(n, in_whole_lanes(m)), turn_room(n, in_whole_lanes(n));
  Scratch<double, 1> values(n);
  Scratch<Index, 1> places(n);
  const Rows columns{room[0].data, in_whole_lanes(m)}, turns{turn_room[0].data, in_whole_lanes(n)};
  bool all = true;
  for (Index i = 0; i < items.size(); ++i) {
    const Strided<double> given = items.matrix(0, i, 0);
    read({given.data, given.column, given.row}, n, m, columns);
    set_identity(turns, n);
    const double unit = scale(columns, n, m);
    const bool good = unit > 0.0 && orthogonalise(columns, turns, n);
    all = all && good;
    for (Index j = 0; j < n; ++j) {
      values[j] = std::sqrt(dot(columns[j], columns[j], columns.stride));
    }
    sort_places(values.view().data, n, places.view().data, true);
    const Strided<double> u = items.matrix(1, i, 2), v = items.matrix(3, i, 5);
    for (Index j = 0; j < n; ++j) {
      const Index from = places[j];
      const double value = values[from];
      items.vector(2, i, 4)(j, 0) = good ? unit * value : nan;
      for (Index k = 0; k < m; ++k) {
        u(k, j) = !good ? nan : value > 0.0 ? columns[from][k] / value : 0.0;
      }
      for (Index k = 0; k < n; ++k) v(k, j) = good ? turns[from][k] : nan;
    }
  }
  report_only(all ? 0 : FE_INVALID);
}

// (m?,k),(k,n?)->(m?,n?)
template <class T>
void product_loop(char** pointers, const Index* counts, const Index* strides, void*) {
  const Index m = counts[1], inner = counts[2], n = counts[3];
  Scratch<T, 1> room((inner + 1) * 2 * Lanes<T>::count);
  const Index* own = strides + 3;
  for (Index i = 0; i < counts[0]; ++i) {
    const Strided<T> a{pointers[0] + i * strides[0], own[0], own[1]};
    const Strided<T> b{pointers[1] + i * strides[1], own[2], own[3]};
    const Strided<T> result{pointers[2] + i * strides[2], own[4], own[5]};
    multiply(a, b, result, m, inner, n, room.view().data);
  }
  report_only(0);
}

// (n,n)->(n,n): the exponential, by scaling and squaring of a Pade approximant of degree 13 [Higham
// 2005].
void exponential_loop(char** pointers, const Index* counts, const Index* strides, void*) {
  // clang-format off
  constexpr double b[] = {
      64764752532480000, 32382376266240000, 7771770303897600, 1187353796428800, 129060195264000,
      10559470521600, 670442572800, 33522128640, 1323241920, 40840800, 960960, 16380, 182, 1};
  // clang-format on
  constexpr double theta = 5.371920351148152;  // largest norm with full accuracy
  const Items items(pointers, counts, strides, 2);
  const Index n = counts[1], width = in_whole_lanes(n), area = n * width;
  const Scratch<double, 2> powers(4, area), room(2, 2 * area);
  const Scratch<double, 1> room_of_product((n + 1) * lanes);
  const auto matrix = [&](double* data) {
    return Strided<double>{reinterpret_cast<char*>(data), width * Index(sizeof(double)),
                           sizeof(double)};
  };
  const auto times = [&](double* left, double* right, double* to) {
    multiply(matrix(left), matrix(right), matrix(to), n, n, n, room_of_product.view().data);
  };
  double *one = powers[0].data, *two = powers[1].data, *four = powers[2].data;
  double *six = powers[3].data, *odd = room[0].data, *even = odd + area;
  const Rows both{room[1].data, 2 * width};
  bool all = true;
  for (Index item = 0; item < items.size(); ++item) {
    read(items.matrix(0, item, 0), n, n, {one, width});
    double norm = 0.0;
    for (Index j = 0; j < n; ++j) {
      double sum = 0.0;
      for (Index i = 0; i < n; ++i) sum += std::abs(one[i * width + j]);
      if (!(sum <= norm)) norm = sum;
    }
    bool good = norm < 1e300;
    int halvings = 0;
    for (; good && norm > theta; norm *= 0.5) ++halvings;
    for (Index i = 0; i < area; ++i) one[i] = std::ldexp(one[i], -halvings);
    times(one, one, two);
    times(two, two, four);
    times(two, four, six);
    const auto add = [&](double* to, double sixth, double fourth, double second, double none) {
      for (Index i = 0; i < area; ++i) to[i] += sixth * six[i] + fourth * four[i] + second * two[i];
      for (Index i = 0; i < n; ++i) to[i * width + i] += none;
    };
    // U = A (A^6 (..) + ..) and V = A^6 (..) + ..; exp A = (V - U)^-1 (V + U)
    double *high = both.data, *part = high + area;
    for (const bool is_odd : {true, false}) {
      const double* c = b + is_odd;
      std::fill_n(high, area, 0.0);
      add(high, c[12], c[10], c[8], 0.0);
      times(six, high, part);
      add(part, c[6], c[4], c[2], c[0]);
      if (is_odd) {
        times(one, part, odd);
      } else {
        std::copy_n(part, area, even);
      }
    }
    for (Index i = 0; i < n; ++i) {
      for (Index j = 0; j < width; ++j) {
        const double u = odd[i * width + j], v = even[i * width + j];
        both[i][j] = v - u;
        both[i][width + j] = v + u;
      }
    }
    good = good && eliminate(both, n) != 0.0;
    if (good) solve_upper(both, n, width);
    for (Index i = 0; i < n; ++i) std::copy_n(both[i] + width, width, odd + i * width);
    for (; halvings > 0; --halvings) {
      times(odd, odd, even);
      std::swap(odd, even);
    }
    all = all && good;
    write({odd, width}, 0, good, n, n, items.matrix(1, item, 2));
  }
  report_only(all ? 0 : FE_INVALID);
}

// (n)->()
void log_sum_exp_loop(char** pointers, const Index* counts, const Index* strides, void*) {
  const Scratch<double, 1> room(counts[1]);
  for (Index i = 0; i < counts[0]; ++i) {
    const Strided<double> given{pointers[0] + i * strides[0], strides[2], 0};
    for (Index k = 0; k < counts[1]; ++k) room[k] = given(k, 0);
    *reinterpret_cast<double*>(pointers[1] + i * strides[1]) =
        log_sum_exp(room.view().data, counts[1]);
  }
  report_only(0);
}

// (p,c),(p,c)->()
void mean_distance_loop(char** pointers, const Index* counts, const Index* strides, void*) {
  const Items items(pointers, counts, strides, 3);
  const Index points = counts[1], coordinates = counts[2];
  for (Index i = 0; i < items.size(); ++i) {
    const Strided<double> one = items.matrix(0, i, 0), other = items.matrix(1, i, 2);
    double total = 0.0;
    for (Index p = 0; p < points; ++p) {
      double sum = 0.0;
      for (Index c = 0; c < coordinates; ++c) sum += square(one(p, c) - other(p, c));
      total += std::sqrt(sum);
    }
    items.number(2, i)(0, 0) = total / double(points);
  }
  report_only(0);
}

// (n,k)->(n,n)
void distances_loop(char** pointers, const Index* counts, const Index* strides, void*) {
  const Items items(pointers, counts, strides, 2);
  const Index n = counts[1], k = counts[2], width = in_whole_lanes(k);
  const Scratch<double, 2> rows(n, width);
  for (Index item = 0; item < items.size(); ++item) {
    read(items.matrix(0, item, 0), n, k, {rows[0].data, width});
    const Strided<double> result = items.matrix(1, item, 2);
    for (Index i = 0; i < n; ++i) {
      result(i, i) = 0.0;
      for (Index j = 0; j < i; ++j) {
        result(i, j) = result(j, i) = distance(rows[i].data, rows[j].data, width);
      }
    }
  }
  report_only(0);
}

}  // namespace

void bind_matrix_functions(const UfuncModule& m) {
  bind_matrix_function(m, "cholesky", {cholesky_loop}, "(n,n)->(n,n)", 1, 1,
                       "Lower Cholesky factor.");
  bind_matrix_function(m, "solve", {solve_loop<0>}, "(n,n),(n,m)->(n,m)", 2, 1,
                       "Solution X of A X = B.");
  bind_matrix_function(m, "solve_lower", {solve_loop<-1>}, "(n,n),(n,m)->(n,m)", 2, 1,
                       "Solution X of L X = B with the lower triangle of L.");
  bind_matrix_function(m, "solve_upper", {solve_loop<1>}, "(n,n),(n,m)->(n,m)", 2, 1,
                       "Solution X of U X = B with the upper triangle of U.");
  bind_matrix_function(m, "inverse", {inverse_loop}, "(n,n)->(n,n)", 1, 1, "Inverse.");
  bind_matrix_function(m, "exponential", {exponential_loop}, "(n,n)->(n,n)", 1, 1, "Exponential.");
  bind_matrix_function(m, "determinant", {determinant_loop}, "(n,n)->(),()", 1, 2,
                       "Determinant, and the logarithm of its size.");
  bind_matrix_function(m, "symmetric_eigen", {eigen_loop<true>}, "(n,n)->(n),(n,n)", 1, 2,
                       "Eigenvalues, rising, and eigenvectors by columns of a symmetric matrix.");
  bind_matrix_function(m, "symmetric_eigenvalues", {eigen_loop<false>}, "(n,n)->(n)", 1, 1,
                       "Eigenvalues, rising, of a symmetric matrix.");
  bind_matrix_function(m, "singular_values", {svd_loop}, "(m,n)->(m,n),(n),(n,n)", 1, 3,
                       "U, the singular values, falling, and V of a matrix with m >= n.");
  bind_matrix_function(m, "product", {product_loop<float>, product_loop<double>},
                       "(m?,k),(k,n?)->(m?,n?)", 2, 1, "Matrix product, as numpy.matmul.");
  bind_matrix_function(m, "mean_distance", {mean_distance_loop}, "(p,c),(p,c)->()", 2, 1,
                       "Mean distance of points from others.");
  bind_matrix_function(m, "distances", {distances_loop}, "(n,k)->(n,n)", 1, 1,
                       "Distances of rows from each other.");
  bind_matrix_function(m, "log_sum_exp", {log_sum_exp_loop}, "(n)->()", 1, 1,
                       "log sum exp(x) along the last axis, or along `axis`.");
}

}  // namespace hmt
