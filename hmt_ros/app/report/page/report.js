// The page: selections, texts, and the reactions to changes.

const element = (id) => document.getElementById(id);

/** A new element with a text and attributes. */
function made(tag, text = '', attributes = {}) {
  const result = document.createElement(tag);
  result.textContent = text;
  Object.entries(attributes).forEach(([name, value]) => result.setAttribute(name, value));
  return result;
}

const percent = (share) => (share === null ? '-' : `${Math.round(100 * share)} %`);
const fixed = (value, digits = 0) => (value === null ? '-' : value.toFixed(digits));

const space = new Space(element('space'));
const film = report.images ? new Film(element('image')) : null;

/** Mixtures whose weights can be shown: layers, then mixtures over trajectories. */
const choices = [
  ...layers.map((layer, index) => ({
    name: several ? nameOf(layer) : `${nameOf(layer)} (${layer.topic})`, layer, index, weightsAt: (t) => layer.weights[t], what: 'modes',
  })),
  ...trajectories.map((topic, index) => ({
    name: `trajectories (${topic.topic})`, layer: null, index: layers.length + index,
    weightsAt: (t) => (topic.at[t] ? topic.at[t].weights : []), what: 'trajectories',
  })),
];
if (!choices.length) choices.push({ name: 'nobody', layer: null, index: 0, weightsAt: () => [], what: 'modes' });
const chosen = () => choices[shown.chosen];
const errorsKnown = () => Boolean(chosen().layer && chosen().layer.errors_mm);
const motionsKnown = () => Boolean(chosen().layer && chosen().layer.motions.length > 1);
const beliefsKnown = () => Boolean(chosen().layer && beliefCurves(chosen().layer).length);

const hasFreeEnergy = trajectories.some((topic) => topic.windows.some((w) => w.free_energy.length));
const calibrated = report.scores
  && Object.values(report.scores.topics).some((topic) => topic.calibration.together);

const hasBands = compared.some((layer) => layer.bands);
/** The height or the angle that is shown over time. */
function banded() {
  const [kind, name] = element('banded').value.split(' ');
  return { kind, name };
}

const seek = (seconds) => goTo(nearest(seconds));
const charts = {
  weights: new Chart(element('weights'), () => weightsChart(chosen()), seek),
  errors: new Chart(element('errors'), () => errorsChart(chosen().layer), seek),
  beliefs: new Chart(element('beliefs'), () => beliefsChart(chosen().layer), seek),
  motions: new Chart(element('motions'), () => motionsChart(shown.chosen), seek),
  bands: new Chart(element('bands'), () => bandsChart(banded()), seek),
  freeEnergy: new Chart(element('free-energy'), freeEnergyChart, seek),
  iterations: new Chart(element('iterations'), iterationsChart),
  together: new Chart(element('together'), () => calibrationChart('together')),
  each: new Chart(element('each'), () => calibrationChart('each')),
  absolute: new Chart(element('absolute'), () => calibrationChart('absolute')),
};

function drawAll() {
  space.draw();
  if (film) film.draw();
  charts.weights.draw();
  if (errorsKnown()) charts.errors.draw();
  if (motionsKnown()) charts.motions.draw();
  if (beliefsKnown()) charts.beliefs.draw();
  if (hasBands) charts.bands.draw();
  if (hasFreeEnergy) { charts.freeEnergy.draw(); charts.iterations.draw(); }
  tellTime();
  tellModes();
}

function drawCalibration() {
  if (calibrated) { charts.together.draw(); charts.each.draw(); charts.absolute.draw(); }
}

function goTo(time) {
  shown.time = Math.max(0, Math.min(LAST, time));
  element('time').value = shown.time;
  drawAll();
}

function tellTime() {
  const now = `${TIMES[shown.time].toFixed(2)} s, ${shown.time + 1} of ${LAST + 1}`;
  element('clock').value = now;
  element('time').setAttribute('aria-valuetext', now);
}

/** The table of the modes at the present time; a click shows one alone. */
function tellModes() {
  const { layer, weightsAt, what } = chosen();
  const weights = weightsAt(shown.time);
  const errors = errorsKnown() ? layer.errors_mm[shown.time] : null;
  const motions = layer ? layer.identities : null;
  element('modes').caption.textContent = `${what === 'modes' ? 'Modes' : 'Trajectories'} at this time`;
  const head = made('tr');
  const columns = ['', 'weight', '', ...(motions ? ['motion'] : []), ...(errorsKnown() ? ['error, mm'] : [])];
  columns.forEach((text) => head.append(made('th', text, { scope: 'col' })));
  element('modes').tHead.replaceChildren(head);
  const rows = weights.slice(0, 16).map((weight, rank) => {
    const row = made('tr');
    const first = made('td');
    if (layer) {
      const alone = shown.alone === rank;
      const button = made('button', `${rank + 1}`, {
        type: 'button', 'aria-pressed': alone, 'aria-label': `show mode ${rank + 1} alone`,
      });
      button.addEventListener('click', () => {
        shown.alone = alone ? null : rank;
        drawAll();
        const again = element('modes').querySelectorAll('button')[rank];
        if (again) again.focus();
      });
      first.append(button);
    } else {
      first.textContent = rank + 1;
    }
    const bar = made('td', '', { class: 'bar' });
    bar.append(made('span'));
    bar.firstChild.style.width = `${100 * weight}%`;
    row.append(first, made('td', `${(100 * weight).toFixed(1)} %`), bar);
    if (motions) row.append(made('td', layer.motionName(motions[shown.time][rank]), { class: 'motion' }));
    if (errorsKnown()) row.append(made('td', errors ? fixed(errors[rank]) : '-'));
    return row;
  });
  element('modes').tBodies[0].replaceChildren(...rows);
  const entropy = weights.reduce((sum, w) => sum - (w > 0 ? w * Math.log(w) : 0), 0);
  const more = weights.length > 16 ? `; ${weights.length - 16} more` : '';
  element('modes-caption').textContent = weights.length
    ? `${weights.length} ${what}; effective number, by the entropy of the weights: ${Math.exp(entropy).toFixed(1)}${more}`
      + `${layer ? '. Click a number to show that mode alone.' : ''}`
    : what === 'modes' ? 'Nobody is found at this time.' : 'Nothing at this time.';
}

function choose(index) {
  shown.chosen = index;
  shown.alone = null;
  const { name, what } = chosen();
  element('weights').setAttribute('aria-label', `Weights of ${name} over time`);
  element('weights-caption').replaceChildren(
    swatch('accent'), ` weights of the ${what}, heaviest at the bottom `, ...keys(confidenceCurves(chosen().layer)),
  );
  element('errors-figure').hidden = !errorsKnown();
  if (errorsKnown()) {
    element('errors-caption').replaceChildren(
      ...keys(ERRORS), `of ${name}: mean over the evaluated joints, pelvis on pelvis. Lower is better; where the heaviest is far above the best, `
      + 'a mode of less weight was right.',
    );
    element('errors').setAttribute('aria-label', `Errors of ${name} over time`);
  }
  element('motions-figure').hidden = !motionsKnown();
  element('motions').setAttribute('aria-label', `Weights of the motions of ${name} over time`);
  if (motionsKnown()) tellMotions();
  element('beliefs').setAttribute('aria-label', `Probabilities of the person and of the cues of ${name} over time`);
  element('beliefs-figure').hidden = !beliefsKnown();
  if (beliefsKnown()) {
    const text = Object.keys(chosen().layer.cues).length
      ? `How far each cue of the images is believed in ${name}: the probability that it shows the person; `
        + 'of the track, that some mode is about where the person is. Near 1 is usual; a cue that falls is left out.'
      : `The probability in ${name}.`;
    element('beliefs-caption').replaceChildren(...keys(beliefCurves(chosen().layer)), made('div', text));
  }
  drawAll();
}

/** A box for each of the heaviest motions of the chosen layer, and one for all others. */
function tellMotions() {
  const { layer, index, name } = chosen();
  const hidden = shown.hidden[index];
  const sum = layer.motions.reduce((total, motion) => total + motion.total, 0);
  const boxes = [];
  for (let i = 0; i < layer.motions.length; i += i < TOLD_MOTIONS ? 1 : layer.motions.length) {
    const some = layer.motions.slice(i, i < TOLD_MOTIONS ? i + 1 : undefined);
    const what = i < TOLD_MOTIONS ? layer.motionName(some[0].identity) : 'all others';
    const share = some.reduce((total, motion) => total + motion.total, 0) / sum;
    boxes.push(toggle(
      `motion-${i}`, `${what}: ${percent(share)}`, !some.every(({ identity }) => hidden.has(identity)),
      [i < TOLD_MOTIONS ? `series-${i}` : 'grid'],
      (on) => some.forEach(({ identity }) => { if (on) hidden.delete(identity); else hidden.add(identity); }),
    ));
  }
  element('motions-boxes').replaceChildren(...boxes);
  element('motions-caption').textContent = `Weights of the motions of ${name}. Each is called by the joint that `
    + 'differs most from the others where it is heaviest; shares are of all weights. Where the image is ambiguous several share the weight, '
    + 'and one should be left soon after. A motion that is switched off is not drawn.';
}

/** The heights and angles that can be shown over time. */
function buildBands() {
  element('bands').setAttribute('aria-label', 'A height or an angle over time, with intervals of 90 percent');
  element('bands-section').hidden = !hasBands;
  if (!hasBands) return;
  [['joints', 'height'], ['angles', 'angle']].forEach(([kind, what]) => {
    const names = new Set(compared.flatMap((layer) => (layer.bands ? layer.bands[kind] : [])));
    const group = made('optgroup', '', { label: `${what}s` });
    names.forEach((name) => group.append(made('option', `${what} of ${name}`.replaceAll('_', ' '), { value: `${kind} ${name}` })));
    if (names.size) element('banded').append(group);
  });
  const first = [...element('banded').options].find((option) => option.value === 'joints right_wrist');
  if (first) first.selected = true;
  element('banded').addEventListener('change', () => charts.bands.draw());
  const from = floors.some(Boolean) ? 'the floor' : 'the origin, the camera as a rule, which is taken to be level';
  element('bands-caption').replaceChildren(
    ...keys(compared.filter((layer) => layer.bands).map((layer) => ({ name: `${nameOf(layer)} (${layer.topic})`, series: comparedColour(layer) }))),
    ...(truth ? keys([{ name: 'truth (heights)', series: 'ink' }]) : []),
    made('div', `Median, and the interval between the 5th and the 95th percentile, of the whole mixture: 90 % of the truth should lie in it. Heights are above ${from}.`),
  );
}

/** The names of curves, each beside its colour. */
function keys(curves) {
  return curves.map(({ name, series }) => {
    const key = made('span', '', { class: 'key' });
    key.append(swatch(series), ` ${name} `);
    return key;
  });
}

function swatch(...names) {
  const result = made('span', '', { class: 'swatches', 'aria-hidden': 'true' });
  names.forEach((name) => {
    const part = made('span', '', { class: 'swatch' });
    if (name === 'ink') part.classList.add('dashed'); else part.style.background = `var(--${name})`;
    result.append(part);
  });
  return result;
}

const isOn = (button) => button.getAttribute('aria-pressed') === 'true';

/** A button that switches something on and off. */
function toggle(id, text, on, colours_, change) {
  const button = made('button', '', { type: 'button', id, class: 'toggle', 'aria-pressed': on });
  button.addEventListener('click', () => {
    button.setAttribute('aria-pressed', !isOn(button));
    change(isOn(button));
    drawAll();
  });
  button.append(swatch(...colours_), text);
  return button;
}

/** A button for each thing that can be drawn; number keys press them. */
function buildLayers() {
  const place = element('layers');
  const sides = (style) => [`${style}-left`, `${style}-right`];
  const kinds = layers.map(nameOf);
  layers.forEach((layer, index) => {
    // Everybody, if there are several.
    const first = index === 0 || (several && layer.kind === 'posterior');
    if (first) shown.layers.add(index);
    const alone = kinds.filter((kind) => kind === kinds[index]).length === 1;
    place.append(toggle(
      `layer-${index}`, alone ? kinds[index] : `${kinds[index]} (${layer.topic})`, first, sides(layer.style),
      (on) => { if (on) shown.layers.add(index); else shown.layers.delete(index); },
    ));
    place.lastChild.title = layer.topic;
  });
  const show = (name, text, colours_, on = true) => {
    shown[name] = on;
    place.append(toggle(`show-${name}`, text, on, colours_, (now) => { shown[name] = now; }));
  };
  if (truth) show('truth', 'truth', ['ink']);
  if (detector) show('detector', 'detector', sides('detector'));
  if (layers.some((layer) => layer.regions)) show('regions', '90 % regions', ['accent'], false);
  if (trajectories.some((topic) => topic.windows.some((w) => w.ways))) show('trajectories', 'paths', ['trajectories'], !layers.length);
  [...place.children].slice(0, 9).forEach((button, i) => {
    button.setAttribute('aria-keyshortcuts', i + 1);
    button.prepend(made('kbd', i + 1, { 'aria-hidden': 'true' }));
  });
}

function tell() {
  const modes = layers.length
    ? layers[0].weights.reduce((sum, w) => sum + w.length, 0) / layers[0].weights.length : 0;
  const parts = [`${LAST + 1} times over ${TIMES[LAST].toFixed(2)} s`];
  if (layers.length) parts.push(`${modes.toFixed(1)} modes at a time in ${layers[0].topic}`);
  parts.push(`first stamp ${report.start_ns} ns`);
  element('facts').textContent = `${parts.join('; ')}.`;
  if (report.images) {
    element('stage').style.setProperty('--aspect', report.images.width / report.images.height);
    element('with-modes').closest('div').hidden = report.images.drawn_on;
    element('image-caption').textContent = report.images.drawn_on
      ? 'Overlay of the tracker: the heaviest modes on the image.'
      : 'The modes on the image from which they are estimated: all should cover the person.';
  } else {
    element('image-figure').hidden = true;
    element('stage').classList.add('without-image');
  }
  element('space-caption').textContent += floors.some(Boolean)
    ? ' The grid is the floor, as the bag has it; rings mark feet that stand on it.'
    : ' The grid lies under the lowest joints: the bag does not tell the floor.';
  if (layers.some((layer) => layer.regions)) element('space-caption').textContent += ' Ellipsoids hold a joint, relative to the pelvis, with 90 %.';
  if (detector) element('space-caption').textContent += ` The detector's own skeleton (${detector.topic}) has its hips at ours.`;
  element('notes-section').hidden = !report.notes.length;
  element('notes').append(...report.notes.map((note) => made('li', note)));
}

function tellFreeEnergy() {
  element('free-energy-section').hidden = !trajectories.length;
  element('free-energy-figures').hidden = !hasFreeEnergy;
  if (!hasFreeEnergy) {
    element('no-free-energy').hidden = false;
    element('no-free-energy').textContent = 'None was recorded: motions were smoothed in closed form. '
      + 'replay --set smoother.refine_on_images=end refines them on the images at the end, and records their free energy.';
  }
  element('free-energy').setAttribute('aria-label', 'Free energy of each window over time');
  element('iterations').setAttribute('aria-label', 'Free energy over the iterations of the current window');
  element('iterations-caption').textContent = 'Free energy over the iterations of the window at this time.';
}

const COLUMNS = [
  ['frames', (s) => fixed(s.frames)], ['missing', (s) => fixed(s.missing)], ['modes', (s) => fixed(s.modes, 1)],
  ['heaviest, mm', (s) => fixed(s.heaviest_mm)], ['best of K, mm', (s) => fixed(s.best_mm)],
  ['expected, mm', (s) => fixed(s.expected_mm)], ['under 150\u00a0mm', (s) => percent(s.fraction_tracked)],
  ['-log p', (s) => fixed(s.negative_log_likelihood, 1)],
  ['all joints 50\u00a0%', (s) => percent(s.coverage_50)], ['all joints 90\u00a0%', (s) => percent(s.coverage_90)],
  ['each joint 50\u00a0%', (s) => percent(s.joint_coverage_50)], ['each joint 90\u00a0%', (s) => percent(s.joint_coverage_90)],
  ['from the camera 90\u00a0%', (s) => percent(s.absolute_coverage_90)],
];

function tellScores() {
  element('scores-section').hidden = !report.scores;
  if (!report.scores) return;
  element('scores-about').textContent = `Against ${report.scores.truth}, ${report.scores.truth_frames} frames. `
    + 'Errors are mean distances of joints, pelvis on pelvis. The last five columns say how often the truth lies in the smallest '
    + 'region that holds 50 or 90 % of the probability. That should be 50 and 90 %: less is too sure, more is too vague. The pictures '
    + 'show the same for every region: a good line stays near the diagonal.';
  const head = made('tr');
  ['topic', ...COLUMNS.map(([name]) => name)].forEach((name) => head.append(made('th', name, { scope: 'col' })));
  element('scores').tHead.append(head);
  Object.entries(report.scores.topics).forEach(([name, scores]) => {
    const row = made('tr');
    row.append(made('th', name, { scope: 'row' }), ...COLUMNS.map(([, cell]) => made('td', cell(scores))));
    element('scores').tBodies[0].append(row);
  });
  element('calibration-figures').hidden = !calibrated;
  const key = element('calibration-key');
  Object.entries(report.scores.topics).forEach(([name, scores], i) => {
    if (!scores.calibration.together) return;
    const line = made('div');
    line.append(swatch(`series-${i % 6}`), name);
    key.append(line);
  });
  const line = made('div');
  line.append(swatch('axis'), 'as often as it says');
  key.append(line);
  element('together').setAttribute('aria-label', 'Calibration for all joints together; the table has the numbers');
  element('each').setAttribute('aria-label', 'Calibration for each joint alone; the table has the numbers');
  element('absolute').setAttribute('aria-label', 'Calibration for each joint alone, in the frame of the camera');
}

// Playing: a timer waits for the time of the next image; those that come too late are skipped.

let timer = null;
let due = 0;

// Longest time for which an image stands while the page plays, s: nobody waits for hours.
const LONGEST = 2;

/** Duration for which a time is shown, ms. */
function duration(time) {
  const seconds = time < LAST ? TIMES[time + 1] - TIMES[time] : TIMES[LAST] / Math.max(LAST, 1) || 1;
  return (1000 * Math.min(seconds, LONGEST)) / Number(element('speed').value);
}

function play(on) {
  clearTimeout(timer);
  timer = null;
  element('play').textContent = on ? 'Pause' : 'Play';
  element('play').setAttribute('aria-pressed', on);
  if (!on) return;
  if (shown.time === LAST) goTo(0);
  due = performance.now() + duration(shown.time);
  timer = setTimeout(step, duration(shown.time));
}

function step() {
  const now = performance.now();
  let { time } = shown;
  do {
    time = time < LAST ? time + 1 : 0;
    due += duration(time);
  } while (due <= now);
  goTo(time);
  timer = setTimeout(step, due - performance.now());
}

/** Applies the part of the address behind #: frame=10&yaw=30&pitch=5&zoom=1.5&show=0,1,truth,detector,regions,trajectories,beside. */
function readAddress() {
  const given = new URLSearchParams(window.location.hash.slice(1));
  const number = (name, otherwise) => {
    const value = Number.parseFloat(given.get(name));
    return Number.isFinite(value) ? value : otherwise;
  };
  space.yaw = number('yaw', space.yaw);
  space.pitch = Math.max(-89, Math.min(89, number('pitch', space.pitch)));
  space.zoom = Math.max(0.3, Math.min(8, number('zoom', space.zoom)));
  if (given.has('show')) {
    const names = given.get('show').split(',');
    document.querySelectorAll('#layers button, #beside').forEach((control) => {
      const wanted = names.includes(control.id.replace(/^(layer|show)-/, ''));
      if ((control.id === 'beside' ? control.checked : isOn(control)) !== wanted) control.click();
    });
  }
  goTo(Math.round(number('frame', shown.time)));
}

element('time').max = LAST;
element('time').addEventListener('input', () => goTo(Number(element('time').value)));
element('play').addEventListener('click', () => play(timer === null));
element('with-modes').addEventListener('change', () => {
  film.withModes = element('with-modes').checked;
  film.draw();
});
space.together = Boolean(truth) && !several;
element('align').checked = space.together;
element('follow').checked = space.follow;
element('follow').addEventListener('change', () => { space.follow = element('follow').checked; space.draw(); });
element('align').addEventListener('change', () => { space.together = element('align').checked; space.draw(); });
element('beside-label').hidden = besides.length < 2;
element('beside').addEventListener('change', () => {
  shown.beside = element('beside').checked;
  if (shown.beside) {
    besides.map((figure) => element(figure === detector ? 'show-detector' : `layer-${layers.indexOf(figure)}`))
      .forEach((button) => { if (!isOn(button)) button.click(); });
  }
  space.draw();
});
document.querySelectorAll('[data-look]').forEach((button) => button.addEventListener('click', () => {
  const [yaw, pitch] = button.dataset.look.split(' ').map(Number);
  space.turn(yaw, pitch);
}));
element('chosen').append(...choices.map(({ name, index }) => made('option', name, { value: index })));
element('chosen').addEventListener('change', () => choose(Number(element('chosen').value)));
document.addEventListener('keydown', (event) => {
  const { target, key } = event;
  // What a control does with a key itself, it does.
  const own = { BUTTON: [' '], INPUT: target.type === 'range' ? ['ArrowLeft', 'ArrowRight'] : [' '], SELECT: [key] };
  if (event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey || (own[target.tagName] || []).includes(key)) return;
  const button = document.querySelector(`#layers [aria-keyshortcuts="${CSS.escape(key)}"]`);
  const keys_ = {
    ' ': () => play(timer === null), ArrowLeft: () => goTo(shown.time - 1), ArrowRight: () => goTo(shown.time + 1),
  };
  const act = keys_[key] || (button && (() => button.click()));
  if (act) { event.preventDefault(); act(); }
});
window.addEventListener('hashchange', readAddress);

tell();
buildLayers();
buildBands();
tellFreeEnergy();
tellScores();
choose(0);
readAddress();
new ResizeObserver(() => { drawAll(); drawCalibration(); }).observe(document.body);
window.matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => {
  colours.clear();
  drawAll();
  drawCalibration();
});
drawCalibration();
