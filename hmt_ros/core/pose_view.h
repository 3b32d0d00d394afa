// One pose, with the quantities that the image terms use.
#pragma once

#include "kinematics.h"
#include "residuals.h"
#include "surface.h"

namespace hmt {

// Settings of a term; weight 0: off.
struct Weighting {
  double weight, sigma, scale;
  double magnification;  // px per metre at the person, for errors of the body in pixels
  double growth;         // of a depth's deviation with the squared depth, 1/m
  Numbers segments;      // (S,) factors on the energies at each segment; none: 1
};

// Body and camera.
struct Model {
  Tree tree;
  FleshTable flesh;
  Lens lens;
  Mask traced;           // (B,) parts whose contour is compared with the image
  Mask occluders;        // (B,) parts that can hide others
  Index contour_points;  // number of contour points that share a weight; 0: actual number

  void check() const {
    expect_range("flesh.part_segments", flesh.part_segments, 0, tree.segments());
    expect_shape("traced", traced, {flesh.parts()});
    expect_shape("occluders", occluders, {flesh.parts()});
    expect(0 <= contour_points && contour_points <= 1000000, "contour_points", "0 to a million");
  }
};

// Sums over residuals at contour points of pull and curvature times derivatives by the pixel.
struct PixelSums {
  explicit PixelSums(Index points) : rows(5, points) {}
  double* pull(int axis) const { return rows[axis].data; }
  double* curvature(int axes) const { return rows[2 + axes].data; }  // of uu, uv, vv

  Scratch<double, 2> rows;
};

// Working space, made once and reused for all poses. `model` must outlive it.
class PoseView {
 public:
  explicit PoseView(const Model& body)
      : model(body),
        columns(body.tree.segments(), 3, 3),
        origins(body.tree.segments(), 3),
        rings(body.flesh, body.traced),
        frames_of_rings(rings),
        room_(rings),
        front_room_(rings),
        contour(room_.contour()),
        front(front_room_.contour()),
        pixel_sums(contour.count),
        occluders(body.flesh.parts(), contour.count) {}

  const Model& model;
  Index number = 0;            // index of the pose in a call
  Scratch<double, 3> columns;  // (S, 3, 3) of the segments
  Scratch<double, 2> origins;  // (S, 3)
  const RingLanes rings;
  const RingFrames frames_of_rings;

 private:
  const ContourRoom room_, front_room_;
  mutable std::vector<double> rows_;

 public:
  const Contour contour;  // traced if a term needs it
  const Contour front;    // room for other points of the rings
  const PixelSums pixel_sums;
  const Occluders occluders;

  Frames frames() const { return {columns.view(), origins.view()}; }
  // Segment of a part of the flesh.
  Index owner(Index part) const { return model.flesh.part_segments[part]; }
  // Factor of a term on the energy at a point of a part.
  double factor(const Weighting& term, Index part) const {
    return factor_of(term.segments, owner(part));
  }
  // Working space of a term, with a number of rows; the next term reuses it.
  Matrix rows(Index count, Index length) const {
    rows_.resize(std::max<std::size_t>(rows_.size(), count * length));
    return {rows_.data(), {count, length}};
  }

  // Adds a residual at contour point i, with derivatives gu and gv by its pixel; or lists it.
  void add(Index i, double gu, double gv, double pull, double curvature, const Sums& sums) const {
    if (sums.list.data) {
      const auto by = [&](int k) { return gu * contour.by[k][i] + gv * contour.by[3 + k][i]; };
      const auto point = contour.point(i);
      sums.add(owner(contour.parts[i]), point.data(), by(0), by(1), by(2), pull, curvature);
      return;
    }
    pixel_sums.pull(0)[i] += pull * gu;
    pixel_sums.pull(1)[i] += pull * gv;
    pixel_sums.curvature(0)[i] += curvature * gu * gu;
    pixel_sums.curvature(1)[i] += curvature * gu * gv;
    pixel_sums.curvature(2)[i] += curvature * gv * gv;
  }
  // Adds one residual at each visible contour point (P,).
  void add_all(const double* gu, const double* gv, const double* pull, const double* curvature,
               const Sums& sums) const {
    if (sums.list.data) {
      for (Index i = 0; i < contour.count; ++i) {
        if (contour.shows(i)) add(i, gu[i], gv[i], pull[i], curvature[i], sums);
      }
      return;
    }
    const Sums none;
#pragma omp simd
    for (Index i = 0; i < contour.count; ++i) {
      add(i, gu[i], gv[i], pull[i], curvature[i], none);
    }
  }
};

// Marks points of the pose in a view that other parts hide.
inline void mark_points(const PoseView& view, const Contour& points) {
  mark_hidden(view.model.flesh, view.model.occluders, view.rings.extents(), view.columns,
              view.origins, view.occluders,
              {points.count, points.parts, points.x, points.y, points.z, points.valid,
               points.covered, points.hidden});
}

// Prepares the pose whose frames are in a view, with this index; traces its contour if wanted.
inline void look(PoseView& view, Index number, bool traced) {
  view.number = number;
  view.pixel_sums.rows.fill(0.0);
  view.frames_of_rings.place(view.rings, view.columns, view.origins);
  if (!traced) return;
  trace_contour(view.rings, view.frames_of_rings, view.model.lens, view.contour);
  mark_points(view, view.contour);
}

// Converts the sums at contour points to sums of the segments.
HMT_WIDE inline void lift_pixel_sums(const PoseView& view, const Sums& sums) {
  const Contour& contour = view.contour;
  const PixelSums& own = view.pixel_sums;
  const Index n = view.rings.count();
  const double *gu = own.pull(0), *gv = own.pull(1);
  const double *uu = own.curvature(0), *uv = own.curvature(1), *vv = own.curvature(2);
  for (Index i = 0; i < contour.count; ++i) {
    if (uu[i] + vv[i] == 0.0) continue;
    SegmentSums& segment = sums.segments[view.rings.segments()[i < n ? i : i - n]];
    const double x = contour.x[i], y = contour.y[i], z = contour.z[i];
    double wrenches[2][lanes] = {}, pushed[2][lanes];  // of the pixel's two coordinates
    for (int k = 0; k < 2; ++k) {
      const double a = contour.by[3 * k][i], b = contour.by[3 * k + 1][i];
      const double c = contour.by[3 * k + 2][i];
      const double wrench[6] = {a, b, c, y * c - z * b, z * a - x * c, x * b - y * a};
      std::copy(wrench, wrench + 6, wrenches[k]);
    }
#pragma omp simd
    for (int k = 0; k < lanes; ++k) {
      pushed[0][k] = uu[i] * wrenches[0][k] + uv[i] * wrenches[1][k];
      pushed[1][k] = uv[i] * wrenches[0][k] + vv[i] * wrenches[1][k];
      segment[6][k] += gu[i] * wrenches[0][k] + gv[i] * wrenches[1][k];
    }
    for (int j = 0; j < 6; ++j) {
      const double first = wrenches[0][j], second = wrenches[1][j];
#pragma omp simd
      for (int k = 0; k < lanes; ++k) {
        segment[j][k] += first * pushed[0][k] + second * pushed[1][k];
      }
    }
  }
}

// Standard deviation of a contour point, px, whose noise on the body is given in m.
inline double contour_sigma(const Weighting& term, double noise) {
  const double blur = term.magnification * noise;
  return std::sqrt(term.sigma * term.sigma + blur * blur);
}

// Minimum number of points that share a weight, so that few visible points do not weigh more.
inline constexpr Index fewest = 20;

// Weight per point of a weight that `shared` points share; 0: all valid points that are not hidden.
inline double weight_of_each(double weight, Index shared, const Contour& points) {
  Index count = shared;
  if (count == 0) {
    for (Index i = 0; i < points.count; ++i) count += points.shows(i);
  }
  return weight / double(std::max(count, fewest));
}

}  // namespace hmt
