// Visible contour points lie on image edges of their direction; see hmt_ros/image/terms/edges.py.
//
//     E(x) = w / V sum_i f_s(i) rho(d_o(i)(u_i(x)) / sigma)
//
// over the V visible contour points u_i, d_o the distance to the nearest edge of orientation o, f_s
// the factor of segment s.
#pragma once

#include "../pose_view.h"
#include "../sampling.h"

namespace hmt {

inline constexpr Index orientations = 4;
inline constexpr double half_bin = 0.41421356237309503;  // tan(pi / 8)

struct EdgeInputs {
  Weighting term;
  ImageMap distances;  // to the nearest edge of each orientation, px

  void check() const {
    if (term.weight > 0.0)
      expect_shape("distances.values", distances.values, {orientations, -1, -1});
    expect(distances.values.count() < std::numeric_limits<std::int32_t>::max(), "distances.values",
           "fewer pixels");
  }
};

// The orientation nearest to a normal, of angle k pi / 4.
inline std::int32_t orientation(double x, double y) {
  const std::int32_t diagonal = x * y > 0.0 ? 1 : 3;
  const std::int32_t steep = std::abs(x) <= half_bin * std::abs(y) ? 2 : diagonal;
  return std::abs(y) <= half_bin * std::abs(x) ? 0 : steep;
}

// Reads the four pixels around each visible point from the map of its orientation.
inline void read_cells(const ImageMap& map, const Contour& contour, std::int32_t* cells,
                       const std::array<double*, 4>& corners) {
  const std::int32_t h = map.values.size(1), w = map.values.size(2);
#pragma omp simd
  for (Index i = 0; i < contour.count; ++i) {
    // NaN counts as 0.
    const double x = most(0.0, inside(contour.u[i] - double(map.left), w));
    const double y = most(0.0, inside(contour.v[i] - double(map.top), h));
    const auto column = static_cast<std::int32_t>(x), row = static_cast<std::int32_t>(y);
    const std::int32_t channel = orientation(contour.nu[i], contour.nv[i]);
    const bool shown = contour.valid[i] > contour.hidden[i];
    cells[i] = shown ? (channel * h + row) * w + column : 0;
  }
  for (Index i = 0; i < contour.count; ++i) {
    const float* at = map.values.data + cells[i];
    corners[0][i] = at[0];
    corners[1][i] = at[1];
    corners[2][i] = at[w];
    corners[3][i] = at[w + 1];
  }
}

// Adds the residuals of the pose in a view, and returns its energy.
HMT_WIDE inline double add_term(const PoseView& view, const EdgeInputs& inputs, const Sums& sums) {
  const Weighting& term = inputs.term;
  const Contour& contour = view.contour;
  const Index count = contour.count;
  const double each = weight_of_each(term.weight, view.model.contour_points * 6 / 10, contour);
  const Matrix rows = view.rows(10, count);
  const Scratch<std::int32_t, 1> cells(count);
  double *a = rows[0].data, *b = rows[1].data, *p = rows[2].data, *q = rows[3].data;
  read_cells(inputs.distances, contour, cells.view().data, {a, b, p, q});
  double *gu = rows[4].data, *gv = rows[5].data, *value = rows[6].data;
  double *pull = rows[7].data, *curvature = rows[8].data, *own = rows[9].data;
  for (Index i = 0; i < count; ++i) own[i] = each * view.factor(term, contour.parts[i]);
#pragma omp simd
  for (Index i = 0; i < count; ++i) {
    const Sample distance =
        distance_between({a[i], b[i], p[i], q[i]}, inputs.distances, contour.u[i], contour.v[i]);
    const double sigma = contour_sigma(term, contour.noise[i]);
    const Robust robust = geman_mcclure(distance.value / sigma, term.scale, own[i]);
    const bool shown = contour.valid[i] > contour.hidden[i];
    value[i] = shown ? robust.value : 0.0;
    gu[i] = shown ? distance.slope_u / sigma : 0.0;
    gv[i] = shown ? distance.slope_v / sigma : 0.0;
    pull[i] = shown ? robust.pull : 0.0;
    curvature[i] = shown ? robust.curvature : 0.0;
  }
  if (sums.wanted()) view.add_all(gu, gv, pull, curvature, sums);
  return sum_of(value, count);
}

}  // namespace hmt
