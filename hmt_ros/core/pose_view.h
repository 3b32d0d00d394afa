// One pose as the terms of the image see it.
#pragma once

#include "kinematics.h"
#include "residuals.h"
#include "surface.h"

namespace hmt {

// Settings of a term; weight 0: off.
struct Weighting {
  double weight, sigma, scale;
  double magnification;  // px for a metre at the person: turns errors of the body into pixels
  double growth;         // of the deviation of a depth with its square, 1/m
};

// Body and camera.
struct Model {
  Tree tree;
  FleshTable flesh;
  Lens lens;
  Mask traced;           // (B,) parts whose contour is compared with the image
  Mask occluders;        // (B,) parts that can hide others
  Index contour_points;  // number of contour points that weights are for; 0: those there are

  void check() const {
    expect_range("flesh.part_segments", flesh.part_segments, 0, tree.segments());
    expect_shape("traced", traced, {flesh.parts()});
    expect_shape("occluders", occluders, {flesh.parts()});
    expect(contour_points >= 0, "contour_points", "0 or more");
  }
};

// Room for one pose after the other; it is made once. `model` must outlive it.
struct PoseView {
  explicit PoseView(const Model& body)
      : model(body),
        columns(body.tree.segments(), 3, 3),
        origins(body.tree.segments(), 3),
        room(2 * body.flesh.rings()),
        front_room(2 * body.flesh.rings()),
        contour(room.contour()),
        front(front_room.contour()) {}

  const Model& model;
  Index number = 0;            // of the pose, of those of a call
  Scratch<double, 3> columns;  // (S, 3, 3) of the segments
  Scratch<double, 2> origins;  // (S, 3)
  ContourRoom room, front_room;
  Contour contour;  // traced if some term asks for it
  Contour front;    // room for other points of the rings

  Frames frames() const { return {columns.view(), origins.view()}; }
  // Segment of a part of the flesh.
  Index owner(Index part) const { return model.flesh.part_segments[part]; }
};

// Marks which points of the pose in a view other parts hide.
inline void mark_points(const PoseView& view, const Contour& points) {
  mark_visibility(view.model.flesh, view.model.occluders, view.columns, view.origins, points.parts,
                  points.points, points.valid, points.covered, points.hidden);
}

// Takes in the pose, of this number, whose frames are in a view; its contour if it is to be traced.
inline void look(PoseView& view, Index number, bool traced) {
  view.number = number;
  if (!traced) return;
  trace_contour(view.model.flesh, view.model.traced, view.model.lens, view.columns, view.origins,
                view.contour);
  mark_points(view, view.contour);
}

// Standard deviation of a contour point, px, whose noise on the body is given in m.
inline double contour_sigma(const Weighting& term, double noise) {
  const double blur = term.magnification * noise;
  return std::sqrt(term.sigma * term.sigma + blur * blur);
}

// Fewer visible points than this do not make each of them count more.
inline constexpr Index fewest = 20;

// A weight shared among so many points; 0: among those that are valid and not hidden.
inline double weight_of_each(double weight, Index shared, const Contour& points) {
  Index count = shared;
  if (count == 0) {
    for (Index i = 0; i < points.count(); ++i) count += points.valid[i] && !points.hidden[i];
  }
  return weight / double(std::max(count, fewest));
}

// The derivative (3,) of a function of the pixel by the point, from those by column and row, gu and
// gv; j (2, 3) is the projection.
struct Gradient {
  double x, y, z;
};

inline Gradient by_point(double gu, double gv, const double* j) {
  return {gu * j[0] + gv * j[3], gu * j[1] + gv * j[4], gu * j[2] + gv * j[5]};
}

}  // namespace hmt
