// The occluding contour in the image, and its visible points; see hmt_ros/image/surface.py.
#pragma once

#include <iterator>

#include "camera.h"
#include "lanes.h"
#include "wide.h"

namespace hmt {

// Growth factor of parts that hide others, because superquadrics are larger than ellipsoids.
inline constexpr double cover = 1.04;
// Depth behind the front of another part, relative to its distance, from which a point is hidden.
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
  // (R, 2) deviation of people's contours from the model's, at the sides and in front, m
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
  // Checks that frames (S, 3, 3), (S, 3) exist for all parts.
  void check_frames(const Tables& columns, const Table& origins) const {
    expect_shape("columns", columns, {-1, 3, 3});
    expect_shape("origins", origins, {columns.size(), 3});
    expect_range("flesh.part_segments", part_segments, 0, columns.size());
  }
};

// Rings of the wanted parts side by side, n of them, padded to whole lanes; made once for many
// poses.
class RingLanes {
 public:
  RingLanes(const FleshTable& flesh, const Mask& wanted)
      : flesh_(flesh),
        which_(rings_of(flesh, wanted)),
        count_(in_whole_lanes(std::ssize(which_))),
        parts_(2 * count_),
        segments_(count_),
        extents_(flesh.parts()),
        rows_(rows, count_) {
    const Index last = std::ssize(which_) - 1;
    for (Index i = 0; i < count_; ++i) {
      const Index r = which_[std::min(i, last)], part = flesh.ring_parts[r];
      const Ring ring = flesh.ring(r);
      const double values[] = {ring.centre[0], ring.centre[1], ring.centre[2], ring.radii[0],
                               ring.radii[1],  ring.slopes[0], ring.slopes[1], ring.leans[0],
                               ring.leans[1],  ring.noise[0],  ring.noise[1]};
      for (Index k = 0; k < std::ssize(values); ++k) rows_(k, i) = values[k];
      rows_(traced_row, i) = i <= last ? 1.0 : 0.0;
      parts_[i] = parts_[count_ + i] = part;
      segments_[i] = flesh.part_segments[part];
      if (i > last) continue;
      if (ring.exponent != 1.0 || ring.slopes[0] != ring.slopes[1]) odd_.push_back(i);
      const double* middle = flesh.part_centres[part].data;
      double away[3];
      for (int k = 0; k < 3; ++k) away[k] = std::abs(ring.centre[k] - middle[k]);
      for (int k = 0; k < 2; ++k) away[k] += std::abs(ring.radii[k]);
      extents_[part] = most(extents_[part], std::sqrt(dot(away, away)));
    }
  }
  Index count() const { return count_; }
  Ring ring(Index i) const { return flesh_.ring(which_[i]); }
  // Part (2n,) of each point.
  const Index* parts() const { return parts_.view().data; }
  const Index* segments() const { return segments_.view().data; }
  // Maximum distances (B,) of the rings from the centres of their parts, m.
  const double* extents() const { return extents_.view().data; }
  // Rings that are not elliptic, or that have two different slopes.
  const std::vector<Index>& odd() const { return odd_; }
  const double* centre(int axis) const { return rows_[axis].data; }
  const double* radius(int axis) const { return rows_[3 + axis].data; }
  const double* slope(int axis) const { return rows_[5 + axis].data; }
  const double* lean(int axis) const { return rows_[7 + axis].data; }
  const double* noise(int axis) const { return rows_[9 + axis].data; }
  const double* traced() const { return rows_[traced_row].data; }  // 1 or 0

 private:
  static std::vector<Index> rings_of(const FleshTable& flesh, const Mask& wanted) {
    expect_shape("wanted", wanted, {flesh.parts()});
    std::vector<Index> result;
    for (Index r = 0; r < flesh.rings(); ++r) {
      if (wanted[flesh.ring_parts[r]]) result.push_back(r);
    }
    return result;
  }

  static constexpr Index traced_row = 11, rows = 12;
  const FleshTable& flesh_;
  const std::vector<Index> which_;
  const Index count_;
  Scratch<Index, 1> parts_, segments_;
  Scratch<double, 1> extents_;
  Scratch<double, 2> rows_;
  std::vector<Index> odd_;
};

// Points on the surface at one pose side by side: ring i of n has points i and n + i, P = 2n.
struct Contour {
  const Index* parts;         // of the points
  Index count;                // P, whole lanes
  double *x, *y, *z;          // camera frame, m
  double *u, *v;              // pixels
  std::array<double*, 6> by;  // derivative (2, 3) of the pixels by the points
  double *nx, *ny, *nz;       // normals of the surface, of any length
  double *nu, *nv;            // unit normals out of the body, in the image
  double* noise;              // standard deviation of people's contours from the point, m
  double* valid;              // 1 if the point exists and is in front of the camera, else 0
  double* covered;            // 1 if another part is on the same ray, else 0
  double* hidden;             // 1 if another part is in front on the same ray, else 0
  double *cosine, *sine;      // of the angle on the ring

  bool shows(Index i) const { return valid[i] > hidden[i]; }
  std::array<double, 3> point(Index i) const { return {x[i], y[i], z[i]}; }
};

// Room for a contour.
class ContourRoom {
 public:
  explicit ContourRoom(const RingLanes& rings)
      : parts_(rings.parts()), rows_(22, 2 * rings.count()) {}
  Contour contour() const {
    const auto row = [&](Index i) { return rows_[i].data; };
    return {parts_,  rows_.size(1), row(0),  row(1),
            row(2),  row(3),        row(4),  {row(5), row(6), row(7), row(8), row(9), row(10)},
            row(11), row(12),       row(13), row(14),
            row(15), row(16),       row(17), row(18),
            row(19), row(20),       row(21)};
  }

 private:
  const Index* parts_;
  Scratch<double, 2> rows_;
};

// sgn(x) |x|^exponent.
inline double signed_power(double x, double exponent) {
  return sign(x) * elementary::pow(std::abs(x), exponent);
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

// g(w) of hmt_ros/body/flesh.py, whose roots are the angles of the contour on a ring.
struct ContourCondition {
  double bx, by, uz, kx, ky, power;
  double operator()(double w) const {
    const auto [s, c] = elementary::sincos(w);
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
      const auto [sine, cosine] = elementary::sincos(root);
      cosines[side] = cosine;
      sines[side] = sine;
      found[side] = true;
    }
    before = at;
  }
  return found[0] && found[1];
}

// Cosines and sines (2,) of the angles of the contour on a ring that is not elliptic or has
// different slopes; false if there is no contour.
inline bool contour_angles(const Ring& ring, double bx, double by, double uz, double* cosines,
                           double* sines) {
  const ContourCondition condition{bx, by, uz, ring.slopes[0], ring.slopes[1], 2.0 - ring.exponent};
  return bracketed_roots(condition, cosines, sines);
}

// Frames (12, n) of the segments that carry rings: axes (3, 3), origin (3,).
struct RingFrames {
  explicit RingFrames(const RingLanes& rings) : rows(12, rings.count()) {}
  // Sets the frames of a pose.
  void place(const RingLanes& rings, const Tables& columns, const Table& origins) const {
    double* at = rows.view().data;
    const Index n = rings.count();
    for (Index i = 0; i < n; ++i, ++at) {
      const Index s = rings.segments()[i];
      const double *axes = columns.data + 9 * s, *origin = origins.data + 3 * s;
      for (Index k = 0; k < 9; ++k) at[k * n] = axes[k];
      for (Index k = 0; k < 3; ++k) at[(9 + k) * n] = origin[k];
    }
  }
  const double* axis(int i, int k) const { return rows[3 * i + k].data; }
  const double* origin(int k) const { return rows[9 + k].data; }

  Scratch<double, 2> rows;
};

// The direction (bx, by) in which a ring's normals face the camera, and the depth uz of the
// camera along its axis; see ContourCondition.
struct Turned {
  double x, y, depth;
};

inline Turned turned_ring(const RingLanes& rings, const RingFrames& frames, Index i) {
  double seen[3];
  for (int k = 0; k < 3; ++k) {
    seen[k] = frames.axis(k, 0)[i] * frames.origin(0)[i] +
              frames.axis(k, 1)[i] * frames.origin(1)[i] +
              frames.axis(k, 2)[i] * frames.origin(2)[i] + rings.centre(k)[i];
  }
  return {(seen[0] - seen[2] * rings.lean(0)[i]) / rings.radius(0)[i],
          (seen[1] - seen[2] * rings.lean(1)[i]) / rings.radius(1)[i], seen[2]};
}

// Sets the angles of the contour, and which points exist.
inline void find_angles(const RingLanes& rings, const RingFrames& frames, const Contour& contour) {
  const Index n = rings.count();
#pragma omp simd
  for (Index i = 0; i < n; ++i) {
    const Turned b = turned_ring(rings, frames, i);
    const double length = std::sqrt(b.x * b.x + b.y * b.y);
    const double cosine = -(1.0 - b.depth * rings.slope(0)[i]) / most(length, 1e-12);
    const double left = 1.0 - cosine * cosine, sine = std::sqrt(left > 0.0 ? left : 0.0);
    const double cm = b.x / length, sm = b.y / length;
    contour.cosine[i] = cm * cosine - sm * sine;
    contour.sine[i] = sm * cosine + cm * sine;
    contour.cosine[n + i] = cm * cosine + sm * sine;
    contour.sine[n + i] = sm * cosine - cm * sine;
    contour.valid[i] = contour.valid[n + i] = std::abs(cosine) < 1.0 ? rings.traced()[i] : 0.0;
  }
  for (const Index r : rings.odd()) {
    const Turned b = turned_ring(rings, frames, r);
    double cosines[2] = {1.0, 1.0}, sines[2] = {0.0, 0.0};
    const bool found = contour_angles(rings.ring(r), b.x, b.y, b.depth, cosines, sines);
    for (int side = 0; side < 2; ++side) {
      const Index i = r + side * n;
      contour.cosine[i] = cosines[side];
      contour.sine[i] = sines[side];
      contour.valid[i] = found ? rings.traced()[r] : 0.0;
    }
  }
}

// Sets points, their normals and their noise from angles.
inline void place_on_rings(const RingLanes& rings, const RingFrames& frames,
                           const Contour& contour) {
  const Index n = rings.count();
  for (int side = 0; side < 2; ++side) {
    double* const points[] = {contour.x + side * n, contour.y + side * n, contour.z + side * n};
    double* const normals[] = {contour.nx + side * n, contour.ny + side * n, contour.nz + side * n};
    const double *cosine = contour.cosine + side * n, *sine = contour.sine + side * n;
    double* noise = contour.noise + side * n;
#pragma omp simd
    for (Index i = 0; i < n; ++i) {
      const double c = cosine[i], s = sine[i];
      const double across = c * rings.noise(0)[i], ahead = s * rings.noise(1)[i];
      const double rx = rings.radius(0)[i], ry = rings.radius(1)[i], cz = rings.centre(2)[i];
      const double px = rings.centre(0)[i] + rx * c, py = rings.centre(1)[i] + ry * s;
      const double nx = c / rx, ny = s / ry;
      const double nz = -(rings.slope(0)[i] * c * c + rings.slope(1)[i] * s * s) -
                        (nx * rings.lean(0)[i] + ny * rings.lean(1)[i]);
      noise[i] = std::sqrt(across * across + ahead * ahead);
      for (int k = 0; k < 3; ++k) {
        const double x = frames.axis(0, k)[i], y = frames.axis(1, k)[i], z = frames.axis(2, k)[i];
        points[k][i] = frames.origin(k)[i] + x * px + y * py + z * cz;
        normals[k][i] = x * nx + y * ny + z * nz;
      }
    }
    for (const Index r : rings.odd()) {
      const Ring ring = rings.ring(r);
      if (ring.exponent == 1.0) continue;
      double axes[9], origin[3], point[3], normal[3];
      for (int k = 0; k < 9; ++k) axes[k] = frames.rows(k, r);
      for (int k = 0; k < 3; ++k) origin[k] = frames.rows(9 + k, r);
      ring_point(ring, cosine[r], sine[r], axes, origin, point, normal);
      for (int k = 0; k < 3; ++k) {
        points[k][r] = point[k];
        normals[k][r] = normal[k];
      }
    }
  }
}

// Sets pixels and their derivatives; points without a pixel are not valid.
template <class Bend>
void project_points(const Lens& lens, const Bend& bend, const Contour& contour) {
#pragma omp simd
  for (Index i = 0; i < contour.count; ++i) {
    const double z = contour.z[i], a = contour.x[i] / z, b = contour.y[i] / z;
    double pixel[2], projection[6];
    set_pixel(lens, bend(lens.coefficients, a, b), a, b, z, pixel, projection);
    contour.u[i] = pixel[0];
    contour.v[i] = pixel[1];
    for (int k = 0; k < 6; ++k) contour.by[k][i] = projection[k];
    contour.valid[i] = z > lens.near ? contour.valid[i] : 0.0;
  }
}

inline void project_points(const Lens& lens, const Contour& contour) {
  if (lens.model < 0) return project_points(lens, unbent, contour);
  if (lens.model == 0) return project_points(lens, bent_by_polynomials, contour);
  project_points(lens, bent_by_angle, contour);
}

// Sets the contour of one pose: points, pixels, normals, noise.
HMT_WIDE inline void trace_contour(const RingLanes& rings, const RingFrames& frames,
                                   const Lens& lens, const Contour& contour) {
  find_angles(rings, frames, contour);
  place_on_rings(rings, frames, contour);
  project_points(lens, contour);
#pragma omp simd
  for (Index i = 0; i < contour.count; ++i) {
    const double nu = contour.nx[i] / lens.focal[0], nv = contour.ny[i] / lens.focal[1];
    const double size = std::sqrt(nu * nu + nv * nv);
    contour.nu[i] = nu / size;
    contour.nv[i] = nv / size;
    contour.valid[i] = size > 0.0 ? contour.valid[i] : 0.0;
  }
}

// A part as an occluder, an ellipsoid: |A (x - c)| = 1.
struct Ellipsoid {
  double centre[3];  // c
  double distance;   // |c|
  double outside;    // k.k - 1
  double moved[3];   // k = A c
  double shape[3][3];
  double largest;  // radius
};

inline Ellipsoid placed_ellipsoid(const double* centre, const double* radii, const double* axes,
                                  const double* origin) {
  Ellipsoid e;
  for (int i = 0; i < 3; ++i) {
    e.centre[i] = origin[i];
    for (int j = 0; j < 3; ++j) e.centre[i] += axes[3 * j + i] * centre[j];
  }
  e.largest = 0.0;
  e.outside = -1.0;
  for (int i = 0; i < 3; ++i) {
    const double radius = cover * radii[i];
    e.largest = most(e.largest, radius);
    e.moved[i] = 0.0;
    for (int j = 0; j < 3; ++j) {
      e.shape[i][j] = axes[3 * i + j] / radius;
      e.moved[i] += e.shape[i][j] * e.centre[j];
    }
    e.outside += e.moved[i] * e.moved[i];
  }
  e.distance = std::sqrt(dot(e.centre, e.centre));
  return e;
}

// The cone in which a camera sees a ball.
struct Cone {
  double sine, cosine;
};

inline Cone cone_of(double radius, double distance) {
  const double sine = least(radius / distance, 1.0);
  return {sine, std::sqrt(1.0 - sine * sine)};
}

// Points side by side, and their own parts, which do not hide them.
struct Visible {
  Index count;  // whole lanes
  const Index* parts;
  const double *x, *y, *z, *valid;
  double *covered, *hidden;
};

// Working space for parts that may hide points of other parts, in whole lanes.
struct Occluders {
  Occluders(Index parts, Index points)
      : ellipsoids(parts), cones(parts), near(parts + 1), ends(points / lanes, 2) {}
  Scratch<Ellipsoid, 1> ellipsoids;
  Scratch<Cone, 1> cones;  // of the points of the parts
  Scratch<Index, 1> near;  // number of parts before each that one occluder may hide
  Scratch<Index, 2> ends;  // first and last part of each group of lanes
};

// Marks points from `first` on, as many as there are lanes, that an ellipsoid of part b hides: it
// is entered at t p, t = (m.k - sqrt((m.k)^2 - m.m (k.k - 1))) / m.m with m = A p.
inline void mark_lanes(const Ellipsoid& e, Index b, const Visible& points, Index first) {
  const auto& a = e.shape;
  const double k0 = e.moved[0], k1 = e.moved[1], k2 = e.moved[2], outside = e.outside;
  const double *px = points.x + first, *py = points.y + first, *pz = points.z + first;
  const double* valid = points.valid + first;
  double *covered = points.covered + first, *hidden = points.hidden + first;
  double others[lanes];
  for (int i = 0; i < lanes; ++i) others[i] = points.parts[first + i] == b ? 0.0 : valid[i];
#pragma omp simd
  for (int i = 0; i < lanes; ++i) {
    const double x = px[i], y = py[i], z = pz[i];
    const double m0 = a[0][0] * x + a[0][1] * y + a[0][2] * z;
    const double m1 = a[1][0] * x + a[1][1] * y + a[1][2] * z;
    const double m2 = a[2][0] * x + a[2][1] * y + a[2][2] * z;
    const double mm = m0 * m0 + m1 * m1 + m2 * m2, mk = m0 * k0 + m1 * k1 + m2 * k2;
    const double discriminant = mk * mk - mm * outside;
    const double root = std::sqrt(discriminant > 0.0 ? discriminant : 0.0);
    // Surfaces behind the camera cover nothing.
    const double hit = discriminant > 0.0 && mk + root > 0.0 ? others[i] : 0.0;
    const double before = mk - root < (1.0 - behind) * mm ? hit : 0.0;
    covered[i] = hit > covered[i] ? hit : covered[i];
    hidden[i] = before > hidden[i] ? before : hidden[i];
  }
}

// Marks points as covered if another part is on their ray, and as hidden if it is in front.
// `occluders` (B,) are the parts that can hide others; `extents` (B,) the maximum distances of
// points from the centres of their parts, m. Invalid points are neither covered nor hidden.
HMT_WIDE inline void mark_hidden(const FleshTable& flesh, const Mask& occluders,
                                 const double* extents, const Tables& columns, const Table& origins,
                                 const Occluders& room, const Visible& points) {
  const Index count = flesh.parts();
  std::fill_n(points.covered, points.count, 0.0);
  std::fill_n(points.hidden, points.count, 0.0);
  Ellipsoid* all = room.ellipsoids.view().data;
  Cone* cones = room.cones.view().data;
  Index *near = room.near.view().data, *ends = room.ends.view().data;
  for (Index first = 0; first < points.count; first += lanes, ends += 2) {
    const auto [low, high] =
        std::minmax_element(points.parts + first, points.parts + first + lanes);
    ends[0] = *low;
    ends[1] = *high;
  }
  for (Index b = 0; b < count; ++b) {
    const Index s = flesh.part_segments[b];
    all[b] = placed_ellipsoid(flesh.part_centres[b].data, flesh.part_radii[b].data,
                              columns.data + 9 * s, origins.data + 3 * s);
    cones[b] = cone_of(extents[b], all[b].distance);
  }
  for (Index b = 0; b < count; ++b) {
    if (!occluders[b]) continue;
    const Ellipsoid& e = all[b];
    // Balls whose cones do not touch, with a margin for rounding, do not hide each other.
    const Cone own = cone_of(e.largest, e.distance);
    for (Index a = 0; a < count; ++a) {
      const Cone& other = cones[a];
      const double limit = own.cosine * other.cosine - own.sine * other.sine - 1e-9;
      const bool apart = dot(all[a].centre, e.centre) < all[a].distance * e.distance * limit;
      near[a + 1] = near[a] + (a != b && !(apart && own.sine < 1.0));
    }
    ends = room.ends.view().data;
    for (Index first = 0; first < points.count; first += lanes, ends += 2) {
      if (near[ends[1] + 1] > near[ends[0]]) mark_lanes(e, b, points, first);
    }
  }
}

// The contour of one pose for Python, point by point, P = 2R.
struct ContourTable {
  Array<Index, 1> parts;
  Matrix points;           // (P, 3) camera frame, m
  Matrix pixels;           // (P, 2)
  Tensor projections;      // (P, 2, 3) derivative of the pixels by the points
  Matrix normals;          // (P, 2) out of the body, in the image
  Array<bool, 1> valid;    // the point exists and is in front of the camera
  Array<bool, 1> covered;  // another part is on the same ray, in front or behind
  Array<bool, 1> hidden;   // another part is in front on the same ray
  Vector noise;            // standard deviation of people's contours from the point, m

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

// For Python: fills the contour of one pose, without occlusion. `wanted` (B,) are the parts
// whose contour is traced; the others have no valid points.
void fill_contour(const FleshTable& flesh, const Mask& wanted, const Lens& lens,
                  const Tables& columns, const Table& origins, const ContourTable& result);

// Marks points (P, 3) as covered if another part is on their ray, and as hidden if it is in front.
// `occluders` (B,) are the parts that can hide others, `parts` (P,) the part of each point, which
// does not hide it. Invalid points are neither covered nor hidden.
void mark_visibility(const FleshTable& flesh, const Mask& occluders, const Tables& columns,
                     const Table& origins, const Places& parts, const Table& points,
                     const Mask& valid, const Array<bool, 1>& covered,
                     const Array<bool, 1>& hidden);

}  // namespace hmt
