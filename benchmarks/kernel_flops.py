"""What one evaluation of a pose computes: floating-point operations and bytes, term by term.

The operations are counted: a process without the compiler runs the kernels in Python, on numbers
that count what is done to them. Additions, products, quotients, roots and powers count one each,
comparisons and conversions nothing. Run as a module it prints the counts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Camera, load_body
from hmt_ros.body.ground_terms import FloorPlane, GroundSettings, GroundTerm
from hmt_ros.body.kinematics import forward
from hmt_ros.image import pose_energy
from hmt_ros.image.likelihood import ImageLikelihood, ObservedImage
from hmt_ros.image.observation import observe
from hmt_ros.image.optical_flow import FlowTerm
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface_points import seen_points
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.energy import Derivatives, Quadratic

Array = NDArray[np.float64]
CAMERA = Camera(660.0, 660.0, 319.5, 239.5, 640, 480)
PLACING, ALL = 'frames of the segments', 'all together'
# Kinds of derivatives by the name of their columns.
KINDS = {'value': Derivatives.NONE, 'sums': Derivatives.POSITIVE}


def energies(poses: int) -> tuple[dict[str, PoseEnergy], Array]:
    """Energies of a person who walks, one term each and all together, and so many poses (N, d)."""
    body = load_body('human37')
    view = Viewpoint(distance=3.6)
    shown = procedural_motion('walk', body, 0.8, 10.0, 3, viewpoint=view)[4:6]
    _, now = render_frames(body, shown, CAMERA, Scene(viewpoint=view))
    rng = np.random.default_rng(0)
    pixels = CAMERA.project(body.joint_positions(shown[1:]))[0]
    pixels += 2.0 * rng.normal(size=pixels.shape)
    covariances = np.tile(4.0 * np.eye(2), (len(pixels), 1, 1))
    keypoints = Keypoints(body.joint_names, pixels, covariances, np.ones(len(pixels)))
    observation = observe(now.image, now.mask, keypoints=keypoints)
    x = shown[1] + 0.1 * rng.normal(size=(poses, body.dimension))
    x[:, :3] = shown[1, :3] + 0.03 * rng.normal(size=(poses, 3))
    x = np.clip(x, body.lower, body.upper)

    likelihood = ImageLikelihood(body, CAMERA, threads=1)
    image, joints = likelihood.seen(observation)
    prior, overlaps = likelihood.priors
    ground = GroundTerm(
        body, GroundSettings(), FloorPlane(np.array([0.0, -1.0, 0.0]), 0.05, 1.2, 0.02)
    )
    flow = FlowTerm(
        seen_points(body, CAMERA, forward(body.skeleton, x)),
        ImageMap(rng.normal(0.0, 3.0, (2, 480, 640)).astype(np.float32)), 5.0,
    )  # fmt: skip
    nothing = PoseEnergy(likelihood, ())

    def without(name: str) -> PoseEnergy:
        own = getattr(likelihood.settings, name)
        settings = replace(likelihood.settings, **{name: replace(own, weight=0.0)})
        fewer = replace(likelihood, settings=settings)
        return PoseEnergy(fewer, (ObservedImage(fewer, observation),))

    return {
        PLACING: nothing,
        'image, contour and coverage': without('edges'),
        'image, contour and edges': without('coverage'),
        'keypoints': replace(nothing, terms=(joints,)),
        'pose prior': replace(nothing, terms=(prior,)),
        'self-intersection': replace(nothing, terms=(overlaps,)),
        'ground': replace(nothing, terms=(ground,)),
        'optical flow': replace(nothing, terms=(flow,)),
        'motion': replace(nothing, motion=Quadratic(shown[1], 5.0 * np.eye(body.dimension))),
        ALL: PoseEnergy(
            likelihood, (image, joints, prior, overlaps, ground),
            Quadratic(shown[1], 5.0 * np.eye(body.dimension)),
        ),
    }, x  # fmt: skip


def counts(names: Sequence[str]) -> dict[str, dict[str, float]]:
    """By energy of `energies` the operations of one pose, and the bytes of what it reads."""
    environment = {**os.environ, 'NUMBA_DISABLE_JIT': '1'}
    command = [sys.executable, '-m', 'benchmarks.kernel_flops', *names]
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if found.returncode:
        raise RuntimeError(f'the operations can not be counted: {found.stderr.strip()[-400:]}')
    result: dict[str, dict[str, float]] = json.loads(found.stdout)
    return result


class Counting(float):
    """A number that counts what is computed with it."""

    done = 0


def _counting(name: str) -> Callable[..., Any]:
    own = getattr(float, name)

    def compute(*args: float) -> Any:
        result = own(*args)
        if result is NotImplemented:
            return result
        Counting.done += 1
        return Counting(result)

    return compute


for _name in ('add', 'sub', 'mul', 'truediv', 'pow'):
    setattr(Counting, f'__{_name}__', _counting(f'__{_name}__'))
    setattr(Counting, f'__r{_name}__', _counting(f'__r{_name}__'))


def _function(name: str) -> Callable[[Any], Any]:
    own = getattr(np, name)

    def compute(x: Any) -> Any:
        Counting.done += 1
        return Counting(own(float(x)))

    return compute


def _same(x: Any) -> Any:
    """Stands for conversions to other precisions."""
    return x


class _CountingNumpy:
    """numpy as kernels use it: arrays of numbers that count."""

    def __getattr__(self, name: str) -> Any:
        if name in {'sqrt', 'exp', 'log', 'log1p', 'cos', 'sin', 'arctan', 'tanh'}:
            return _function(name)
        if name in {'empty', 'zeros', 'ones', 'full'}:
            return lambda *args: counted(
                getattr(np, name)(*(float if x is _same else x for x in args))
            )
        if name in {'float32', 'float64'}:
            return _same
        if name in {'isfinite', 'sign', 'abs'}:
            return lambda x: Counting(getattr(np, name)(float(x)))
        return getattr(np, name)


def counted(value: Any) -> Any:
    """A value whose numbers count: floats, arrays of them, and tuples of these."""
    if isinstance(value, np.ndarray) and value.dtype.kind == 'f':
        result = np.empty(value.shape, dtype=object)
        result.ravel()[:] = [Counting(x) for x in value.ravel()]
        return result
    if isinstance(value, tuple):
        parts = [counted(x) for x in value]
        return type(value)(*parts) if hasattr(value, '_fields') else tuple(parts)
    return Counting(value) if isinstance(value, float) else value


def _bytes(value: Any) -> int:
    if isinstance(value, np.ndarray):
        return value.nbytes
    return sum(map(_bytes, value)) if isinstance(value, tuple) else 0


def _count(names: Sequence[str]) -> dict[str, dict[str, float]]:
    """See `counts`; in a process without the compiler."""
    some, poses = energies(1)
    compiled_module: Any = pose_energy
    own = compiled_module.solve
    loaded: list[Any] = [x for x in sys.modules.values() if x.__name__.startswith('hmt_ros')]
    kernels = [module for module in loaded if hasattr(module, 'njit')]
    read = 0

    def solve(first: int, last: int, compiled: Any, *rest: Any) -> None:
        nonlocal read
        read = _bytes(compiled)
        arguments = [counted(x) for x in (compiled, *rest)]
        for module in kernels:
            module.np = _CountingNumpy()
        try:
            own(first, last, *arguments)
        finally:
            for module in kernels:
                module.np = np

    compiled_module.solve = solve
    result: dict[str, dict[str, float]] = {}
    for name in names:
        energy = some[name]
        result[name] = {}
        for kind, derivatives in KINDS.items():
            Counting.done = 0
            energy.energy(poses, derivatives=derivatives)
            result[name][kind] = Counting.done
        result[name]['bytes'] = read
    return result


if __name__ == '__main__':
    print(json.dumps(_count(sys.argv[1:])))
