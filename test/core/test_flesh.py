"""Rings and surfaces of the flesh: the equations of `body.flesh` in numpy; bad input is refused."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros import core
from hmt_ros.body.flesh import Superquadrics
from test.core.arguments import assert_arguments_are_checked

P, R = 4, 60


@pytest.fixture
def parts():
    rng = np.random.default_rng(0)
    signed = rng.uniform(-1.0, 1.0, (2, P, 2))
    return Superquadrics(
        rng.normal(size=(P, 3)),
        rng.uniform(0.05, 0.3, (P, 3)),
        rng.uniform(0.5, 1.5, (P, 2)),
        0.5 * signed[0],
        0.1 * signed[1],
    )


def rings(parts, of, s):
    """Centres, radii, slopes and leans of rings (R,) on parts (R,) at heights (R,)."""
    centres, radii, exponents, tapers, bends = (x[of] for x in parts)
    s, power = s[:, None], 2.0 / exponents[:, :1]
    inside = 1.0 - np.abs(s) ** power
    steep = -np.sign(s) * np.abs(s) ** (power - 1.0) / inside
    widening = 1.0 + tapers * s
    radius = radii[:, :2] * inside ** (1.0 / power) * widening
    slope = -(steep + tapers / widening) / radii[:, 2:]
    aside = centres[:, :2] + bends * (1.0 - s * s)
    centre = np.concatenate([aside, centres[:, 2:] - radii[:, 2:] * s], axis=1)
    return centre, radius, slope, 2.0 * bends * s / radii[:, 2:]


def test_rings_follow_their_equations(parts):
    of, s = np.arange(R) % P, np.linspace(-0.98, 0.98, R)
    found = np.empty((R, 3)), *np.empty((3, R, 2))
    core.fill_rings(parts, of, s, *found)
    for own, wanted in zip(found, rings(parts, of, s), strict=True):
        np.testing.assert_allclose(own, wanted, rtol=1e-12, atol=1e-15)
    outputs = dict(zip(('centre', 'radius', 'slope', 'lean'), found, strict=True))
    named = {'parts': parts, 'ring_parts': of, 'heights': s, **outputs}
    assert_arguments_are_checked(core.fill_rings, named, ' '.join(outputs))


def test_surfaces_follow_their_equations(parts):
    w, s = np.linspace(-3.0, 3.0, R), np.linspace(-0.98, 0.98, R)
    points, normals = np.empty((2, P, R + 2, 3))
    core.fill_surface(parts, s, np.cos(w), np.sin(w), points, normals)
    around = np.stack([np.cos(w), np.sin(w)], axis=1)
    for p in range(P):
        centre, radius, slope, lean = rings(parts, np.full(R, p), s)
        e2 = parts.exponents[p, 1]
        centre[:, :2] += radius * np.sign(around) * np.abs(around) ** e2
        lateral = np.sign(around) * np.abs(around) ** (2.0 - e2) / radius
        along = -(slope * around**2 + lateral * lean).sum(1, keepdims=True)
        normal = np.concatenate([lateral, along], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        tip = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
        ends = parts.centres[p] + parts.radii[p, 2] * tip
        np.testing.assert_allclose(points[p], [*centre, *ends], rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(normals[p], [*normal, *tip], rtol=1e-12, atol=1e-14)
    named = {'parts': parts, 'heights': s, 'cosines': np.cos(w), 'sines': np.sin(w)}
    outputs = {'points': points, 'normals': normals}
    assert_arguments_are_checked(core.fill_surface, named | outputs, ' '.join(outputs))
