// The occluding contour in the image, and its visible points; see hmt_ros/image/surface.py.
#pragma once

#include "camera.h"

namespace hmt {

// Parts are grown by this factor when they hide others: superquadrics are fatter than ellipsoids.
inline constexpr double cover = 1.04;
// A point this much behind the front of another part, relative to its distance, is hidden by it.
inline constexpr double behind = 0.004;

// A ring of the flesh.
struct Ring {
  const double *centre, *radii, *slopes, *leans;  // (3), (2), (2), (2)
  double exponent;
  const double* noise;  // (2)
};

// The flesh: parts (B,) and rings (R,).
struct FleshTable {
  Places part_segments;
  Table part_centres, part_radii;
  Places ring_parts;
  Table ring_centres, ring_radii, ring_slopes, ring_leans;
  Numbers ring_exponents;
  // (R, 2) how far contours of people lie from the model's at the sides, and in front, m
  Table ring_noise;

  Index parts() const { return part_segments.size(); }
  Index rings() const { return ring_parts.size(); }
  Ring ring(Index r) const {
    return {ring_centres[r].data, ring_radii[r].data, ring_slopes[r].data,
            ring_leans[r].data,   ring_exponents[r],  ring_noise[r].data};
  }
  void check() const {
    const Index b = parts(), r = rings();
    expect_shape("part_centres", part_centres, {b, 3});
    expect_shape("part_radii", part_radii, {b, 3});
    expect_range("ring_parts", ring_parts, 0, b);
    expect_shape("ring_centres", ring_centres, {r, 3});
    expect_shape("ring_radii", ring_radii, {r, 2});
    expect_shape("ring_slopes", ring_slopes, {r, 2});
    expect_shape("ring_leans", ring_leans, {r, 2});
    expect_shape("ring_exponents", ring_exponents, {r});
    expect_shape("ring_noise", ring_noise, {r, 2});
  }
  // Frames (S, 3, 3), (S, 3) must be there for all parts.
  void check_frames(const Tables& columns, const Table& origins) const {
    expect_shape("columns", columns, {-1, 3, 3});
    expect_shape("origins", origins, {columns.size(), 3});
    expect_range("part_segments", part_segments, 0, columns.size());
  }
};

// Points on the surface at one pose: the contour, P = 2R.
struct Contour {
  Array<Index, 1> parts;
  Matrix points;           // (P, 3) camera frame, m
  Matrix pixels;           // (P, 2)
  Tensor projections;      // (P, 2, 3) derivative of the pixels by the points
  Matrix normals;          // (P, 2) out of the body, in the image
  Array<bool, 1> valid;    // the point exists and lies before the camera
  Array<bool, 1> covered;  // another part lies on the same ray, before or behind
  Array<bool, 1> hidden;   // another part lies on the same ray, before
  Vector noise;            // how far contours of people lie from the point, a deviation, m

  Index count() const { return parts.size(); }
  void check() const {
    const Index p = count();
    expect_shape("points", points, {p, 3});
    expect_shape("pixels", pixels, {p, 2});
    expect_shape("projections", projections, {p, 2, 3});
    expect_shape("normals", normals, {p, 2});
    expect_shape("valid", valid, {p});
    expect_shape("covered", covered, {p});
    expect_shape("hidden", hidden, {p});
    expect_shape("noise", noise, {p});
  }
};

// Room for a contour.
class ContourRoom {
 public:
  explicit ContourRoom(Index p)
      : parts_(p),
        points_(p, 3),
        pixels_(p, 2),
        projections_(p, 2, 3),
        normals_(p, 2),
        valid_(p),
        covered_(p),
        hidden_(p),
        noise_(p) {}
  Contour contour() const {
    return {parts_.view(), points_.view(),  pixels_.view(), projections_.view(), normals_.view(),
            valid_.view(), covered_.view(), hidden_.view(), noise_.view()};
  }

 private:
  Scratch<Index, 1> parts_;
  Scratch<double, 2> points_, pixels_;
  Scratch<double, 3> projections_;
  Scratch<double, 2> normals_;
  Scratch<bool, 1> valid_, covered_, hidden_;
  Scratch<double, 1> noise_;
};

// sgn(x) |x|^exponent.
inline double signed_power(double x, double exponent) {
  return sign(x) * std::pow(std::abs(x), exponent);
}

// The centre of a ring relative to the camera, in the axes of its segment (3, 3), origin (3,).
inline void ring_seen(const Ring& ring, const double* axes, const double* o, double* seen) {
  for (int i = 0; i < 3; ++i) {
    const double* axis = axes + 3 * i;
    seen[i] = axis[0] * o[0] + axis[1] * o[1] + axis[2] * o[2] + ring.centre[i];
  }
}

// The point (3,) of a ring whose angle has this cosine and sine, and the normal (3,) there, camera
// frame; axes (3, 3) and origin (3,) of the segment.
inline void ring_point(const Ring& ring, double c, double s, const double* axes, const double* o,
                       double* point, double* normal) {
  double outline_x = c, outline_y = s, lateral_x = c, lateral_y = s;
  if (ring.exponent != 1.0) {
    outline_x = signed_power(c, ring.exponent);
    outline_y = signed_power(s, ring.exponent);
    lateral_x = signed_power(c, 2.0 - ring.exponent);
    lateral_y = signed_power(s, 2.0 - ring.exponent);
  }
  const double rx = ring.radii[0], ry = ring.radii[1], cz = ring.centre[2];
  const double px = ring.centre[0] + rx * outline_x, py = ring.centre[1] + ry * outline_y;
  const double nx = lateral_x / rx, ny = lateral_y / ry;
  double nz = -(ring.slopes[0] * c * c + ring.slopes[1] * s * s);
  nz = nz - (nx * ring.leans[0] + ny * ring.leans[1]);
  for (int k = 0; k < 3; ++k) {
    point[k] = o[k] + axes[k] * px + axes[3 + k] * py + axes[6 + k] * cz;
    normal[k] = axes[k] * nx + axes[3 + k] * ny + axes[6 + k] * nz;
  }
}

// How far contours of people lie from a point of a ring, a standard deviation, m.
inline double ring_deviation(const Ring& ring, double c, double s) {
  const double across = c * ring.noise[0], ahead = s * ring.noise[1];
  return std::sqrt(across * across + ahead * ahead);
}

// g(w) of hmt_ros/body/flesh.py, whose roots are the angles of the contour on a ring.
struct ContourCondition {
  double bx, by, uz, kx, ky, power;
  double operator()(double w) const {
    const double c = std::cos(w), s = std::sin(w);
    const double turned = bx * signed_power(c, power) + by * signed_power(s, power);
    return 1.0 + turned - uz * (kx * c * c + ky * s * s);
  }
};

// Cosines and sines (2,) of the first root where g rises and the first where it falls; false: none.
inline bool bracketed_roots(const ContourCondition& condition, double* cosines, double* sines) {
  constexpr int steps = 48;
  constexpr double width = 2.0 * pi / steps;
  bool found[2] = {false, false};
  double before = 0.0;
  for (int k = 0; k <= steps; ++k) {
    const double w = -pi + k * width, at = condition(w);
    const int side = at > 0.0 ? 0 : 1;
    if (k > 0 && (before > 0.0) != (at > 0.0) && !found[side]) {
      double low = w - width, high = w, at_low = before, at_high = at, root = high;
      for (int turn = 0; turn < 16; ++turn) {  // Illinois: never stalls at one end
        if (at_high == at_low) break;
        root = low - at_low * (high - low) / (at_high - at_low);
        const double value = condition(root);
        if ((value > 0.0) == (at_high > 0.0)) {
          at_low *= 0.5;
        } else {
          low = high;
          at_low = at_high;
        }
        high = root;
        at_high = value;
      }
      cosines[side] = std::cos(root);
      sines[side] = std::sin(root);
      found[side] = true;
    }
    before = at;
  }
  return found[0] && found[1];
}

// Cosines and sines (2,) of the angles of the contour on a ring; false: there are none.
inline bool contour_angles(const Ring& ring, const double* seen, double* cosines, double* sines) {
  const double kx = ring.slopes[0], ky = ring.slopes[1], uz = seen[2];
  const double bx = (seen[0] - uz * ring.leans[0]) / ring.radii[0];
  const double by = (seen[1] - uz * ring.leans[1]) / ring.radii[1];
  if (ring.exponent != 1.0 || kx != ky) {
    return bracketed_roots({bx, by, uz, kx, ky, 2.0 - ring.exponent}, cosines, sines);
  }
  const double length = std::sqrt(bx * bx + by * by);
  const double cosine = -(1.0 - uz * kx) / most(length, 1e-12);
  if (!(std::abs(cosine) < 1.0)) return false;
  const double sine = std::sqrt(1.0 - cosine * cosine);
  const double cm = bx / length, sm = by / length;
  cosines[0] = cm * cosine - sm * sine;
  sines[0] = sm * cosine + cm * sine;
  cosines[1] = cm * cosine + sm * sine;
  sines[1] = sm * cosine - cm * sine;
  return true;
}

// Fills the contour of one pose: points, pixels, normals, noise. `wanted` (B,) are the parts whose
// contour is traced; the others have no valid points.
inline void trace_contour(const FleshTable& flesh, const Mask& wanted, const Lens& lens,
                          const Tables& columns, const Table& origins, const Contour& contour) {
  flesh.check_frames(columns, origins);
  expect_shape("wanted", wanted, {flesh.parts()});
  const Index rings = flesh.rings();
  expect_shape("contour.parts", contour.parts, {2 * rings});
  for (Index r = 0; r < rings; ++r) {
    const Index part = flesh.ring_parts[r];
    contour.parts[r] = contour.parts[r + rings] = part;
    contour.valid[r] = contour.valid[r + rings] = false;
    if (!wanted[part]) continue;
    const Ring ring = flesh.ring(r);
    const Index s = flesh.part_segments[part];
    const double *axes = columns[s].data, *origin = origins[s].data;
    double seen[3], cosines[2], sines[2];
    ring_seen(ring, axes, origin, seen);
    if (!contour_angles(ring, seen, cosines, sines)) continue;
    for (int side = 0; side < 2; ++side) {
      const Index i = r + side * rings;
      const double c = cosines[side], sn = sines[side];
      double *point = contour.points[i].data, normal[3];
      contour.noise[i] = ring_deviation(ring, c, sn);
      ring_point(ring, c, sn, axes, origin, point, normal);
      if (!project(lens, point[0], point[1], point[2], contour.pixels[i].data,
                   contour.projections[i].data)) {
        continue;
      }
      const double nu = normal[0] / lens.focal[0], nv = normal[1] / lens.focal[1];
      const double size = std::sqrt(nu * nu + nv * nv);
      if (!(size > 0.0)) continue;
      contour.normals(i, 0) = nu / size;
      contour.normals(i, 1) = nv / size;
      contour.valid[i] = true;
    }
  }
}

// A part as others see it: |A (x - c)| = 1.
struct Ellipsoid {
  double centre[3];  // c
  double far;        // c.c
  double reach;      // square of the largest radius
  double outside;    // k.k - 1
  double moved[3];   // k = A c
  double shape[3][3];
};

inline Ellipsoid placed_ellipsoid(const double* centre, const double* radii, const double* axes,
                                  const double* origin) {
  Ellipsoid e;
  for (int i = 0; i < 3; ++i) {
    e.centre[i] = origin[i];
    for (int j = 0; j < 3; ++j) e.centre[i] += axes[3 * j + i] * centre[j];
  }
  double largest = 0.0;
  e.outside = -1.0;
  for (int i = 0; i < 3; ++i) {
    const double radius = cover * radii[i];
    largest = most(largest, radius);
    e.moved[i] = 0.0;
    for (int j = 0; j < 3; ++j) {
      e.shape[i][j] = axes[3 * i + j] / radius;
      e.moved[i] += e.shape[i][j] * e.centre[j];
    }
    e.outside += e.moved[i] * e.moved[i];
  }
  e.reach = largest * largest;
  e.far = square(e.centre[0]) + square(e.centre[1]) + square(e.centre[2]);
  return e;
}

// How an ellipsoid lies on the ray to a point p: it is entered at t p,
// t = (m.k - sqrt((m.k)^2 - m.m (k.k - 1))) / m.m with m = A p.
struct OnRay {
  bool covers, hides;
};

inline OnRay on_ray(const Ellipsoid& e, const double* p) {
  double mm = 0.0, mk = 0.0;
  for (int i = 0; i < 3; ++i) {
    const double m = e.shape[i][0] * p[0] + e.shape[i][1] * p[1] + e.shape[i][2] * p[2];
    mm += m * m;
    mk += m * e.moved[i];
  }
  const double discriminant = mk * mk - mm * e.outside;
  if (!(discriminant > 0.0)) return {false, false};
  return {true, mk - std::sqrt(discriminant) < (1.0 - behind) * mm};
}

// Marks points (P, 3) with other parts on their rays, and those with parts before them.
// `occluders` (B,) are the parts that can hide, `parts` (P,) those that a point is of, which do not
// hide it; points that are not valid are neither covered nor hidden.
inline void mark_visibility(const FleshTable& flesh, const Mask& occluders, const Tables& columns,
                            const Table& origins, const Places& parts, const Table& points,
                            const Mask& valid, const Array<bool, 1>& covered,
                            const Array<bool, 1>& hidden) {
  flesh.check_frames(columns, origins);
  const Index count = flesh.parts(), p = points.size();
  expect_shape("occluders", occluders, {count});
  expect_shape("points", points, {p, 3});
  expect_shape("parts", parts, {p});
  expect_shape("valid", valid, {p});
  expect_shape("covered", covered, {p});
  expect_shape("hidden", hidden, {p});
  Scratch<Ellipsoid, 1> ellipsoids(count);
  for (Index b = 0; b < count; ++b) {
    const Index s = flesh.part_segments[b];
    ellipsoids[b] = placed_ellipsoid(flesh.part_centres[b].data, flesh.part_radii[b].data,
                                     columns[s].data, origins[s].data);
  }
  const Ellipsoid* all = ellipsoids.view().data;
  for (Index n = 0; n < p; ++n) {
    covered[n] = hidden[n] = false;
    if (!valid[n]) continue;
    const double x[3] = {points(n, 0), points(n, 1), points(n, 2)};
    const double inverse = 1.0 / (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
    const Index own = parts[n];
    for (Index b = 0; b < count; ++b) {
      const Ellipsoid& e = all[b];
      const double along = e.centre[0] * x[0] + e.centre[1] * x[1] + e.centre[2] * x[2];
      if (e.far - along * along * inverse > e.reach || b == own || !occluders[b]) continue;
      const OnRay seen = on_ray(e, x);
      if (seen.covers) covered[n] = true;
      if (seen.hides) {
        hidden[n] = true;
        break;
      }
    }
  }
}

}  // namespace hmt
