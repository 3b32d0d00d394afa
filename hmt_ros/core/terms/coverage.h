// Distance of the silhouette's outline from the model's contour; see
// hmt_ros/image/terms/silhouette.py.
//
//     E(x) = w / M sum_m rho(|u_i(m)(x) - s_m| / sigma)
//
// s_m are M samples of the outline of the silhouette, u_i points of the model's contour, and i(m)
// is the one nearest to sample m, by position and direction, among those that no other part covers.
#pragma once

#include "../pose_view.h"
#include "../wide.h"

namespace hmt {

// Pixels that a unit of difference in direction counts as when outline and contour are matched.
inline constexpr double outline_turn = 12.0;
// Along the outline distances up to this, px, cost nothing: the contour's points stand that far
// apart.
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
  Table explained;  // (X, M) maximum energy of samples; a row a pose, or one row for all
  Matrix costs;     // (N, M) result: energy of each sample

  void check() const {
    const Index rows = explained.size();
    expect_shape("costs", costs, {-1, outline.count()});
    expect_shape("explained", explained, {-1, outline.count()});
    expect(rows == 1 || rows == costs.size(), "explained", "one row, or one for each pose");
  }
  void check_poses(Index poses) const {
    expect(costs.size() >= poses, "costs", "a row for each pose");
  }
};

// The points of a contour that no other part covers; all that exist where it is covered everywhere.
inline Index matched_points(const Contour& contour, const Array<Index, 1>& use) {
  Index used = 0;
  for (Index i = 0; i < contour.count(); ++i) {
    if (contour.valid[i] && !contour.covered[i]) use[used++] = i;
  }
  if (used > 0) return used;
  for (Index i = 0; i < contour.count(); ++i) {
    if (contour.valid[i]) use[used++] = i;
  }
  return used;
}

// So many samples are matched at once.
inline constexpr Index lanes = 8;
using Lanes [[gnu::vector_size(lanes * sizeof(float))]] = float;
using WholeLanes [[gnu::vector_size(lanes * sizeof(std::int32_t))]] = std::int32_t;

// Samples of the outline, or points of the contour as they are matched: pixel and scaled normal.
struct Matched {
  Lanes u, v, nu, nv;
};

// For each of the samples the nearest of so many points (4,): pixel and scaled normal.
HMT_WIDE inline void find_nearest(const float* points, Index number, const Matched* samples,
                                  Index blocks, WholeLanes* nearest) {
  for (Index block = 0; block < blocks; ++block) {
    const Matched own = samples[block];
    Lanes least_gap = Lanes{} + std::numeric_limits<float>::infinity();
    WholeLanes found{};
    for (Index i = 0; i < number; ++i) {
      const float* point = points + 4 * i;
      const Lanes du = point[0] - own.u, dv = point[1] - own.v;
      const Lanes dnu = point[2] - own.nu, dnv = point[3] - own.nv;
      const Lanes gap = du * du + dv * dv + dnu * dnu + dnv * dnv;
      const WholeLanes closer = gap < least_gap;
      least_gap = closer ? gap : least_gap;
      found = closer ? WholeLanes{} + static_cast<std::int32_t>(i) : found;
    }
    nearest[block] = found;
  }
}

// For each sample the point of the contour, one of `use`, that is nearest and points its way.
inline void match_outline(const Outline& outline, const Contour& contour, const Places& use,
                          const Array<std::int32_t, 1>& nearest) {
  constexpr float turn = static_cast<float>(outline_turn);
  const Index count = outline.count(), blocks = (count + lanes - 1) / lanes;
  Scratch<Matched, 1> samples(blocks);
  Scratch<WholeLanes, 1> found(blocks);
  Scratch<float, 2> points(use.size(), 4);
  for (Index m = 0; m < count; ++m) {
    Matched& own = samples[m / lanes];
    own.u[m % lanes] = static_cast<float>(outline.pixels(m, 0));
    own.v[m % lanes] = static_cast<float>(outline.pixels(m, 1));
    own.nu[m % lanes] = turn * static_cast<float>(outline.normals(m, 0));
    own.nv[m % lanes] = turn * static_cast<float>(outline.normals(m, 1));
  }
  for (Index a = 0; a < use.size(); ++a) {
    for (int k = 0; k < 2; ++k) {
      points(a, k) = static_cast<float>(contour.pixels(use[a], k));
      points(a, 2 + k) = static_cast<float>(outline_turn * contour.normals(use[a], k));
    }
  }
  find_nearest(points[0].data, use.size(), samples.view().data, blocks, found.view().data);
  for (Index m = 0; m < count; ++m) {
    nearest[m] = static_cast<std::int32_t>(use[found[m / lanes][m % lanes]]);
  }
}

// Adds the residuals of the pose in a view, returns its energy.
inline double add_term(const PoseView& view, const CoverageInputs& inputs, const Sums& sums) {
  const Weighting& term = inputs.term;
  const Outline& outline = inputs.outline;
  const Contour& contour = view.contour;
  const Index count = outline.count();
  const double share = term.weight / double(count);
  const double* explained = inputs.explained[inputs.explained.size() > 1 ? view.number : 0].data;
  double* costs = inputs.costs[view.number].data;
  Scratch<Index, 1> use(contour.count());
  const Index used = matched_points(contour, use);
  double energy = 0.0;
  if (used == 0) {
    for (Index m = 0; m < count; ++m) {
      costs[m] = least(explained[m], 0.5 * share * outline.beliefs[m] * term.scale * term.scale);
      energy += costs[m];
    }
    return energy;
  }
  Scratch<std::int32_t, 1> nearest(count);
  match_outline(outline, contour, use.view().rows(0, used), nearest);
  Scratch<double, 1> inverse(contour.count()), across(count), beyond(count);
  for (Index i = 0; i < contour.count(); ++i) {
    inverse[i] = 1.0 / contour_sigma(term, contour.noise[i]);
  }
  const double per_scale = 1.0 / (term.scale * term.scale);
  for (Index m = 0; m < count; ++m) {
    const Index i = nearest[m];
    const double du = contour.pixels(i, 0) - outline.pixels(m, 0);
    const double dv = contour.pixels(i, 1) - outline.pixels(m, 1);
    const double nx = outline.normals(m, 0), ny = outline.normals(m, 1);
    const double along = nx * dv - ny * du;
    across[m] = (nx * du + ny * dv) * inverse[i];
    beyond[m] = (along - between(along, -outline_spacing, outline_spacing)) * inverse[i];
    const double squared = across[m] * across[m] + beyond[m] * beyond[m];
    const double rho = 0.5 * share * outline.beliefs[m] * squared / (1.0 + squared * per_scale);
    costs[m] = least(rho, explained[m]);
    energy += costs[m];
  }
  if (!sums.wanted()) return energy;
  for (Index m = 0; m < count; ++m) {
    const double squared = across[m] * across[m] + beyond[m] * beyond[m];
    const Robust robust = geman_mcclure(std::sqrt(squared), term.scale, share * outline.beliefs[m]);
    if (robust.value >= explained[m]) continue;
    const Index i = nearest[m], segment = view.owner(contour.parts[i]);
    const double *p = contour.points[i].data, *j = contour.projections[i].data;
    const double k = robust.curvature;
    const double nx = outline.normals(m, 0) * inverse[i], ny = outline.normals(m, 1) * inverse[i];
    const Gradient a = by_point(nx, ny, j);
    sums.add(segment, p, a.x, a.y, a.z, k * across[m], k);
    if (beyond[m] != 0.0) {
      sums.add(segment, p, nx * j[3] - ny * j[0], nx * j[4] - ny * j[1], nx * j[5] - ny * j[2],
               k * beyond[m], k);
    }
  }
  return energy;
}

}  // namespace hmt
