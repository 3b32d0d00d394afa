// Skeletons in a 3D view that turns, and skeletons on the image.

const FAINTEST = 0.12;
// Distance of the viewer, in radii of the visible room.
const DISTANCE = 5;
// Radii of the parts of a shadow, m: the more lie over each other, the darker.
const SHADOW = [0.18, 0.16, 0.14, 0.12, 0.1, 0.08, 0.06, 0.04];
const DASHES = { likelihood: [5, 3], prediction: [2, 3] };

/**
 * What is shown: indices of layers, truth, detector, trajectories, regions of the joints; of one layer
 * a single mode, or all; by layer the identities of motions that are hidden; whether filter, smoother
 * and detector are side by side.
 */
const shown = {
  time: 0, layers: new Set(), truth: false, detector: false, trajectories: false, regions: false, chosen: 0, alone: null,
  hidden: layers.map(() => new Set()), beside: false,
};

/** Strength of a mode, and null where it is not drawn. */
function strength(index, rank, weights) {
  const identities = layers[index].identities;
  if (identities && shown.hidden[index].has(identities[shown.time][rank])) return null;
  if (shown.alone !== null && index === shown.chosen) return rank === shown.alone ? 1 : null;
  return FAINTEST + (1 - FAINTEST) * (weights[0] > 0 ? weights[rank] / weights[0] : 1);
}

/** What is drawn side by side. */
const besides = [...compared, detector].filter(Boolean);

/** Modes to be drawn at the present time, the faintest first: {layer, offset, strength, rank}. */
function modesNow() {
  const result = [];
  layers.forEach((layer, index) => {
    if (!shown.layers.has(index)) return;
    const weights = layer.weights[shown.time];
    for (let rank = weights.length - 1; rank >= 0; rank -= 1) {
      const own = strength(index, rank, weights);
      if (own !== null) {
        result.push({
          figure: layer, style: layer.style, offset: layer.starts[shown.time] + rank, strength: own,
          dash: DASHES[layer.style] || [], width: rank === 0 || shown.alone === rank ? 4 : 2, ink: null,
        });
      }
    }
  });
  [[detector, shown.detector, [9, 3], 2.5, null], [truth, shown.truth, [5, 4], 1.5, 'ink']].forEach(([figure, on, dash, width, ink]) => {
    if (!figure || !on || figure.starts[shown.time] < 0) return;
    result.push({ figure, style: 'detector', offset: figure.starts[shown.time], strength: 1, dash, width, ink });
  });
  return result;
}

/** The 3D view: turns about the vertical (yaw) and tilts (pitch), in degrees; zoom 1 shows all. */
class Space {
  constructor(canvas) {
    this.canvas = canvas;
    this.follow = false;
    this.together = false;
    this.measure();
    this.reset();
    this.listen();
  }

  /** The centre of all modes, and the room that they take, in space and around the pelvis. */
  measure() {
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    const floor = [];
    let own = 0;
    const figure = layers[0] || truth;
    this.roots = TIMES.map((_, t) => {
      const offset = this.heaviest(figure, t);
      return offset < 0 ? null : originOf(figure, offset);
    });
    const include = (point) => point.forEach((x, axis) => {
      low[axis] = Math.min(low[axis], x);
      high[axis] = Math.max(high[axis], x);
    });
    TIMES.forEach((_, t) => {
      if (!this.roots[t]) return;
      let lowest = Infinity;
      const modes = figure === truth ? 1 : figure.weights[t].length;
      for (let rank = 0; rank < modes; rank += 1) {
        for (let joint = 0; joint < figure.joints.length; joint += 1) {
          const point = jointOf(figure, this.heaviest(figure, t) + rank, joint);
          include(point);
          const [dx, dy, dz] = point.map((x, axis) => x - this.roots[t][axis]);
          own = Math.max(own, Math.abs(dy), Math.hypot(dx, dz));
          if (rank === 0) lowest = Math.min(lowest, point[1]);
        }
      }
      floor.push(lowest);
    });
    if (!floor.length) {
      const ways = trajectories.flatMap((topic) => topic.windows.map((w) => w.ways).filter(Boolean));
      ways.forEach((way) => { for (let i = 0; i < way.length; i += 3) include([...way.slice(i, i + 3)]); });
      if (!ways.length) { low.fill(-1); high.fill(1); }
      floor.push(low[1]);
    }
    floor.sort((a, b) => a - b);
    this.floor = floor[Math.floor(floor.length * 0.1)];
    this.centre = low.map((x, axis) => 0.5 * (x + high[axis]));
    const half = low.map((x, axis) => 0.5 * (high[axis] - x));
    this.room = Math.max(half[1], Math.hypot(half[0], half[2]), 0.3);
    this.ownRoom = Math.max(own, 0.3);
    const roots = this.roots.filter(Boolean);
    this.follow = [0, 2].some((axis) => {
      const values = roots.map((root) => root[axis]);
      return values.length > 0 && Math.max(...values) - Math.min(...values) > 1.5;
    });
  }

  heaviest(figure, t) {
    if (!figure) return -1;
    if (!figure.weights) return figure.starts[t];
    return figure.weights[t].length ? figure.starts[t] : -1;
  }

  /** Half of the visible room at zoom 1, m. */
  get radius() {
    return 1.12 * (this.follow && this.lastRoot() ? this.ownRoom : this.room);
  }

  reset() {
    this.yaw = 40;
    this.pitch = 12;
    this.zoom = 1;
  }

  turn(yaw, pitch) {
    this.yaw = ((yaw + 180) % 360 + 360) % 360 - 180;
    this.pitch = Math.max(-89, Math.min(89, pitch));
    this.draw();
  }

  magnify(factor) {
    this.zoom = Math.max(0.3, Math.min(8, this.zoom * factor));
    this.draw();
  }

  listen() {
    const { canvas } = this;
    const fingers = new Map();
    let from = null;
    canvas.addEventListener('pointerdown', (event) => {
      fingers.set(event.pointerId, event);
      from = { x: event.clientX, y: event.clientY, yaw: this.yaw, pitch: this.pitch };
      // A pointer that a program made up can not be captured, and need not.
      if (event.isTrusted) canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener('pointermove', (event) => {
      if (!from) return;
      const apart = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY); };
      const before = fingers.size > 1 ? apart() : 0;
      fingers.set(event.pointerId, event);
      if (before) this.magnify(apart() / before);
      else this.turn(from.yaw + 0.5 * (event.clientX - from.x), from.pitch + 0.4 * (event.clientY - from.y));
    });
    ['pointerup', 'pointercancel'].forEach((kind) => canvas.addEventListener(kind, () => { from = null; fingers.clear(); }));
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      this.magnify(Math.exp(-0.0015 * event.deltaY));
    }, { passive: false });
    canvas.addEventListener('dblclick', () => { this.reset(); this.draw(); });
    const keys = {
      ArrowLeft: () => this.turn(this.yaw - 5, this.pitch),
      ArrowRight: () => this.turn(this.yaw + 5, this.pitch),
      ArrowUp: () => this.turn(this.yaw, this.pitch + 5),
      ArrowDown: () => this.turn(this.yaw, this.pitch - 5),
      '+': () => this.magnify(1.15),
      '=': () => this.magnify(1.15),
      '-': () => this.magnify(1 / 1.15),
      0: () => { this.reset(); this.draw(); },
    };
    canvas.addEventListener('keydown', (event) => {
      if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  /** The projection of the present view: point (x, y, z) to [u, v, depth]. */
  projection(width, height) {
    const yaw = (this.yaw * Math.PI) / 180;
    const pitch = (this.pitch * Math.PI) / 180;
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const distance = DISTANCE * this.radius;
    // People are taller than wide.
    const scale = (0.5 * Math.min(1.6 * width, height) * this.zoom * distance) / this.radius;
    const root = this.follow ? this.lastRoot() : null;
    const centre = root || this.centre;
    return (x, y, z) => {
      const [dx, dy, dz] = [x - centre[0], y - centre[1], z - centre[2]];
      const right = cy * dx - sy * dz;
      const ahead = sy * dx + cy * dz;
      const up = cp * dy - sp * ahead;
      const near = sp * dy + cp * ahead;
      const depth = Math.max(distance - near, 0.05 * distance);
      return [width / 2 + (scale * right) / depth, height / 2 - (scale * up) / depth, depth];
    };
  }

  /** The present or last known origin of the person. */
  lastRoot() {
    for (let t = shown.time; t >= 0; t -= 1) if (this.roots[t]) return this.roots[t];
    return this.roots.find(Boolean) || null;
  }

  /** All in one view; or those of filter, smoother and detector that are on from left to right, each with the truth. */
  draw() {
    const { context, width, height } = prepared(this.canvas);
    context.lineCap = 'round';
    context.lineJoin = 'round';
    const on = besides.filter((figure) => (figure === detector ? shown.detector : shown.layers.has(layers.indexOf(figure))));
    const panes = shown.beside && on.length > 1 ? on : [null];
    const each = width / panes.length;
    panes.forEach((pane, i) => {
      context.save();
      context.translate(i * each, 0);
      context.beginPath();
      context.rect(0, 0, each, height);
      context.clip();
      this.drawPane(context, each, height, pane);
      if (pane) {
        context.strokeStyle = colour('line');
        context.strokeRect(0, -1, each, height + 2);
        context.fillStyle = colour('ink');
        context.font = '600 13px system-ui, sans-serif';
        context.textAlign = 'left';
        context.textBaseline = 'top';
        context.fillText(pane === detector ? 'detector' : nameOf(pane), 10, 8);
      }
      context.restore();
    });
  }

  drawPane(context, width, height, pane) {
    const project = this.projection(width, height);
    this.drawFloor(context, project, width, height);
    if (shown.trajectories && (!pane || pane.kind === 'smoothed')) this.drawWays(context, project);
    const here = ({ figure }) => [null, figure].includes(pane) || figure === truth || (pane === layers[0] && !besides.includes(figure));
    const segments = [];
    const finer = Math.min(1, width / 250);
    const root = this.lastRoot() || this.centre;
    const bodies = modesNow().filter(here).map((mode) => {
      const own = originOf(mode.figure, mode.offset);
      const place = (x, axis) => (this.together ? x + root[axis] - own[axis] : x);
      return { ...mode, places: mode.figure.joints.map((_, joint) => jointOf(mode.figure, mode.offset, joint).map(place)) };
    });
    bodies.forEach((body) => this.drawShadow(context, project, body));
    if (shown.regions) bodies.forEach((body) => this.drawRegions(context, project, body));
    bodies.forEach((mode) => {
      const { figure } = mode;
      const points = mode.places.map((place) => project(...place));
      figure.bones.forEach(([a, b, side]) => segments.push({
        from: points[a], to: points[b], depth: 0.5 * (points[a][2] + points[b][2]), mode, side,
      }));
      const head = points[figure.joints.indexOf('head')];
      if (head && figure.bones.length) segments.push({ from: head, to: head, depth: head[2], mode, side: 'trunk', ball: 4 });
      if (!figure.bones.length) {
        points.forEach((point) => segments.push({ from: point, to: point, depth: point[2], mode, side: 'trunk' }));
      }
    });
    if ([null, layers[0]].includes(pane)) this.drawContacts(context, project, root);
    segments.filter(({ depth }) => !Number.isNaN(depth)).sort((a, b) => b.depth - a.depth).forEach(({ from, to, mode, side, ball = 0 }) => {
      context.globalAlpha = mode.strength;
      context.setLineDash(ball ? [] : mode.dash);
      context.lineWidth = ((ball || 1) * finer * mode.width * DISTANCE * this.radius) / (0.5 * (from[2] + to[2]));
      context.strokeStyle = colour(mode.ink || `${mode.style}-${side}`);
      context.beginPath();
      context.moveTo(from[0], from[1]);
      context.lineTo(to[0], to[1]);
      context.stroke();
    });
    context.globalAlpha = 1;
    context.setLineDash([]);
  }

  /** The height of the floor at a place: that of the bag, or else that of the lowest joints. */
  floorAt(x, z) {
    let floor = floors[shown.time];
    for (let t = shown.time; t >= 0 && !floor; t -= 1) floor = floors[t];
    floor = floor || floors.find(Boolean);
    return floor ? floor.height - floor.across * x - floor.along * z : this.floor;
  }

  onFloor(project, x, z) {
    return project(x, this.floorAt(x, z), z);
  }

  /** A soft shadow on the floor, of light from above, of a skeleton that is drawn in full. */
  drawShadow(context, project, { figure, places, strength: own, ink }) {
    if (own < 1 || ink) return;
    context.fillStyle = colour('shadow');
    SHADOW.forEach((radius) => {
      context.beginPath();
      figure.bones.forEach(([a, b]) => {
        const [[x, , z], [toX, , toZ]] = [places[a], places[b]];
        const start = Math.atan2(toZ - z, toX - x) - Math.PI / 2;
        for (let i = 0; i < 16; i += 1) { // half a circle around either end
          const angle = start + ((i < 8 ? i : i - 1) * Math.PI) / 7;
          const [u, v] = this.onFloor(project, (i < 8 ? toX : x) + radius * Math.cos(angle), (i < 8 ? toZ : z) + radius * Math.sin(angle));
          if (i) context.lineTo(u, v); else context.moveTo(u, v);
        }
        context.closePath();
      });
      context.fill();
    });
  }

  /** Ellipsoids that hold 90 % of where each joint of a mode is, as the view's plane shows them. */
  drawRegions(context, project, { figure, offset, places, style, strength: own }) {
    if (!figure.regions) return;
    places.forEach((place, joint) => {
      const i = (offset * places.length + joint) * 6;
      const [xx, yy, zz, xy, xz, yz] = figure.regions.slice(i, i + 6);
      const [u, v] = project(...place);
      // Columns of the matrix with y up and z towards the camera, on the screen.
      const columns = [[xx, -xy, -xz], [-xy, yy, yz], [-xz, yz, zz]].map((column) => {
        const [right, below] = project(...place.map((x, axis) => x + report.region * column[axis]));
        return [right - u, below - v];
      });
      const sum = (a, b) => columns.reduce((total, column) => total + column[a] * column[b], 0);
      const [half, apart] = [0.5 * (sum(0, 0) + sum(1, 1)), Math.hypot(0.5 * (sum(0, 0) - sum(1, 1)), sum(0, 1))];
      const turn = 0.5 * Math.atan2(2 * sum(0, 1), sum(0, 0) - sum(1, 1));
      const [side] = figure.joints[joint].match(/^(left|right)/) || ['trunk'];
      context.fillStyle = colour(`${style}-${side}`);
      context.strokeStyle = context.fillStyle;
      context.lineWidth = 1;
      context.beginPath();
      context.ellipse(u, v, Math.sqrt(half + apart), Math.sqrt(Math.max(half - apart, 0)), turn, 0, 2 * Math.PI);
      context.globalAlpha = 0.16 * own;
      context.fill();
      context.globalAlpha = 0.6 * own;
      context.stroke();
    });
    context.globalAlpha = 1;
  }

  /** A ring around each foot of the heaviest mode, the stronger the more probably it stands. */
  drawContacts(context, project, root) {
    const [layer] = layers;
    if (!layer || !shown.layers.has(0) || !layer.weights[shown.time].length) return;
    const offset = layer.starts[shown.time];
    const own = originOf(layer, offset);
    context.strokeStyle = colour('contact');
    context.lineWidth = 2;
    Object.entries(contactsAt(shown.time)).forEach(([side, probability]) => {
      const joint = ['toe', 'ankle'].map((name) => layer.joints.indexOf(`${side}_${name}`)).find((i) => i >= 0);
      if (joint === undefined || probability < 0.05) return;
      const point = jointOf(layer, offset, joint).map((x, axis) => (this.together ? x + root[axis] - own[axis] : x));
      const [u, v] = project(...point);
      context.globalAlpha = probability;
      context.beginPath();
      context.arc(u, v, 7, 0, 2 * Math.PI);
      context.stroke();
    });
    context.globalAlpha = 1;
  }

  /** A grid of half metres under the feet, and an arrow to the camera. */
  drawFloor(context, project, width, height) {
    const root = this.follow ? this.lastRoot() || this.centre : this.centre;
    const middle = [Math.round(2 * root[0]) / 2, Math.round(2 * root[2]) / 2];
    const reach = Math.ceil(2 * Math.min(this.radius, 4)) / 2;
    context.strokeStyle = colour('grid');
    context.lineWidth = 1;
    context.beginPath();
    for (let i = -reach; i <= reach + 1e-6; i += 0.5) {
      [[[i, -reach], [i, reach]], [[-reach, i], [reach, i]]].forEach((ends) => {
        ends.forEach(([x, z], end) => {
          const [u, v] = this.onFloor(project, middle[0] + x, middle[1] + z);
          if (end) context.lineTo(u, v); else context.moveTo(u, v);
        });
      });
    }
    context.stroke();
    // The camera is at the origin.
    const away = Math.hypot(root[0], root[2]);
    if (away < 1e-3) return;
    const [tail, head] = [0.4 * this.radius, 0.7 * this.radius];
    const [dx, dz] = [-root[0] / away, -root[2] / away];
    const place = (along, aside) => this.onFloor(
      project, root[0] + along * dx - aside * dz, root[2] + along * dz + aside * dx,
    );
    const tip = place(head, 0);
    context.strokeStyle = colour('axis');
    context.fillStyle = colour('muted');
    context.beginPath();
    [place(tail, 0), tip, place(head - 0.12, 0.08), tip, place(head - 0.12, -0.08)].forEach(([u, v], i) => {
      if (i) context.lineTo(u, v); else context.moveTo(u, v);
    });
    context.stroke();
    context.font = '12px system-ui, sans-serif';
    context.textAlign = 'center';
    const [u, v] = [Math.max(45, Math.min(width - 45, tip[0])), Math.max(14, Math.min(height - 8, tip[1] + 15))];
    context.fillText('to the camera', u, v);
  }

  /** The paths of hands, feet, head and pelvis along the trajectories of the current window. */
  drawWays(context, project) {
    context.strokeStyle = colour('trajectories');
    context.fillStyle = colour('trajectories');
    trajectories.forEach((topic) => {
      const now = topic.at[shown.time];
      if (!now || !now.ways) return;
      const [steps, ends] = [now.times.length, topic.ends.length];
      const count = now.ways.length / (3 * steps * ends);
      const away = now.times.map((time) => Math.abs(time - TIMES[shown.time]));
      const present = away.indexOf(Math.min(...away));
      for (let m = count - 1; m >= 0; m -= 1) {
        context.globalAlpha = FAINTEST + (0.9 - FAINTEST) * (now.weights[m] / now.weights[0]);
        for (let e = 0; e < ends; e += 1) {
          context.lineWidth = m === 0 ? 2 : 1.2;
          const points = now.times.map((_, t) => {
            const i = ((m * steps + t) * ends + e) * 3;
            return project(now.ways[i], now.ways[i + 1], now.ways[i + 2]);
          });
          context.beginPath();
          points.forEach(([u, v], t) => { if (t) context.lineTo(u, v); else context.moveTo(u, v); });
          context.stroke();
          const [u, v] = points[present];
          context.beginPath();
          context.arc(u, v, m === 0 ? 3 : 2, 0, 2 * Math.PI);
          context.fill();
        }
      }
    });
    context.globalAlpha = 1;
  }
}

/** The image of the present time with the modes on it. */
class Film {
  constructor(canvas) {
    this.canvas = canvas;
    this.withModes = true;
    this.pictures = new Map();
    this.last = null;
  }

  /** A picture, which may still be decoding; the following ones are prepared too. */
  picture(index) {
    const known = this.pictures.get(index);
    if (known) return known;
    const jpeg = report.images.jpegs[index];
    if (!jpeg) return null;
    const picture = new Image();
    picture.onload = () => { if (shown.time === index) this.draw(); };
    picture.src = `data:image/jpeg;base64,${jpeg}`;
    this.pictures.set(index, picture);
    // The oldest are decoded again when they are wanted again.
    if (this.pictures.size > 64) this.pictures.delete(this.pictures.keys().next().value);
    return picture;
  }

  draw() {
    const { context, width, height } = prepared(this.canvas);
    const { images } = report;
    const scale = Math.min(width / images.width, height / images.height);
    const [w, h] = [images.width * scale, images.height * scale];
    const [left, top] = [(width - w) / 2, (height - h) / 2];
    const picture = this.picture(shown.time);
    for (let ahead = 1; ahead <= 4; ahead += 1) if (shown.time + ahead <= LAST) this.picture(shown.time + ahead);
    if (picture && picture.complete && picture.naturalWidth) this.last = picture;
    // Until a picture is there the one before stays, so that nothing flickers.
    if (picture && this.last) context.drawImage(this.last, left, top, w, h);
    context.save();
    context.beginPath();
    context.rect(left, top, w, h);
    context.clip();
    context.lineCap = 'round';
    if (this.withModes) modesNow().forEach((mode) => this.drawMode(context, mode, left, top, w));
    context.restore();
  }

  drawMode(context, mode, left, top, width) {
    const { figure, offset } = mode;
    if (!figure.pixels) return;
    const joints = figure.joints.length;
    const half = 0.5 / report.images.width;
    const at = (joint) => [0, 1].map((axis) => figure.pixels[(offset * joints + joint) * 2 + axis] + half);
    context.setLineDash(mode.dash);
    const line = (a, b) => {
      context.beginPath();
      context.moveTo(left + a[0] * width, top + a[1] * width);
      context.lineTo(left + b[0] * width, top + b[1] * width);
      context.stroke();
    };
    figure.bones.forEach(([a, b, side]) => {
      const [from, to] = [at(a), at(b)];
      if ([...from, ...to].some(Number.isNaN)) return;
      if (mode.strength > 0.9 && !mode.ink) {
        context.globalAlpha = 0.75;
        context.lineWidth = mode.width + 2;
        context.strokeStyle = '#ffffff';
        line(from, to);
      }
      context.globalAlpha = mode.strength;
      context.lineWidth = mode.width;
      context.strokeStyle = mode.ink ? '#000000' : colour(`${mode.style}-${side}`);
      line(from, to);
    });
    context.globalAlpha = 1;
    context.setLineDash([]);
  }
}
