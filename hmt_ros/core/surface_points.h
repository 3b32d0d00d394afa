// Points of the surface that a camera sees at a pose; see hmt_ros/image/surface_points.py.
#pragma once

#include "surface.h"

namespace hmt {

// Minimum cosine between normal and ray; flatter surfaces are not used.
inline constexpr double least_facing = 0.3;

// Up to Q points on the visible surface of each of K poses.
struct SurfacePoints {
  Places counts;                   // (K,) number of points per pose; the rest of a row is unused
  Array<const Index, 2> segments;  // (K, Q)
  Tables local;                    // (K, Q, 3) positions in the frames of the segments, m
  Tables pixels;                   // (K, Q, 2) pixels of the points

  void check() const {
    const Index k = counts.size(), q = segments.size(1);
    expect_shape("segments", segments, {k, q});
    expect_range("counts", counts, 0, q + 1);
    expect_shape("local", local, {k, q, 3});
    expect_shape("pixels", pixels, {k, q, 2});
  }
};

// Vertices of a mesh of the flesh, in the frames of the segments.
struct Vertices {
  Table places, normals;   // (V, 3)
  Places segments, parts;  // (V,)

  Index count() const { return places.size(); }
  void check() const {
    expect_shape("places", places, {-1, 3});
    expect_shape("normals", normals, {count(), 3});
    expect_shape("segments", segments, {count()});
    expect_shape("parts", parts, {count()});
  }
};

// Image of a size (2,), px, in which points are visible except at pixels of other people (h, w).
struct Scene {
  Lens lens;
  std::array<double, 2> size;
  Array<const bool, 2> others;  // empty: none

  bool shows(const double* pixel) const {
    const double u = pixel[0], v = pixel[1];
    if (!(0.0 <= u && u < size[0] && 0.0 <= v && v < size[1])) return false;
    if (others.empty()) return true;
    const double row = least(v + 0.5, double(others.size(0) - 1));
    const double column = least(u + 0.5, double(others.size(1) - 1));
    return !others(Index(row), Index(column));
  }
};

// Finds the points seen at K poses with frames (K, S, 3, 3), (K, S, 3), spread evenly over the
// visible vertices. The results are those of `SurfacePoints`.
inline void see_points(const FleshTable& flesh, const Vertices& mesh, const Scene& scene,
                       const Array<const double, 4>& columns, const Tables& origins,
                       const Array<Index, 1>& counts, const Array<Index, 2>& segments,
                       const Tensor& local, const Tensor& pixels) {
  const Index k = counts.size(), q = segments.size(1), count = mesh.count();
  expect_shape("columns", columns, {k, -1, 3, 3});
  expect_shape("origins", origins, {k, columns.size(1), 3});
  expect_range("mesh.segments", mesh.segments, 0, columns.size(1));
  expect_range("mesh.parts", mesh.parts, 0, flesh.parts());
  expect_shape("segments", segments, {k, q});
  expect_shape("local", local, {k, q, 3});
  expect_shape("pixels", pixels, {k, q, 2});
  Scratch<double, 2> points(count, 3), seen(count, 2);
  Scratch<bool, 1> visible(count), covered(count), hidden(count), everything(flesh.parts());
  Scratch<Index, 1> found(count);
  everything.fill(true);
  for (Index n = 0; n < k; ++n) {
    for (Index i = 0; i < count; ++i) {
      const Index s = mesh.segments[i];
      const double *axes = columns[n][s].data, *origin = origins[n][s].data;
      const double *place = mesh.places[i].data, *direction = mesh.normals[i].data;
      double *point = points[i].data, facing = 0.0, squared = 0.0, projection[6];
      for (int a = 0; a < 3; ++a) {
        point[a] = origin[a];
        double normal = 0.0;
        for (int b = 0; b < 3; ++b) {
          point[a] += axes[3 * b + a] * place[b];
          normal += axes[3 * b + a] * direction[b];
        }
        facing -= normal * point[a];
        squared += point[a] * point[a];
      }
      visible[i] = facing > least_facing * std::sqrt(squared) &&
                   project(scene.lens, point[0], point[1], point[2], seen[i].data, projection) &&
                   scene.shows(seen[i].data);
    }
    mark_visibility(flesh, everything, columns[n], origins[n], mesh.parts, points, visible, covered,
                    hidden);
    Index total = 0;
    for (Index i = 0; i < count; ++i) {
      if (visible[i] && !hidden[i]) found[total++] = i;
    }
    counts[n] = std::min(total, q);
    for (Index m = 0; m < counts[n]; ++m) {
      const Index i = found[m * total / counts[n]];
      segments(n, m) = mesh.segments[i];
      local[n][m].copy_from(mesh.places[i]);
      pixels[n][m].copy_from(seen[i]);
    }
  }
}

}  // namespace hmt
