"""The page of a report: its behaviour in a browser."""

import html
import json
import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from msg_tools import BagWriter
from msg_tools.messages.bodies import message_of_body
from msg_tools.messages.headers import FRAME_ID
from msg_tools.messages.pose_mixtures import MixtureKind
from test.app.conftest import (
    FRAMES,
    MESSAGES,
    STAMPS,
    TRAJECTORIES,
    make,
    mixture_of,
    pose_message,
    write_out,
)
from test.app.report.test_command import with_ground
from test.app.report.test_detector import with_detector

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable', 'chrome')
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
in_a_browser = pytest.mark.skipif(
    BROWSER is None, reason=f'no Chromium is installed: looked for {", ".join(BROWSERS)}'
)

# Inserted first in the page; records errors.
COMPLAINTS = """<script>
const complaints = [];
const complain = (...words) => complaints.push(words.join(' '));
['error', 'warn'].forEach((kind) => { console[kind] = complain; });
['error', 'unhandledrejection', 'securitypolicyviolation'].forEach((kind) => addEventListener(
  kind, (event) => complain(kind, event.message || event.reason || event.blockedURI), true,
));
</script>
"""
# Inserted last in the page; performs a user's actions and records the results.
VISIT = """<script>
const seen = {};
function pixelsOf(id) {
  const canvas = document.getElementById(id);
  const { width, height } = canvas;
  // A copy: reading a canvas often would change how it is kept.
  const copy = new OffscreenCanvas(width, height);
  const context = copy.getContext('2d', { willReadFrequently: true });
  context.drawImage(canvas, 0, 0);
  return context.getImageData(0, 0, width, height).data;
}
function look(name, id = 'space') {
  const pixels = pixelsOf(id);
  let hash = 0;
  let drawn = 0;
  for (let i = 0; i < pixels.length; i += 4) {
    for (let c = 0; c < 4; c += 1) hash = (Math.imul(hash, 31) + pixels[i + c]) | 0;
    if (pixels[i + 3]) drawn += 1;
  }
  seen[name] = `${hash}`;
  seen[`${name} drawn`] = drawn;
}
const get = (id) => document.getElementById(id);
const pause = (ms) => new Promise((done) => setTimeout(done, ms));
function pointer(target, kind, x, y, pointerId = 1) {
  const options = { clientX: x, clientY: y, bubbles: true, pointerId };
  target.dispatchEvent(new PointerEvent(kind, options));
}
const pressed = (button) => button.getAttribute('aria-pressed') === 'true';
function key(target, name) {
  const options = { key: name, bubbles: true, cancelable: true };
  target.dispatchEvent(new KeyboardEvent('keydown', options));
}
async function visit() {
  await pause(300);
STEPS
}
visit().catch((error) => complaints.push(`visit: ${error}`)).finally(() => {
  const result = document.createElement('pre');
  result.id = 'seen';
  result.textContent = JSON.stringify({ ...seen, complaints });
  document.body.append(result);
});
</script>
"""


def visit(page, steps, folder, fragment=''):
    """Results of steps in a browser that opens the page from its file."""
    path = folder / 'visited.html'
    path.write_text(
        page.replace('<head>\n', f'<head>\n{COMPLAINTS}', 1).replace(
            '</body>', f'{VISIT.replace("STEPS", steps)}</body>', 1
        ),
        'utf-8',
    )
    result = subprocess.run(
        [
            BROWSER, '--headless', '--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage',
            '--no-first-run', '--disable-extensions', '--disable-background-networking',
            '--host-resolver-rules=MAP * ~NOTFOUND', f'--user-data-dir={folder / "profile"}',
            '--enable-logging=stderr', '--window-size=1200,900', '--virtual-time-budget=20000',
            '--dump-dom', f'{path.as_uri()}{fragment}',
        ],
        capture_output=True, text=True, timeout=300, check=False,
        env={**os.environ, 'HOME': str(folder)},
    )  # fmt: skip
    found = re.findall(r'<pre id="seen">(.*?)</pre>', result.stdout, re.S)
    assert found, f'{result.stderr[-2000:]} {result.stdout[-500:]}'
    seen = json.loads(html.unescape(found[0]))
    assert seen.pop('complaints') == []
    assert 'CONSOLE' not in result.stderr
    return seen


@in_a_browser
def test_slider_mouse_and_keys_change_the_view(page, tmp_path):
    seen = visit(
        page,
        """
        look('first'); look('first image', 'image'); look('first weights', 'weights');
        get('time').value = 5; get('time').dispatchEvent(new Event('input', { bubbles: true }));
        await pause(300);
        look('later'); look('later image', 'image'); look('later weights', 'weights');
        seen.clock = get('clock').value; seen.spoken = get('time').getAttribute('aria-valuetext');
        const space = get('space');
        const place = space.getBoundingClientRect();
        pointer(space, 'pointerdown', place.left + 100, place.top + 100);
        pointer(space, 'pointermove', place.left + 220, place.top + 110);
        look('dragged');
        pointer(space, 'pointerup', place.left + 220, place.top + 110);
        pointer(space, 'pointermove', place.left + 20, place.top + 10);
        look('let go');
        key(space, 'ArrowLeft'); look('key');
        space.dispatchEvent(new WheelEvent('wheel', { deltaY: -300, cancelable: true }));
        look('wheel');
        document.querySelector('[data-look="0 0"]').click(); look('from the camera');
        key(space, '0'); look('reset');
        [[100, 1], [200, 2]].forEach(([x, id]) => pointer(space, 'pointerdown', x, 100, id));
        pointer(space, 'pointermove', 250, 100, 2);
        pointer(space, 'pointerup', 250, 100, 2);
        look('two fingers');
        key(space, '0'); key(space, '+'); key(space, '-'); look('reset again');
        key(document.body, 'ArrowLeft'); seen['clock after a key'] = get('clock').value;
        """,
        tmp_path,
    )
    views = ['first', 'later', 'dragged', 'key', 'wheel', 'from the camera', 'two fingers']
    assert len({seen[name] for name in views}) == len(views)
    assert min(seen[f'{name} drawn'] for name in views) > 1000
    assert seen['let go'] == seen['dragged']
    assert seen['reset'] == seen['reset again'] == seen['later']
    assert seen['first image'] != seen['later image']
    assert seen['first image drawn'] > 100_000
    assert seen['first weights'] != seen['later weights']
    assert seen['clock'] == seen['spoken'] == f'0.50 s, 6 of {FRAMES}'
    assert seen['clock after a key'] == f'0.40 s, 5 of {FRAMES}'


@in_a_browser
def test_layers_modes_and_play(page, tmp_path):
    seen = visit(
        page,
        """
        look('first');
        get('layer-1').click(); look('both'); get('layer-1').click(); look('again');
        get('show-truth').click(); look('without truth'); get('show-truth').click();
        get('show-trajectories').click(); look('ways'); get('show-trajectories').click();
        get('align').click(); look('aligned'); get('align').click();
        look('image with', 'image'); get('with-modes').click(); look('image without', 'image');
        seen.rows = document.querySelectorAll('#modes tbody tr').length;
        document.querySelector('#modes button').click(); look('alone');
        document.querySelector('#modes button').click(); look('all');
        get('chosen').value = 2; get('chosen').dispatchEvent(new Event('change'));
        seen.trajectories = document.querySelectorAll('#modes tbody tr').length;
        seen.errors = get('errors-figure').hidden;
        get('play').click(); seen.playing = get('play').getAttribute('aria-pressed');
        for (let i = 0; i < 100 && Number(get('time').value) < 2; i += 1) await pause(50);
        get('play').click(); seen.time = Number(get('time').value);
        seen.paused = get('play').textContent;
        ['together', 'each', 'absolute', 'free-energy', 'iterations'].forEach((id) => look(id, id));
        seen.scores = document.querySelectorAll('#scores tbody tr').length;
        seen.named = [...document.querySelectorAll('button, input, select, canvas')].every((x) => (
          x.textContent.trim() || x.getAttribute('aria-label') || (x.labels && x.labels.length)
        ));
        seen.title = get('title').textContent;
        seen.onPelvis = get('align').checked;
        """,
        tmp_path,
    )
    # With a truth.
    assert seen['onPelvis'] is True
    views = ['first', 'both', 'without truth', 'ways', 'aligned', 'alone']
    assert len({seen[name] for name in views}) == len(views)
    assert seen['again'] == seen['all'] == seen['first']
    assert seen['image with'] != seen['image without']
    assert seen['rows'] == 3
    assert seen['trajectories'] == TRAJECTORIES
    assert seen['errors'] is True
    assert seen['playing'] == 'true'
    assert 2 <= seen['time'] < FRAMES
    assert seen['paused'] == 'Play'
    assert (
        min(
            seen[f'{name} drawn']
            for name in ('together', 'each', 'absolute', 'free-energy', 'iterations')
        )
        > 500
    )
    assert seen['scores'] == 3
    assert seen['named'] is True
    assert seen['title'] == 'out: mixtures over poses'


@pytest.mark.usefixtures('no_pictures')
@in_a_browser
def test_floor_and_contacts_are_drawn(body, poses, tmp_path):
    guessed = make(write_out(tmp_path / 'plain', body, poses), tmp_path / 'one', '--times', '3')
    known = make(with_ground(tmp_path, body, poses), tmp_path / 'two', '--times', '3')
    steps = "look('space'); seen.caption = get('space-caption').textContent;"
    steps += 'seen.floor = space.floorAt(1, -2);'
    seen = [visit(page, steps, tmp_path, '#frame=2') for page in (guessed, known)]
    assert 'does not tell the floor' in seen[0]['caption']
    assert 'The grid is the floor' in seen[1]['caption']
    assert seen[0]['space'] != seen[1]['space']
    # -0.8 y - 0.6 z + 1.5 = 0 at x = 1 and z = 2; the page negates y and z.
    assert abs(seen[1]['floor'] + (1.5 - 0.6 * 2) / 0.8) < 1e-6


@pytest.mark.usefixtures('no_pictures')
@in_a_browser
def test_keys_buttons_detector_regions_and_shadow(made, body, poses, tmp_path):
    steps = """
        const toggles = [...get('layers').children];
        seen.keys = toggles.map((button) => button.getAttribute('aria-keyshortcuts'));
        seen.names = toggles.map((button) => button.lastChild.textContent);
        seen.on = toggles.map(pressed);
        look('all');
        key(document.body, '4'); seen.pressed = pressed(get('show-regions')); look('regions');
        key(document.body, '4'); look('no regions');
        key(toggles[0], '3'); seen.detector = pressed(get('show-detector')); look('no detector');
        get('show-detector').click(); look('detector again');
        toggles[0].focus(); key(toggles[0], 'ArrowRight'); seen.clock = get('clock').value;
        key(toggles[0], ' '); seen.left = get('play').textContent;
        key(document.body, ' '); seen.playing = get('play').textContent;
        key(document.body, ' ');
        get('beside').click(); look('beside');
        seen.both = pressed(get('layer-1'));
        get('beside').click(); get('layer-1').click();
        // The shadow alone is of pure black that is not opaque.
        const dark = () => {
          const data = pixelsOf('space');
          let count = 0;
          for (let i = 0; i < data.length; i += 4) {
            const black = !(data[i] + data[i + 1] + data[i + 2]);
            if (black && data[i + 3] > 8 && data[i + 3] < 128) count += 1;
          }
          return count;
        };
        get('show-detector').click();
        seen.shadow = dark();
        get('layer-0').click(); seen['no shadow'] = dark(); get('layer-0').click();
        // Ellipses against points of the ellipsoids.
        const [layer] = layers;
        const offset = layer.starts[shown.time];
        const places = layer.joints.map((_, joint) => jointOf(layer, offset, joint));
        const project = space.projection(600, 400);
        const ellipses = [];
        const pen = { beginPath() {}, fill() {}, stroke() {} };
        pen.ellipse = (...drawn) => ellipses.push(drawn);
        const mode = { figure: layer, offset, places, style: 'posterior', strength: 1 };
        space.drawRegions(pen, project, mode);
        seen.reached = places.map((place, joint) => {
          const i = (offset * places.length + joint) * 6;
          const root = Array.from(layer.regions.slice(i, i + 6), (x) => x * report.region);
          const [xx, yy, zz, xy, xz, yz] = root;
          const [u, v, long, short, turn] = ellipses[joint];
          let most = 0;
          for (let k = 0; k < 2000; k += 1) {
            const c = 1 - (2 * k + 1) / 2000;
            const radius = Math.sqrt(1 - c * c);
            const [a, b] = [radius * Math.cos(2.4 * k), radius * Math.sin(2.4 * k)];
            const rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
            const [x, y, z] = rows.map((row) => row[0] * a + row[1] * b + row[2] * c);
            const at = project(place[0] + x, place[1] - y, place[2] - z);
            const [p, q] = [at[0] - u, at[1] - v];
            const along = p * Math.cos(turn) + q * Math.sin(turn);
            const across = q * Math.cos(turn) - p * Math.sin(turn);
            most = Math.max(most, Math.hypot(along / long, across / short));
          }
          return most;
        });
    """
    bag = with_detector(tmp_path / 'bag', made.out, body, poses)
    page = make(bag, tmp_path / 'report', '--images', made.images)
    seen = visit(page, steps, tmp_path, '#frame=3')
    assert seen['names'] == ['filter', 'smoothed', 'detector', '90 % regions', 'paths']
    assert seen['keys'] == ['1', '2', '3', '4', '5']
    assert seen['on'] == [True, False, True, False, False]
    assert (seen['pressed'], seen['detector']) == (True, False)
    assert len({seen[name] for name in ('all', 'regions', 'no detector', 'beside')}) == 4
    assert seen['no regions'] == seen['detector again'] == seen['all']
    assert seen['clock'] == f'0.40 s, 5 of {FRAMES}'
    # The space bar on a button presses the button.
    assert (seen['left'], seen['playing']) == ('Play', 'Pause')
    assert seen['both'] is True
    assert seen['shadow'] > 500
    assert seen['no shadow'] == 0
    assert len(seen['reached']) == len(body.joint_names)
    # The pelvis relative to itself has no uncertainty; perspective bends an ellipse a little.
    assert seen['reached'][0] is None
    assert all(0.97 < most < 1.03 for most in seen['reached'][1:])


@in_a_browser
def test_a_phone_shows_all_of_it(page, tmp_path):
    inner = tmp_path / 'inner.html'
    told = """<script>addEventListener('load', () => setTimeout(() => {
        const { scrollWidth, clientWidth } = document.documentElement;
        const play = document.getElementById('play').getBoundingClientRect();
        parent.postMessage([scrollWidth, clientWidth, play.bottom, innerHeight], '*');
    }, 500));</script></body>"""
    inner.write_text(page.replace('</body>', told, 1), 'utf-8')
    outer = '<head>\n</head><body></body>'
    steps = """
        const phone = document.createElement('iframe');
        phone.style = 'width: 360px; height: 740px; border: 0';
        phone.src = 'inner.html';
        const told = new Promise((done) => addEventListener('message', ({ data }) => done(data)));
        document.body.append(phone);
        seen.told = await told;
    """
    width, room, bottom, height = visit(outer, steps, tmp_path)['told']
    assert width == room <= 360
    # The time control stays in view.
    assert 0 < bottom < height == 740


def with_identities(message):
    """Modes of two motions, with their order swapped in every other image."""
    swapped = message.header.stamp.nanosec // 100_000_000 % 2
    for k, component in enumerate(message.components):
        component.id = (5 if k == swapped else 8) if k < 2 else 0
    return message


@pytest.mark.usefixtures('no_pictures')
@in_a_browser
def test_filter_and_smoother_are_drawn_side_by_side(page, made, tmp_path):
    steps = """
        look('first');
        get('beside').click(); look('beside');
        seen.smoother = pressed(get('layer-1'));
        get('layer-1').click(); look('filter alone');
        get('layer-1').click(); look('both again');
        get('beside').click(); look('over each other');
    """
    seen = visit(page, steps, tmp_path)
    assert seen['smoother'] is True
    views = ['first', 'beside', 'over each other']
    assert len({seen[name] for name in views}) == len(views)
    assert seen['both again'] == seen['beside']
    # Without the smoother only the filter is shown.
    assert seen['filter alone'] == seen['first']
    given = visit(page, "look('beside');", tmp_path, '#show=0,1,truth,beside')
    assert given['beside'] == seen['beside']
    alone = make(made.out, tmp_path / 'alone', '--topic', 'pose_mixture')
    steps = "seen.hidden = get('beside-label').hidden;"
    assert visit(alone, steps, tmp_path, '#show=0,beside')['hidden'] is True


@pytest.mark.usefixtures('no_pictures')
@in_a_browser
def test_several_people_are_shown_together(body, poses, tmp_path):
    out = tmp_path / 'out'
    rng = np.random.default_rng(0)
    with BagWriter(out) as bag:
        named = message_of_body(MESSAGES, body, STAMPS[0], FRAME_ID)
        for name in ('p1', 'p2'):
            bag.write(f'humans/bodies/{name}/body', STAMPS[0], named)
        for i, stamp in enumerate(STAMPS):
            for name in ('p1', 'p2'):
                mixture = mixture_of(body, poses[i], 2, rng)
                for topic, kind in (
                    ('pose_mixture', MixtureKind.POSTERIOR),
                    ('likelihood_mixture', MixtureKind.LIKELIHOOD),
                ):
                    message = pose_message(body, mixture, stamp, kind)
                    bag.write(f'humans/bodies/{name}/{topic}', stamp, message)
    steps = """
        const buttons = [...get('layers').children].slice(0, 4);
        seen.names = buttons.map((button) => button.textContent.slice(1));
        seen.on = buttons.map(pressed);
        look('both'); get('layer-1').click(); look('one');
    """
    seen = visit(make(out, tmp_path / 'report'), steps, tmp_path)
    assert sorted(seen['names']) == ['p1', 'p1, likelihood', 'p2', 'p2, likelihood']
    assert [on for name, on in zip(seen['names'], seen['on']) if ',' not in name] == [True, True]
    assert sum(seen['on']) == 2
    assert seen['both'] != seen['one']


@pytest.mark.usefixtures('no_pictures')
@in_a_browser
def test_motions_are_switched_on_and_off(page, body, poses, tmp_path):
    assert visit(page, "seen.hidden = get('motions-figure').hidden;", tmp_path)['hidden'] is True
    out = write_out(tmp_path / 'out', body, poses, change=with_identities)
    steps = """
        seen.names = [...get('motions-boxes').children].map((label) => label.textContent);
        const rows = [...document.querySelectorAll('#modes tbody tr')];
        seen.motions = rows.map((row) => row.children[3].textContent);
        const on = () => [...get('motions-boxes').children].map(pressed);
        look('all'); look('weights of all', 'motions');
        get('motion-0').click(); look('without the first'); look('weights without', 'motions');
        get('motion-1').click(); look('without both');
        get('chosen').value = 1; get('chosen').dispatchEvent(new Event('change'));
        seen.others = on();
        get('chosen').value = 0; get('chosen').dispatchEvent(new Event('change'));
        seen.kept = on();
        get('motion-0').click(); get('motion-1').click(); look('all again');
        const hands = {
          identities: [[5, 8, 5]], weights: [[0.5, 0.3, 0.2]], starts: [0, 3],
          joints: ['pelvis', 'right_hand'], roots: [0],
          positions: [0, 0, 0, 0.1, 0.2, 0.5,  1, 0, 0, 1, 0, -0.2,  0, 0, 0, 0.1, 0.2, 0.3],
        };
        seen.called = [5, 8].map((identity) => nameOfMotion(hands, { identity, weights: [0.5] }));
        hands.identities = [[5, 5, 5]];
        seen.alone = nameOfMotion(hands, { identity: 5, weights: [1] });
    """
    seen = visit(make(out, tmp_path / 'report'), steps, tmp_path)
    names = [name.partition(':')[0] for name in seen['names']]
    assert len({*names}) == 3
    assert names[2] == 'without identity'
    assert seen['called'] == ['right hand nearer, 0.0 s', 'right hand farther, 0.0 s']
    assert seen['alone'] == 'the only one, 0.0 s'
    assert sorted(seen['motions']) == sorted(names)
    views = ['all', 'without the first', 'without both']
    assert len({seen[name] for name in views}) == len(views)
    assert seen['weights of all'] != seen['weights without']
    assert seen['others'] == [True, True]
    assert seen['kept'] == [False, False, True]
    assert seen['all again'] == seen['all']


@pytest.mark.usefixtures('no_pictures')
@in_a_browser
def test_a_height_or_an_angle_is_drawn_over_time(page, body, made, tmp_path):
    steps = """
        seen.first = get('banded').value;
        seen.count = get('banded').options.length;
        look('height', 'bands');
        get('banded').value = 'angles left_elbow';
        get('banded').dispatchEvent(new Event('change')); look('angle', 'bands');
        get('time').value = 5; get('time').dispatchEvent(new Event('input'));
        look('later', 'bands');
        const place = get('bands').getBoundingClientRect();
        pointer(get('bands'), 'pointerdown', place.right - 12, place.top + 20);
        seen.clock = get('clock').value;
        seen.caption = get('bands-caption').textContent;
    """
    seen = visit(page, steps, tmp_path)
    assert seen['first'] == 'joints right_wrist'
    assert seen['count'] == len(body.joint_names) + body.dimension - 3
    assert len({seen[name] for name in ('height', 'angle', 'later')}) == 3
    assert min(seen[f'{name} drawn'] for name in ('height', 'angle')) > 1000
    assert seen['clock'] == f'0.60 s, {FRAMES} of {FRAMES}'
    assert 'Heights are above the origin, the camera as a rule,' in seen['caption']
    ways = make(made.out, tmp_path / 'ways', '--topic', 'trajectory_mixture')
    assert visit(ways, "seen.hidden = get('bands-section').hidden;", tmp_path)['hidden'] is True
