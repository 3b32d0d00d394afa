#include "pose_energy.h"

#include "elementary.h"
#include "wide.h"

namespace hmt {

namespace {

// Working space, reused for all poses.
class PoseEnergy {
 public:
  // `point` (d,) has the values of variables that are not in `free` (f,); `apart`: whether cues are
  // summed separately.
  PoseEnergy(const Terms& terms, const Numbers& point, const Places& free, bool apart)
      : terms_(terms),
        free_(free),
        cues_(apart ? 3 : 1),
        pose_(point.size()),
        axes_(point.size(), 3),
        dof_origins_(point.size(), 3),
        view_(terms.model),
        segments_(terms.placing.segments()),
        energies_(term_count),
        values_(cues_),
        gradients_(cues_, point.size()),
        hessians_(cues_, point.size(), point.size()),
        prior_room_(terms.prior),
        keypoint_room_(terms.keypoints),
        overlap_room_(terms.overlaps),
        pulled_(free.size()) {
    pose_.view().copy_from(point);
    for (Index i = 0; i < free.size(); ++i) all_free_ &= free[i] == i;
  }

  const Vector& values() const { return values_; }
  const Tensor& hessians() const { return hessians_; }

  // Energy at x (f,) of point `number` of a call, which belongs to the problem `row`; slope (f,)
  // and curve (f, f) become its derivatives if wanted. `exact`: whether the Hessian of the prior is
  // exact.
  double at(Index number, Index row, const Numbers& x, bool exact, bool wanted, const Vector& slope,
            const Matrix& curve) {
    const Index f = free_.size();
    for (Index i = 0; i < f; ++i) pose_[free_[i]] = x[i];
    double value = add_terms(number, row, exact, wanted);
    if (wanted && all_free_) {
      slope.copy_from(gradients_[0]);
      curve.copy_from(hessians_[0]);
    } else if (wanted) {
      for (Index i = 0; i < f; ++i) slope[i] = gradients_(0, free_[i]);
      for (Index i = 0; i < f; ++i) {
        for (Index j = 0; j < f; ++j) curve(i, j) = hessians_(0, free_[i], free_[j]);
      }
    }
    if (wanted) {
      for (Index cue = 1; cue < cues_; ++cue) {
        for (Index i = 0; i < f; ++i) {
          slope[i] += gradients_(cue, free_[i]);
          for (Index j = 0; j < f; ++j) curve(i, j) += hessians_(cue, free_[i], free_[j]);
        }
      }
    }
    if (terms_.centres.size() > 0) {
      const Index own = terms_.centres.size() > 1 ? row : 0;
      value += add_motion(terms_.centres[own], terms_.precisions[own], x, wanted, slope, curve);
    }
    return value;
  }

 private:
  // Energy of the pose without the motion prior; sets derivatives by the pose.
  double add_terms(Index number, Index row, bool exact, bool wanted) {
    const Index keypoints = std::min<Index>(1, cues_ - 1), others = cues_ - 1;
    const Tensor& columns = view_.columns;
    const Matrix& origins = view_.origins;
    const Vector slope = gradients_[others];
    const Matrix curve = hessians_[others];
    const Sums sums = wanted ? Sums{segments_.view(), {}} : Sums{};
    values_.fill(0.0);
    if (wanted) {  // the prior sets those of the last cue
      gradients_.view().rows(0, others).fill(0.0);
      hessians_.view().rows(0, others).fill(0.0);
    }
    sums.clear();
    place_pose(terms_.placing, pose_, columns, origins, axes_, dof_origins_);
    values_[others] = evaluate_prior(terms_.prior, pose_, exact, wanted, slope, curve, prior_room_);
    if (terms_.image) {
      look(view_, number, terms_.contour);
      energies_.fill(0.0);
      run_terms(view_, terms_.inputs, energies_, sums);
      double energy = 0.0;
      for (Index term = 0; term < term_count; ++term) energy += energies_[term];
      values_[0] += energy;
      if (wanted && cues_ > 1) assemble(0);
    }
    const KeypointInputs& seen = terms_.keypoints;
    if (seen.points.groups.size() > 0 || seen.lifted.weight > 0.0) {
      const Numbers log_prior = seen.log_priors[seen.log_priors.size() > 1 ? row : 0];
      values_[keypoints] +=
          add_keypoints(seen, log_prior, columns, origins, axes_, dof_origins_, sums,
                        gradients_[keypoints], hessians_[keypoints], keypoint_room_);
      if (wanted && cues_ > 1) assemble(keypoints);
    }
    double& known = values_[others];
    if (terms_.overlaps.sigma < infinity) {
      add_overlaps(terms_.overlaps, columns, origins, axes_, dof_origins_, wanted, known, slope,
                   curve, overlap_room_);
    }
    if (terms_.ground.on()) {
      known += add_ground_energy(terms_.ground, columns, origins, axes_, dof_origins_, wanted,
                                 slope, curve);
    }
    if (terms_.flow.weight > 0.0) {
      add_flow(terms_.flow, terms_.model.lens, row, view_.frames(), sums, known);
    }
    if (wanted) assemble(others);
    double total = 0.0;
    for (Index cue = 0; cue < cues_; ++cue) total += values_[cue];
    return total;
  }

  // Converts the sums over segments to derivatives of a cue, and resets the sums.
  void assemble(Index cue) {
    assemble_pose(terms_.model.tree, axes_, dof_origins_, segments_, gradients_[cue],
                  hessians_[cue]);
    segments_.fill({});
  }

  // Energy of the motion prior at x (f,); adds its derivatives if wanted.
  double add_motion(const Numbers& centre, const Table& precision, const Numbers& x, bool wanted,
                    const Vector& slope, const Matrix& curve) {
    const Index f = x.size();
    const double nu = terms_.tails;
    pulled_.fill(0.0);
    for (Index j = 0; j < f; ++j) {  // along rows of a symmetric matrix, many entries at once
      const double moved = x[j] - centre[j];
      const double* line = precision[j].data;
      for (Index i = 0; i < f; ++i) pulled_[i] += line[i] * moved;
    }
    double distance = 0.0;
    for (Index i = 0; i < f; ++i) distance += pulled_[i] * (x[i] - centre[i]);
    double value = 0.5 * distance, shrinkage = 1.0;
    if (nu > 0.0) {
      value = 0.5 * (nu + f) * elementary::log1p(distance / nu);
      shrinkage = (nu + f) / (nu + distance);
    }
    if (!wanted) return value;
    for (Index i = 0; i < f; ++i) {
      slope[i] += shrinkage * pulled_[i];
      const double* line = precision[i].data;
      double* own = curve[i].data;
      for (Index j = 0; j < f; ++j) own[j] += shrinkage * line[j];
    }
    return value;
  }

  const Terms& terms_;
  const Places free_;
  const Index cues_;
  bool all_free_ = free_.size() == terms_.placing.dimension();
  Scratch<double, 1> pose_;
  Scratch<double, 2> axes_, dof_origins_;
  PoseView view_;
  Scratch<SegmentSums, 1> segments_;
  Scratch<double, 1> energies_, values_;
  Scratch<double, 2> gradients_;
  Scratch<double, 3> hessians_;
  PriorRoom prior_room_;
  KeypointRoom keypoint_room_;
  OverlapRoom overlap_room_;
  Scratch<double, 1> pulled_;
};

// Sets the next trial from a step, within the limits. A variable that reaches a limit is set to
// exactly this limit, despite rounding.
void try_step(const Numbers& x, const Numbers& step, const Numbers& low, const Numbers& high,
              const Table& limits, const Vector& trial) {
  for (Index i = 0; i < x.size(); ++i) {
    trial[i] = step[i] <= low[i]    ? limits(0, i)
               : step[i] >= high[i] ? limits(1, i)
                                    : between(x[i] + step[i], limits(0, i), limits(1, i));
  }
}

void check(Index first, Index last, const Terms& terms, const Numbers& point, const Places& free,
           const Places& rows, const Table& limits, const Descent& descent, const Matrix& x,
           const Vector& value, const Matrix& gradient, const Tensor& hessian, const ByCue& by_cue,
           const Array<std::int8_t, 1>& status, const Array<std::int32_t, 1>& iterations,
           const Array<bool, 2>& moving) {
  const Index n = x.size(), f = free.size(), d = terms.placing.dimension();
  expect(0 <= first && first <= last && last <= n, "last", "a range of the points x");
  expect_shape("point", point, {d});
  expect_range("free", free, 0, d);
  expect_shape("x", x, {n, f});
  for (Index i = first; i < last; ++i) {
    for (double number : x[i]) expect(std::isfinite(number), "x", "finite numbers");
  }
  expect_shape("rows", rows, {rows.empty() ? 0 : n});
  expect_range("rows", rows, 0, terms.problems());
  expect(!rows.empty() || n <= terms.problems(), "rows", "the problem of each point");
  expect_shape("limits", limits, {2, d});
  expect_shape("moving", moving, {moving.size() > 0 ? n : 0, f});
  expect_shape("descent.scale", descent.scale, {moving.size() > 0 ? d : -1});
  expect_shape("value", value, {n});
  const Index wanted = gradient.size() > 0 ? n : 0;
  expect(wanted || moving.size() == 0, "gradient", "room for derivatives, which minima need");
  expect_shape("gradient", gradient, {wanted, f});
  expect_shape("hessian", hessian, {wanted, f, f});
  const auto& [values, hessians] = by_cue;
  if (values.size() > 0) {
    expect(f == d, "free", "all variables where cues are wanted apart");
    expect_shape("by_cue[0]", values, {n, 3});
    expect_shape("by_cue[1]", hessians, {wanted, 3, d, d});
  }
  if (terms.centres.size() > 0) expect_shape("terms.centres", terms.centres, {-1, f});
  expect_shape("status", status, {n});
  expect_shape("iterations", iterations, {n});
  check_inputs("compiled.inputs", terms.inputs, terms.placing.segments(), n);
}

}  // namespace

void solve(Index first, Index last, const Terms& terms, const Numbers& point, const Places& free,
           const Places& rows, bool exact, const Table& limits, const Descent& descent,
           const Matrix& x, const Vector& value, const Matrix& gradient, const Tensor& hessian,
           const ByCue& by_cue, const Array<std::int8_t, 1>& status,
           const Array<std::int32_t, 1>& iterations, const Array<bool, 2>& moving) {
  check(first, last, terms, point, free, rows, limits, descent, x, value, gradient, hessian, by_cue,
        status, iterations, moving);
  const Index f = free.size(), most_turns = moving.size() > 0 ? descent.most : 0;
  const auto& [values, hessians] = by_cue;
  const bool apart = values.size() > 0, wanted = gradient.size() > 0;
  PoseEnergy energy(terms, point, free, apart);
  BoxStep box(f);
  Scratch<double, 1> slope(f), low(f), high(f), step(f), trial(f), metric(f);
  Scratch<double, 2> curve(f, f), ends(2, f);
  for (Index i = 0; i < f && moving.size() > 0; ++i) {
    metric[i] = 1.0 / square(descent.scale[free[i]]);
    for (int end = 0; end < 2; ++end) ends(end, i) = limits(end, free[i]);
  }
  for (Index n = first; n < last; ++n) {
    for (Index i = 0; i < f && moving.size() > 0; ++i) {
      x(n, i) = between(x(n, i), ends(0, i), ends(1, i));
    }
    double shift = descent.damping, growth = 2.0, predicted = 0.0;
    Status result = Status::iteration_limit;
    for (Index turn = 0; turn <= most_turns; ++turn) {
      if (turn == 0) {
        trial.view().copy_from(x[n]);
      } else {
        for (Index i = 0; i < f; ++i) {
          low[i] = ends(0, i) - x(n, i);
          high[i] = ends(1, i) - x(n, i);
        }
        predicted = box.take(gradient[n], hessian[n], low, high, shift, metric, step);
        if (predicted < descent.tolerance) {
          result = Status::converged;
          break;
        }
        try_step(x[n], step, low, high, ends, trial);
      }
      const double found =
          energy.at(n, rows.empty() ? n : rows[n], trial, exact, wanted, slope, curve);
      if (apart) {
        values[n].copy_from(energy.values());
        if (wanted) hessians[n].copy_from(energy.hessians());
      }
      bool better = true;
      if (turn == 0) {
        if (!std::isfinite(found)) result = Status::not_finite;
      } else {
        ++iterations[n];
        const double ratio = std::isfinite(found) ? (value[n] - found) / predicted : -infinity;
        better = ratio > least_ratio;
        if (better) {
          const double trusted = 2.0 * least(ratio, 2.0) - 1.0;
          shift *= most(least_factor, 1.0 - trusted * trusted * trusted);
          growth = 2.0;
        } else {
          shift *= growth;
          growth *= 2.0;
          if (shift > damping_limit) result = Status::stalled;
        }
      }
      if (better) {
        x[n].copy_from(trial);
        value[n] = found;
        if (wanted) {
          gradient[n].copy_from(slope);
          hessian[n].copy_from(curve);
        }
      }
      if (result != Status::iteration_limit) break;
    }
    status[n] = static_cast<std::int8_t>(result);
    for (Index i = 0; i < f && moving.size() > 0; ++i) {
      const double at = x(n, i), slope_there = gradient(n, i);
      moving(n, i) =
          !((at <= ends(0, i) && slope_there > 0.0) || (at >= ends(1, i) && slope_there < 0.0));
    }
  }
}

void record_residuals(const Model& model, const TermInputs& inputs,
                      const Array<const double, 4>& columns, const Tables& origins,
                      const Tensor& residuals) {
  const Index n = columns.size(), segments = model.tree.segments();
  expect_shape("columns", columns, {n, segments, 3, 3});
  expect_shape("origins", origins, {n, segments, 3});
  expect_shape("residuals", residuals, {n, -1, Sums::recorded});
  expect(residuals.size(1) > 0, "residuals", "a row that counts the residuals");
  for (Index i = 0; i < n; ++i) expect(residuals(i, 0, 0) == 0.0, "residuals", "counts of 0");
  check_inputs("inputs", inputs, segments, n);
  PoseView view(model);
  Scratch<double, 1> energies(term_count);
  for (Index i = 0; i < n; ++i) {
    view.columns.view().copy_from(columns[i]);
    view.origins.view().copy_from(origins[i]);
    look(view, i, true);
    run_terms(view, inputs, energies, Sums{{}, residuals[i]});
  }
}

// ---- Parts of the energy for Python, in this file so that they are compiled once.

void box_steps(const Table& x, const Table& gradient, const Tables& hessian, const Table& lower,
               const Table& upper, const Numbers& lam, const Numbers& metric, const Places& rows,
               const Matrix& step, const Vector& predicted) {
  const Index problems = x.size(), d = x.size(1), count = rows.size();
  expect_shape("gradient", gradient, {problems, d});
  expect_shape("hessian", hessian, {problems, d, d});
  expect_shape("lower", lower, {problems, d});
  expect_shape("upper", upper, {problems, d});
  expect_shape("lam", lam, {problems});
  expect_shape("metric", metric, {d});
  expect_range("rows", rows, 0, problems);
  expect_shape("step", step, {count, d});
  expect_shape("predicted", predicted, {count});
  const Scratch<double, 1> low(d), high(d);
  BoxStep box(d);
  for (Index k = 0; k < count; ++k) {
    const Index n = rows[k];
    for (Index i = 0; i < d; ++i) {
      low[i] = lower(n, i) - x(n, i);
      high[i] = upper(n, i) - x(n, i);
    }
    predicted[k] = box.take(gradient[n], hessian[n], low, high, lam[n], metric, step[k]);
  }
}

void evaluate_prior_at(const PriorModel& model, const Table& poses, const Vector& value,
                       const Matrix& gradient, const Tensor& hessian) {
  const Index n = poses.size(), d = model.dimension();
  expect_shape("poses", poses, {n, d});
  expect_shape("value", value, {n});
  expect_shape("gradient", gradient, {n, d});
  expect_shape("hessian", hessian, {n, d, d});
  const PriorRoom room(model);
  for (Index i = 0; i < n; ++i) {
    value[i] = evaluate_prior(model, poses[i], false, true, gradient[i], hessian[i], room);
  }
}

void add_overlaps_of_pose(const Overlaps& overlaps, const Tables& columns, const Table& origins,
                          const Table& axes, const Table& dof_origins, bool wanted,
                          const Vector& value, const Vector& gradient, const Matrix& hessian) {
  const Index d = overlaps.dof_is_rotation.size();
  expect_frames(overlaps.moves.size(), d, columns, origins, axes, dof_origins);
  expect_shape("value", value, {1});
  expect_shape("gradient", gradient, {d});
  expect_shape("hessian", hessian, {d, d});
  const OverlapRoom room(overlaps);
  add_overlaps(overlaps, columns, origins, axes, dof_origins, wanted, value[0], gradient, hessian,
               room);
}

HMT_WIDE double add_ground_energy(const GroundConstants& ground, const Tables& columns,
                                  const Table& origins, const Table& axes, const Table& dof_origins,
                                  bool wanted, const Vector& gradient, const Matrix& hessian) {
  const Index d = ground.dimension();
  expect_frames(ground.moves.size(), d, columns, origins, axes, dof_origins);
  expect_shape("gradient", gradient, {d});
  expect_shape("hessian", hessian, {d, d});
  const Scratch<double, 1> row(d);
  double total = 0.0;
  if (ground.weights[0] > 0.0) {
    total += add_upright(ground, columns, axes, row, wanted, gradient, hessian);
  }
  if (ground.weights[1] > 0.0) {
    total += add_floor(ground, columns, origins, axes, dof_origins, row, wanted, gradient, hessian);
  }
  return total;
}

void fill_contour(const FleshTable& flesh, const Mask& wanted, const Lens& lens,
                  const Tables& columns, const Table& origins, const ContourTable& result) {
  flesh.check_frames(columns, origins);
  const Index rings = flesh.rings();
  expect_shape("contour.parts", result.parts, {2 * rings});
  expect_shape("wanted", wanted, {flesh.parts()});
  const Scratch<bool, 1> all(flesh.parts());
  all.fill(true);
  const RingLanes side_by_side(flesh, all.view());
  const RingFrames frames(side_by_side);
  const ContourRoom room(side_by_side);
  const Contour contour = room.contour();
  frames.place(side_by_side, columns, origins);
  trace_contour(side_by_side, frames, lens, contour);
  for (Index m = 0; m < 2 * rings; ++m) {
    const Index i = m < rings ? m : m - rings + side_by_side.count();
    result.parts[m] = contour.parts[i];
    result.points[m].copy_from({contour.point(i).data(), {3}});
    result.pixels(m, 0) = contour.u[i];
    result.pixels(m, 1) = contour.v[i];
    for (int k = 0; k < 6; ++k) result.projections[m].data[k] = contour.by[k][i];
    result.normals(m, 0) = contour.nu[i];
    result.normals(m, 1) = contour.nv[i];
    result.valid[m] = contour.valid[i] > 0.0 && wanted[contour.parts[i]];
    result.noise[m] = contour.noise[i];
  }
}

void mark_visibility(const FleshTable& flesh, const Mask& occluders, const Tables& columns,
                     const Table& origins, const Places& parts, const Table& points,
                     const Mask& valid, const Array<bool, 1>& covered,
                     const Array<bool, 1>& hidden) {
  flesh.check_frames(columns, origins);
  const Index count = flesh.parts(), p = points.size(), whole = in_whole_lanes(p);
  expect_shape("occluders", occluders, {count});
  expect_shape("points", points, {p, 3});
  expect_shape("parts", parts, {p});
  expect_range("parts", parts, 0, count);
  expect_shape("valid", valid, {p});
  expect_shape("covered", covered, {p});
  expect_shape("hidden", hidden, {p});
  if (p == 0) return;
  const Scratch<double, 2> rows(6, whole);
  const Scratch<double, 1> extents(count);
  const Scratch<Index, 1> parts_of(whole);
  for (Index i = 0; i < whole; ++i) {
    const Index n = std::min(i, p - 1), part = parts[n], s = flesh.part_segments[part];
    const double *axes = columns[s].data, *middle = flesh.part_centres[part].data;
    double away[3];
    for (int k = 0; k < 3; ++k) {
      rows(k, i) = points(n, k);
      away[k] = points(n, k) - (origins(s, k) + axes[k] * middle[0] + axes[3 + k] * middle[1] +
                                axes[6 + k] * middle[2]);
    }
    rows(3, i) = valid[n];
    parts_of[i] = part;
    extents[part] = most(extents[part], std::sqrt(dot(away, away)));
  }
  const auto row = [&](int k) { return rows[k].data; };
  mark_hidden(flesh, occluders, extents.view().data, columns, origins, Occluders(count, whole),
              {whole, parts_of.view().data, row(0), row(1), row(2), row(3), row(4), row(5)});
  for (Index n = 0; n < p; ++n) {
    covered[n] = rows(4, n) > 0.0;
    hidden[n] = rows(5, n) > 0.0;
  }
}

}  // namespace hmt
