// Charts: a frame with ticks, curves, and the time that a click selects.

const MARGIN = { left: 52, right: 10, top: 10, bottom: 34 };

/** Steps of 1, 2 or 5 times a power of ten between two limits, about as many as wanted. */
function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((x) => x * power).find((x) => x >= rough);
  const result = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i += 1) result.push(i * step);
  return { values: result, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}

/** A chart on a canvas. `describe` returns {x: [low, high], y: [low, high], labels: [x, y], draw}. */
class Chart {
  constructor(canvas, describe, onSeek) {
    this.canvas = canvas;
    this.describe = describe;
    if (!onSeek) return;
    const seek = (event) => {
      const [low, high] = this.describe().x;
      const inside = canvas.clientWidth - MARGIN.left - MARGIN.right;
      const share = (event.clientX - canvas.getBoundingClientRect().left - MARGIN.left) / inside;
      onSeek(low + Math.max(0, Math.min(1, share)) * (high - low));
    };
    let down = false;
    canvas.addEventListener('pointerdown', (event) => {
      down = true;
      if (event.isTrusted) canvas.setPointerCapture(event.pointerId);
      seek(event);
    });
    canvas.addEventListener('pointermove', (event) => { if (down) seek(event); });
    ['pointerup', 'pointercancel'].forEach((kind) => canvas.addEventListener(kind, () => { down = false; }));
  }

  draw() {
    if (!this.canvas.clientWidth) return;
    const { context, width, height } = prepared(this.canvas);
    const { x, y, labels, draw } = this.describe();
    const [left, right] = [MARGIN.left, width - MARGIN.right];
    const [top, bottom] = [MARGIN.top, height - MARGIN.bottom];
    const u = (value) => left + ((value - x[0]) / (x[1] - x[0])) * (right - left);
    const v = (value) => bottom - ((value - y[0]) / (y[1] - y[0])) * (bottom - top);
    context.font = '12px system-ui, sans-serif';
    context.lineWidth = 1;
    context.strokeStyle = colour('grid');
    context.fillStyle = colour('muted');
    context.textAlign = 'right';
    context.textBaseline = 'middle';
    const rows = ticks(y[0], y[1], 5);
    rows.values.forEach((value) => {
      context.beginPath();
      context.moveTo(left, v(value));
      context.lineTo(right, v(value));
      context.stroke();
      context.fillText(value.toFixed(rows.digits), left - 6, v(value));
    });
    context.textAlign = 'center';
    context.textBaseline = 'top';
    const columns = ticks(x[0], x[1], 6);
    columns.values.forEach((value) => context.fillText(value.toFixed(columns.digits), u(value), bottom + 4));
    context.fillText(labels[0], (left + right) / 2, bottom + 19);
    context.save();
    context.beginPath();
    context.rect(left - 4, top - 4, right - left + 8, bottom - top + 8);
    context.clip();
    draw(context, u, v);
    context.restore();
    context.strokeStyle = colour('axis');
    context.setLineDash([]);
    context.beginPath();
    context.moveTo(left, top);
    context.lineTo(left, bottom);
    context.lineTo(right, bottom);
    context.stroke();
    context.save();
    context.translate(11, (top + bottom) / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = 'center';
    context.textBaseline = 'middle';
    context.fillText(labels[1], 0, 0);
    context.restore();
  }
}

/** A line through points, broken where a value is null. */
function curve(context, u, v, xs, values, look) {
  context.strokeStyle = look.colour;
  context.fillStyle = look.colour;
  context.lineWidth = look.width || 1.8;
  context.setLineDash(look.dash || []);
  context.beginPath();
  let open = false;
  values.forEach((value, i) => {
    if (value === null) { open = false; return; }
    if (open) context.lineTo(u(xs[i]), v(value)); else context.moveTo(u(xs[i]), v(value));
    open = true;
  });
  context.stroke();
  context.setLineDash([]);
  if (values.filter((value) => value !== null).length > 1 && !look.dots) return;
  values.forEach((value, i) => {
    if (value === null) return;
    context.beginPath();
    context.arc(u(xs[i]), v(value), 2.5, 0, 2 * Math.PI);
    context.fill();
  });
}

/** Range of the times, widened if there is only one. */
function timeRange() {
  return LAST > 0 ? [TIMES[0], TIMES[LAST]] : [TIMES[0] - 0.5, TIMES[0] + 0.5];
}

/** A vertical line at the current time. */
function drawNow(context, u, v, y) {
  context.strokeStyle = colour('ink');
  context.lineWidth = 1.2;
  context.setLineDash([]);
  context.beginPath();
  context.moveTo(u(TIMES[shown.time]), v(y[0]));
  context.lineTo(u(TIMES[shown.time]), v(y[1]));
  context.stroke();
}

/** A colour from the accent, for the heaviest, to a faint one. */
function rankColour(rank, count) {
  const [from, to] = ['accent', 'faint'].map((name) => colour(name).match(/[0-9a-f]{2}/gi).map((x) => parseInt(x, 16)));
  const share = count > 1 ? Math.sqrt(rank / (count - 1)) : 0;
  return `rgb(${from.map((x, c) => Math.round(x + share * (to[c] - x))).join(',')})`;
}

/** How sure a layer is that a person is in view, and the detector of its keypoints. */
const confidenceCurves = (layer) => [
  { name: 'person in view', series: 'ink', dash: [5, 3], values: layer && layer.existence },
  { name: 'confidence of the detector', series: 'detector-left', dash: [], values: detector && detector.confidences },
].filter(({ values }) => values && values.some((x) => x !== null));

/** Weights of the chosen mixtures over time, one column per time, the heaviest at the bottom. */
function weightsChart({ weightsAt, layer }) {
  const x = timeRange();
  const y = [0, 1];
  return {
    x, y, labels: ['time, s', 'weight, confidence'],
    draw(context, u, v) {
      let most = 1;
      TIMES.forEach((_, t) => { most = Math.max(most, weightsAt(t).length); });
      let edge = -1;
      TIMES.forEach((time, t) => {
        const before = t > 0 ? 0.5 * (TIMES[t - 1] + time) : x[0];
        const after = t < LAST ? 0.5 * (TIMES[t + 1] + time) : x[1];
        const [from, to] = [Math.round(u(before)), Math.round(u(after))];
        if (to <= edge) return; // nothing of it would be seen
        edge = to;
        let sum = 0;
        weightsAt(t).forEach((weight, rank) => {
          context.fillStyle = rankColour(rank, most);
          context.fillRect(from, v(sum + weight), Math.max(to - from, 1), v(sum) - v(sum + weight));
          context.fillStyle = colour('panel');
          context.fillRect(from, v(sum + weight), Math.max(to - from, 1), 0.6);
          sum += weight;
        });
      });
      confidenceCurves(layer).forEach(({ series, dash, values }) => {
        curve(context, u, v, TIMES, values, { colour: colour('panel'), width: 4 });
        curve(context, u, v, TIMES, values, { colour: colour(series), dash });
      });
      drawNow(context, u, v, y);
    },
  };
}

/** Errors of a layer over time. */
const ERRORS = [
  { name: 'heaviest mode', series: 'series-1', dash: [] },
  { name: 'best of all modes', series: 'series-2', dash: [] },
  { name: 'expected', series: 'muted', dash: [2, 3] },
];
function errorCurves(layer) {
  const curves = [[], [], []];
  TIMES.forEach((_, t) => {
    const errors = layer.errors_mm[t];
    curves[0].push(errors ? errors[0] : null);
    curves[1].push(errors ? Math.min(...errors) : null);
    curves[2].push(errors ? errors.reduce((sum, x, k) => sum + x * layer.weights[t][k], 0) : null);
  });
  return curves;
}

function errorsChart(layer) {
  const curves = errorCurves(layer);
  const highest = Math.max(...curves.flat().filter((x) => x !== null));
  const y = [0, Math.max(1.08 * highest, 20)];
  return {
    x: timeRange(), y, labels: ['time, s', 'mean joint error, mm'],
    draw(context, u, v) {
      curve(context, u, v, timeRange(), [report.lost_mm, report.lost_mm], { colour: colour('axis'), width: 1 });
      if (report.lost_mm < y[1]) {
        context.fillStyle = colour('muted');
        context.textAlign = 'right';
        context.textBaseline = 'top';
        context.fillText('lost', u(timeRange()[1]) - 2, v(report.lost_mm) + 2);
      }
      ERRORS.forEach(({ series, dash }, i) => {
        curve(context, u, v, TIMES, curves[i], { colour: colour(series), dash });
      });
      drawNow(context, u, v, y);
    },
  };
}

/** Curves of what is believed of a layer over time: that a person is in view, then each cue. */
const CUES = [...[0, 1, 2, 3, 4, 5].map((i) => ({ series: `series-${i}`, dash: [] })), { series: 'muted', dash: [2, 3] }];
function beliefCurves(layer) {
  const person = { name: 'person in view', series: 'ink', dash: [5, 3], values: layer.existence };
  const cues = Object.entries(layer.cues).map(([name, values], i) => ({ name, values, ...CUES[i % CUES.length] }));
  return [...(layer.existence ? [person] : []), ...cues];
}

function beliefsChart(layer) {
  const y = [0, 1];
  return {
    x: timeRange(), y, labels: ['time, s', 'probability'],
    draw(context, u, v) {
      beliefCurves(layer).forEach(({ series, dash, values }) => {
        curve(context, u, v, TIMES, values, { colour: colour(series), dash });
      });
      drawNow(context, u, v, y);
    },
  };
}

/** Motions of a layer that have a colour of their own; all others share one box. */
const TOLD_MOTIONS = 6;

/** Weights of the motions of a layer over time. */
function motionsChart(index) {
  const y = [0, 1];
  return {
    x: timeRange(), y, labels: ['time, s', 'weight'],
    draw(context, u, v) {
      layers[index].motions.forEach(({ identity, weights }, i) => {
        const told = i < TOLD_MOTIONS;
        if (shown.hidden[index].has(identity)) return;
        curve(context, u, v, TIMES, weights, { colour: colour(told ? `series-${i}` : 'grid'), width: told ? 2 : 1 });
      });
      drawNow(context, u, v, y);
    },
  };
}

/** The colour in which a layer is compared. */
const comparedColour = (layer) => (layer.style === 'smoothed' ? 'smoothed-left' : 'posterior-right');

/** Middle and ends of a height, m, or an angle, degrees, of a layer; null where nothing is known. */
function bandOf({ bands }, { kind, name }) {
  const place = bands ? bands[kind].indexOf(name) : -1;
  if (place < 0) return null;
  const row = kind === 'joints' ? place : bands.joints.length + place;
  const width = bands.joints.length + bands.angles.length;
  const scale = kind === 'joints' ? 1e-3 : 0.1;
  return [0, 1, 2].map((end) => TIMES.map((_, t) => {
    const value = bands.values[(t * width + row) * 3 + end];
    return Number.isNaN(value) ? null : scale * value;
  }));
}

/** The true height of a joint over time, m. */
function trueHeight({ kind, name }) {
  const joint = truth && kind === 'joints' ? truth.joints.indexOf(name) : -1;
  if (joint < 0) return TIMES.map(() => null);
  return TIMES.map((_, t) => {
    const value = truth.heights[t * truth.joints.length + joint];
    return Number.isNaN(value) ? null : 1e-3 * value;
  });
}

/** A height or an angle over time with its intervals of 90 %, of filter and smoother. */
function bandsChart(what) {
  const found = compared.map((layer) => ({ layer, band: bandOf(layer, what) })).filter(({ band }) => band);
  const known = trueHeight(what);
  const y = around([...found.flatMap(({ band }) => band.flat()), ...known].filter((x) => x !== null));
  const label = what.kind === 'joints' ? `height of ${what.name}, m` : `${what.name}, degrees`;
  return {
    x: timeRange(), y, labels: ['time, s', label.replaceAll('_', ' ')],
    draw(context, u, v) {
      found.forEach(({ layer, band: [low, , high] }) => {
        context.fillStyle = colour(comparedColour(layer));
        context.globalAlpha = 0.2;
        TIMES.forEach((time, t) => {
          if (t === LAST || [low[t], low[t + 1]].includes(null)) return;
          context.beginPath();
          [[t, low], [t + 1, low], [t + 1, high], [t, high]].forEach(([at, end]) => context.lineTo(u(TIMES[at]), v(end[at])));
          context.fill();
        });
        context.globalAlpha = 1;
      });
      found.forEach(({ layer, band }) => curve(context, u, v, TIMES, band[1], { colour: colour(comparedColour(layer)) }));
      curve(context, u, v, TIMES, known, { colour: colour('ink'), dash: [5, 4], width: 1.4 });
      drawNow(context, u, v, y);
    },
  };
}

/** A range around values, which may be equal. */
function around(values) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const room = 0.06 * (high - low) || 0.5;
  return [low - room, high + room];
}

/** Free energy of the windows of all topics in their last iteration. */
function freeEnergyChart() {
  const last = trajectories.map((topic) => topic.windows.filter((w) => w.free_energy.length).map((w) => ({
    time: w.times[w.times.length - 1], value: w.free_energy[w.free_energy.length - 1],
  })));
  const y = around(last.flat().map((w) => w.value));
  return {
    x: timeRange(), y, labels: ['end of the window, s', 'free energy, nats'],
    draw(context, u, v) {
      last.forEach((windows, i) => {
        const look = { colour: colour(`series-${i % 6}`), dots: windows.length < 80 };
        curve(context, u, v, windows.map((w) => w.time), windows.map((w) => w.value), look);
      });
      drawNow(context, u, v, y);
    },
  };
}

/** Free energy over the iterations of the current windows. */
function iterationsChart() {
  const traces = trajectories.map((topic) => (topic.at[shown.time] || { free_energy: [] }).free_energy);
  const values = traces.flat();
  const most = Math.max(...traces.map((trace) => trace.length));
  return {
    x: [0, Math.max(most - 1, 1)], y: values.length ? around(values) : [0, 1],
    labels: ['iteration', 'free energy, nats'],
    draw(context, u, v) {
      traces.forEach((trace, i) => curve(
        context, u, v, trace.map((_, step) => step), trace, { colour: colour(`series-${i % 6}`), dots: trace.length < 40 },
      ));
    },
  };
}

/** Coverage of regions over their probability. */
function calibrationChart(which) {
  return {
    x: [0, 1], y: [0, 1], labels: ['probability of the region', 'fraction of true positions in it'],
    draw(context, u, v) {
      curve(context, u, v, [0, 1], [0, 1], { colour: colour('axis'), width: 1 });
      context.fillStyle = colour('muted');
      context.textBaseline = 'middle';
      [['left', 0.04, 0.95, 'above: too vague'], ['right', 0.97, 0.06, 'below: too sure']].forEach(([align, x, y, text]) => {
        context.textAlign = align;
        context.fillText(text, u(x), v(y));
      });
      Object.values(report.scores.topics).forEach((topic, i) => {
        const covered = topic.calibration[which];
        if (covered) curve(context, u, v, report.scores.probabilities, covered, { colour: colour(`series-${i % 6}`) });
      });
    },
  };
}
