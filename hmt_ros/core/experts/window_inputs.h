// Inputs of experts from windows of keypoints, N windows of S images with L landmarks; see
// hmt_ros/experts/lifter.py.
#pragma once

#include "../arrays.h"
#include "../elementary.h"

namespace hmt {

using Rays = Array<const double, 4>;

// Maximum distance of a landmark from the middle of the trunk, in extents; minimum depth of a unit
// ray, which limits its angle from the optical axis.
inline constexpr double furthest_landmark = 6.0, least_depth = 0.1;
// Scales of inputs: of times, 1/s, and of proportions; constant that is added to the log extent.
inline constexpr double time_scale = 20.0, proportion_scale = 5.0, usual_extent = 2.0;

// middles (N, 3): rays with z = 1 to the mean of the trunk landmarks that are seen in the first
// image of each window, or of all landmarks if fewer than two of the trunk are seen. Landmarks
// below the minimum confidence are not seen. rays (N, S, L, 2) are x / z and y / z.
inline void window_middles(const Rays& rays, const Tables& confidences, const Places& trunk,
                           double least_confidence, const Matrix& middles) {
  const Index n = confidences.size(0), s = confidences.size(1), count = confidences.size(2);
  expect_shape("rays", rays, {n, s, count, 2});
  expect(s > 0, "confidences", "some images");
  expect_range("trunk", trunk, 0, count);
  expect_shape("middles", middles, {n, 3});
  for (Index i = 0; i < n; ++i) {
    const Table places = rays[i][0];
    const Numbers sure = confidences[i][0];
    const auto seen = [&](Index k) { return sure[k] >= least_confidence; };
    double sum = 1e-9, x = 0.0, y = 0.0;
    const auto add = [&](Index k) {
      if (!seen(k)) return;
      sum += sure[k];
      x += sure[k] * places(k, 0);
      y += sure[k] * places(k, 1);
    };
    if (std::count_if(trunk.begin(), trunk.end(), seen) >= 2) {
      std::for_each(trunk.begin(), trunk.end(), add);
    } else {
      for (Index k = 0; k < count; ++k) add(k);
    }
    middles(i, 0) = x / sum;
    middles(i, 1) = y / sum;
    middles(i, 2) = 1.0;
  }
}

// values (N, p): positions in the plane of a camera that looks at the person, relative to their
// extent; confidences; presence and time offset of each image; the extent; gravity and proportions,
// each with a flag that is 1 if known. `axes` (N, 3, 3) are the axes of that camera, in rows; times
// (N, S) of the images, s, ideally `wanted` (S,); ups (N, 3) and persons (N, P) are 0 if unknown.
inline void fill_window_inputs(const Rays& rays, const Tables& confidences, const Table& times,
                               const Numbers& wanted, const Table& ups, const Table& persons,
                               const Tables& axes, double least_confidence,
                               const Array<float, 2>& values) {
  const Index n = confidences.size(0), s = confidences.size(1), count = confidences.size(2),
              known = persons.size(1), landmarks = s * count;
  expect_shape("rays", rays, {n, s, count, 2});
  expect_shape("times", times, {n, s});
  expect_shape("wanted", wanted, {s});
  expect_shape("ups", ups, {n, 3});
  expect_shape("persons", persons, {n, known});
  expect_shape("axes", axes, {n, 3, 3});
  expect_shape("values", values, {n, 3 * landmarks + 2 * s + 5 + known + 1});
  Scratch<double, 2> places(landmarks, 2);
  for (Index i = 0; i < n; ++i) {
    const double *ray = rays[i].data, *sure = confidences[i].data, *turn = axes[i].data,
                 *up = ups[i].data;
    float* next = values[i].data;
    const auto add = [&next](double value) { *next++ = float(value); };
    double squares = 0.0, weights = 0.0;
    for (Index k = 0; k < landmarks; ++k) {
      double* place = places[k].data;
      place[0] = place[1] = 0.0;
      if (!(sure[k] >= least_confidence)) continue;
      const double x[3] = {ray[2 * k], ray[2 * k + 1], 1.0};
      const double depth = most(dot(turn + 6, x), least_depth);
      for (Index axis = 0; axis < 2; ++axis) place[axis] = dot(turn + 3 * axis, x) / depth;
      if (k >= count) continue;
      weights += sure[k];
      squares += sure[k] * (place[0] * place[0] + place[1] * place[1]);
    }
    const double extent = std::sqrt(squares / most(weights, 0.1)) + 1e-6;
    for (double place : places.view()) {
      add(between(place / extent, -furthest_landmark, furthest_landmark));
    }
    const auto seen = [=](double x) { return x >= least_confidence; };
    for (Index k = 0; k < landmarks; ++k) add(seen(sure[k]) ? sure[k] : 0.0);
    const float* there = next;
    for (Index j = 0; j < s; ++j) {
      const double* own = sure + j * count;
      add(std::any_of(own, own + count, seen) ? 1.0 : 0.0);
    }
    for (Index j = 0; j < s; ++j) {
      add(there[j] > 0.0f ? (times(i, j) - wanted[j]) * time_scale : 0.0);
    }
    add(elementary::log(extent) + usual_extent);
    for (Index axis = 0; axis < 3; ++axis) add(dot(turn + 3 * axis, up));
    const auto is_known = [](double x) { return x != 0.0; };
    add(std::any_of(up, up + 3, is_known) ? 1.0 : 0.0);
    const Numbers person = persons[i];
    for (double x : person) add(proportion_scale * x);
    add(std::any_of(person.begin(), person.end(), is_known) ? 1.0 : 0.0);
  }
}

}  // namespace hmt
