// Distance of the silhouette's outline from the model's contour; see
// hmt_ros/image/terms/silhouette.py.
//
//     E(x) = w / M sum_m f_s(m) rho(|u_i(m)(x) - s_m| / sigma)
//
// s_m are M samples of the outline of the silhouette, u_i points of the model's contour, and i(m)
// is the one nearest to sample m, by position and direction, among those that no other part covers.
// f_s(m) is the factor of its segment.
#pragma once

#include "../pose_view.h"

namespace hmt {

// Weight of a unit difference in direction when outline and contour are matched, px.
inline constexpr double outline_turn = 12.0;
// Distance along the outline without cost, px, which is the spacing of the contour's points.
inline constexpr double outline_spacing = 8.0;

// M samples on the outline of a silhouette.
struct Outline {
  Table pixels, normals;  // (M, 2), unit vectors (M, 2) out of the silhouette
  Numbers beliefs;        // (M,) 0 to 1

  Index count() const { return pixels.size(); }
  void check() const {
    expect_shape("pixels", pixels, {-1, 2});
    expect_shape("normals", normals, {count(), 2});
    expect_shape("beliefs", beliefs, {count()});
  }
};

struct CoverageInputs {
  Weighting term;
  Outline outline;
  Table explained;  // (X, M) maximum energy of samples; one row per pose or one for all
  Matrix costs;     // (N, M) result: energy of each sample; no rows: not wanted

  void check() const {
    expect_shape("costs", costs, {-1, outline.count()});
    expect_shape("explained", explained, {-1, outline.count()});
  }
  void check_poses(Index poses) const {
    const Index rows = costs.size(), known = explained.size();
    expect(rows == 0 || rows >= poses, "costs", "no row, or one for each pose");
    expect(known == 1 || known == poses, "explained", "one row, or one for each pose");
  }
};

// The points of a contour that no other part covers; all existing points if all are covered.
inline Index matched_points(const Contour& contour, Index* use) {
  Index used = 0;
  for (Index i = 0; i < contour.count; ++i) {
    use[used] = i;
    used += contour.valid[i] > contour.covered[i];
  }
  if (used > 0) return used;
  for (Index i = 0; i < contour.count; ++i) {
    use[used] = i;
    used += contour.valid[i] > 0.0;
  }
  return used;
}

// For samples (4, M), in whole lanes, the place in `use` of the nearest point (4,): pixel and
// scaled normal.
inline void find_nearest(const float* points, Index number, const float* samples, Index count,
                         std::int32_t* nearest) {
  constexpr Index together = 2 * lanes;
  for (Index first = 0; first < count; first += together) {
    const float *us = samples + first, *vs = us + count, *nus = vs + count, *nvs = nus + count;
    float gaps[together];
    std::int32_t found[together] = {};
    std::fill_n(gaps, together, std::numeric_limits<float>::infinity());
    for (Index i = 0; i < number; ++i) {
      const float *point = points + 4 * i, u = point[0], v = point[1], nu = point[2], nv = point[3];
      const std::int32_t own = static_cast<std::int32_t>(i);
#pragma omp simd
      for (Index k = 0; k < together; ++k) {
        const float du = u - us[k], dv = v - vs[k], dnu = nu - nus[k], dnv = nv - nvs[k];
        const float gap = du * du + dv * dv + dnu * dnu + dnv * dnv;
        found[k] = gap < gaps[k] ? own : found[k];
        gaps[k] = gap < gaps[k] ? gap : gaps[k];
      }
    }
    std::copy(found, found + together, nearest + first);
  }
}

// For each sample, the nearest point of the contour of similar direction; at least one point
// exists.
inline void match_outline(const Outline& outline, const Contour& contour, const Index* use,
                          Index used, Index* nearest) {
  constexpr float turn = static_cast<float>(outline_turn);
  const Index count = outline.count(), whole = (count + 2 * lanes - 1) / (2 * lanes) * 2 * lanes;
  Scratch<float, 1> room(4 * (whole + used));
  Scratch<std::int32_t, 1> found(whole);
  float *samples = room.view().data, *points = samples + 4 * whole;
  for (Index m = 0; m < count; ++m) {
    for (int k = 0; k < 2; ++k) {
      samples[k * whole + m] = static_cast<float>(outline.pixels(m, k));
      samples[(2 + k) * whole + m] = turn * static_cast<float>(outline.normals(m, k));
    }
  }
  for (Index a = 0; a < used; ++a) {
    const Index i = use[a];
    points[4 * a] = static_cast<float>(contour.u[i]);
    points[4 * a + 1] = static_cast<float>(contour.v[i]);
    points[4 * a + 2] = static_cast<float>(outline_turn * contour.nu[i]);
    points[4 * a + 3] = static_cast<float>(outline_turn * contour.nv[i]);
  }
  find_nearest(points, used, samples, whole, found.view().data);
  for (Index m = 0; m < count; ++m) nearest[m] = use[found[m]];
}

// Adds the residuals of the pose in a view, and returns its energy.
HMT_WIDE inline double add_term(const PoseView& view, const CoverageInputs& inputs,
                                const Sums& sums) {
  const Weighting& term = inputs.term;
  const Outline& outline = inputs.outline;
  const Contour& contour = view.contour;
  const Index count = outline.count(), whole = in_whole_lanes(count);
  const double share = term.weight / double(count), per_scale = 1.0 / (term.scale * term.scale);
  const double* explained = inputs.explained[inputs.explained.size() > 1 ? view.number : 0].data;
  const Matrix rows = view.rows(9, whole);
  rows.fill(0.0);
  double* value = rows[7].data;
  double* costs = inputs.costs.size() > 0 ? inputs.costs[view.number].data : value;
  Scratch<Index, 1> use(contour.count + 1), nearest(count);
  const Index used = matched_points(contour, use.view().data);
  double energy = 0.0;
  if (used == 0) {  // samples belong to no segment
    for (Index m = 0; m < count; ++m) {
      costs[m] = least(explained[m], 0.5 * share * outline.beliefs[m] * term.scale * term.scale);
      energy += costs[m];
    }
    return energy;
  }
  match_outline(outline, contour, use.view().data, used, nearest.view().data);
  double *du = rows[0].data, *dv = rows[1].data, *nx = rows[2].data, *ny = rows[3].data;
  double *inverse = rows[4].data, *across = rows[5].data, *beyond = rows[6].data;
  double* share_of = rows[8].data;
  for (Index m = 0; m < count; ++m) {
    const Index i = nearest[m];
    du[m] = contour.u[i] - outline.pixels(m, 0);
    dv[m] = contour.v[i] - outline.pixels(m, 1);
    nx[m] = outline.normals(m, 0);
    ny[m] = outline.normals(m, 1);
    inverse[m] = contour.noise[i];
    share_of[m] = share * outline.beliefs[m] * view.factor(term, contour.parts[i]);
  }
#pragma omp simd
  for (Index m = 0; m < whole; ++m) {
    inverse[m] = 1.0 / contour_sigma(term, inverse[m]);
    const double along = nx[m] * dv[m] - ny[m] * du[m];
    across[m] = (nx[m] * du[m] + ny[m] * dv[m]) * inverse[m];
    beyond[m] = (along - between(along, -outline_spacing, outline_spacing)) * inverse[m];
    const double squared = across[m] * across[m] + beyond[m] * beyond[m];
    value[m] = squared / (1.0 + squared * per_scale);
  }
  for (Index m = 0; m < count; ++m) {
    value[m] = costs[m] = least(0.5 * share_of[m] * value[m], explained[m]);
  }
  energy = sum_of(value, whole);
  if (!sums.wanted()) return energy;
  for (Index m = 0; m < count; ++m) {
    if (!(costs[m] < explained[m])) continue;
    const double squared = across[m] * across[m] + beyond[m] * beyond[m];
    const double shrink = 1.0 / (1.0 + squared * per_scale);
    const double k = share_of[m] * shrink * shrink;
    const double gu = nx[m] * inverse[m], gv = ny[m] * inverse[m];
    view.add(nearest[m], gu, gv, k * across[m], k, sums);
    if (beyond[m] != 0.0) view.add(nearest[m], -gv, gu, k * beyond[m], k, sums);
  }
  return energy;
}

}  // namespace hmt
