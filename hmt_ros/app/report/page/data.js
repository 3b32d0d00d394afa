'use strict';

// The data of the page, as arrays: hmt_ros.app.report.page describes it.

const report = JSON.parse(document.getElementById('data').textContent);

/** The 16-bit integers in a base64 text. */
function integers(text) {
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i += 1) bytes[i] = binary.charCodeAt(i);
  const view = new DataView(bytes.buffer);
  const result = new Int16Array(bytes.length / 2);
  for (let i = 0; i < result.length; i += 1) result[i] = view.getInt16(2 * i, true);
  return result;
}

const NOWHERE = -32768;

/** Positions in metres: x to the right, y up, z towards the camera; NaN where a joint was not seen. */
function metres(text) {
  const raw = integers(text);
  const result = new Float32Array(raw.length);
  for (let i = 0; i < raw.length; i += 1) {
    const axis = i % 3;
    const value = raw[i] === NOWHERE ? NaN : report.origin[axis] + report.step * raw[i];
    result[i] = axis === 0 ? value : -value;
  }
  return result;
}

/** Pixels as fractions of the width of the image; NaN where a point can not be seen. */
function shares(text) {
  if (text === null) return null;
  return Float32Array.from(integers(text), (x) => (x === NOWHERE ? NaN : x * report.pixel));
}

/** Numbers of bands and heights; NaN where nothing is known. */
const numbers = (text) => Float32Array.from(integers(text), (x) => (x === NOWHERE ? NaN : x));

const TIMES = report.times;
const LAST = TIMES.length - 1;

const KINDS = ['posterior', 'smoothed', 'likelihood', 'prediction'];

/** Layers with the number of the first mode of each time. */
const layers = report.layers.map((layer) => {
  const starts = [0];
  layer.weights.forEach((weights) => starts.push(starts[starts.length - 1] + weights.length));
  return {
    ...layer,
    starts,
    style: KINDS.includes(layer.kind) ? layer.kind : 'prediction',
    positions: metres(layer.positions),
    pixels: shares(layer.pixels),
    regions: layer.regions && integers(layer.regions),
    bands: layer.bands && { ...layer.bands, values: numbers(layer.bands.values) },
  };
});

/** The person of a topic, as in humans/bodies/p1/pose_mixture; '' if it is of one alone. */
const personOf = (layer) => (layer.topic.match(/humans\/bodies\/(\w+)\//) || ['', ''])[1];
const several = new Set(layers.map(personOf)).size > 1;

/** What a topic is called on the page. */
function nameOf(layer) {
  const kind = layer.kind === 'posterior' ? 'filter' : layer.kind;
  if (!several) return kind;
  return kind === 'filter' ? personOf(layer) : `${personOf(layer)}, ${kind}`;
}

/** Layers that are compared: the filter's and the smoother's, as far as they are there. */
const compared = ['posterior', 'smoothed'].map((kind) => layers.find((layer) => layer.kind === kind)).filter(Boolean);

/** The motions of a layer, {identity, weights over time, total}, the heaviest in all first. */
function motionsOf(layer) {
  const found = new Map();
  (layer.identities || []).forEach((identities, t) => identities.forEach((identity, rank) => {
    if (!found.has(identity)) found.set(identity, { identity, total: 0, weights: TIMES.map(() => null) });
    const motion = found.get(identity);
    motion.weights[t] = (motion.weights[t] || 0) + layer.weights[t][rank];
    motion.total += layer.weights[t][rank];
  }));
  return [...found.values()].sort((a, b) => b.total - a.total);
}

const DIRECTIONS = [['to the left', 'to the right'], ['lower', 'higher'], ['farther', 'nearer']];

/** A joint of a mode, m. */
function jointOf(figure, offset, joint) {
  const i = (offset * figure.joints.length + joint) * 3;
  return [...figure.positions.slice(i, i + 3)];
}

/** The middle of the joints on which skeletons are aligned: the pelvis, or the hips. */
function originOf(figure, offset) {
  const points = figure.roots.map((joint) => jointOf(figure, offset, joint));
  return [0, 1, 2].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
}

/** The mean place of a joint from the pelvis, m, over the modes of a time that belong to a motion, or to the others. */
function meanPlace(layer, t, joint, identity, own) {
  const sum = [0, 0, 0, 0];
  layer.identities[t].forEach((each, rank) => {
    if ((each === identity) !== own) return;
    const weight = layer.weights[t][rank];
    const [place, origin] = [jointOf(layer, layer.starts[t] + rank, joint), originOf(layer, layer.starts[t] + rank)];
    [0, 1, 2].forEach((axis) => { sum[axis] += weight * (place[axis] - origin[axis]); });
    sum[3] += weight;
  });
  return sum[3] > 0 ? sum.slice(0, 3).map((x) => x / sum[3]) : null;
}

/** What a motion is called: where it is heaviest, how it differs most from the others at that time. */
function nameOfMotion(layer, { identity, weights }) {
  if (!identity) return 'without identity';
  const t = weights.reduce((best, weight, i) => (weight > (weights[best] || 0) ? i : best), 0);
  const differences = layer.joints.flatMap((name, joint) => {
    const [own, others] = [true, false].map((which) => meanPlace(layer, t, joint, identity, which));
    return own && others ? [0, 1, 2].map((axis) => ({ name, axis, by: own[axis] - others[axis] })) : [];
  }).filter(({ by }) => Number.isFinite(by));
  const at = `${TIMES[t].toFixed(1)} s`;
  if (!differences.length) return `the only one, ${at}`;
  const { name, axis, by } = differences.reduce((most, one) => (Math.abs(one.by) > Math.abs(most.by) ? one : most));
  return `${name.replaceAll('_', ' ')} ${DIRECTIONS[axis][by > 0 ? 1 : 0]}, ${at}`;
}
layers.forEach((layer) => {
  layer.motions = motionsOf(layer);
  // Names of motions that were shown: a long recording has thousands of motions.
  const names = new Map();
  layer.motionName = (identity) => {
    if (!names.has(identity)) names.set(identity, nameOfMotion(layer, layer.motions.find((one) => one.identity === identity)));
    return names.get(identity);
  };
});

/** One skeleton at each time for which it is known, with its number or -1. */
function single(figure) {
  if (!figure) return null;
  let count = 0;
  const starts = figure.known.map((known) => { count += known ? 1 : 0; return known ? count - 1 : -1; });
  return { ...figure, starts, positions: metres(figure.positions) };
}
const detector = single(report.detector);
const truth = single(report.truth);
if (truth) {
  truth.pixels = shares(report.truth.pixels);
  truth.heights = numbers(report.truth.heights);
}

const trajectories = report.trajectories.map((topic) => ({
  ...topic,
  windows: topic.windows.map((window) => ({
    ...window, ways: window.ways === null ? null : metres(window.ways),
  })),
}));

/** For each time the window that ended then, else the newest that holds it, else null. */
trajectories.forEach((topic) => {
  topic.at = TIMES.map((time) => {
    const own = topic.windows.filter((window) => (
      window.times[0] <= time + 1e-6 && window.times[window.times.length - 1] >= time - 1e-6
    ));
    const ending = own.find((window) => Math.abs(window.times[window.times.length - 1] - time) < 1e-6);
    return ending || own[own.length - 1] || null;
  });
});

/** The floor at each time: {across, along, height} with y = height - across x - along z, or null. */
const floors = TIMES.map((_, t) => {
  const plane = report.ground && report.ground.planes[t];
  if (!plane) return null;
  // As the positions: y up, z towards the camera.
  const [a, b, c, d] = [plane[0], -plane[1], -plane[2], plane[3]];
  // A floor that stands upright in the view can not carry its grid.
  return b > 0.3 ? { across: a / b, along: c / b, height: -d / b } : null;
});

/** Probability that a foot stands on the floor, by its side. */
const contactsAt = (t) => (report.ground ? report.ground.contacts[t] : {});

/** The time nearest to a number of seconds, as an index. */
function nearest(seconds) {
  let best = 0;
  for (let i = 1; i <= LAST; i += 1) {
    if (Math.abs(TIMES[i] - seconds) < Math.abs(TIMES[best] - seconds)) best = i;
  }
  return best;
}

/** A colour of the style sheet, light or dark. */
const colours = new Map();
function colour(name) {
  if (!colours.has(name)) {
    colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  }
  return colours.get(name);
}

/** A canvas that fits its place and the screen's pixels; its context, width and height in CSS px. */
function prepared(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 3);
  const width = Math.max(canvas.clientWidth, 1);
  const height = Math.max(canvas.clientHeight, 1);
  const columns = Math.round(width * ratio);
  const rows = Math.round(height * ratio);
  if (canvas.width !== columns || canvas.height !== rows) {
    canvas.width = columns;
    canvas.height = rows;
  }
  const context = canvas.getContext('2d');
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}
