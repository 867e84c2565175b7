"""Pairs of convex shapes without a closed form, compared with C MuJoCo and with a search over directions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import DRONES, SHAPES, check_finite, check_pair, check_slopes

from crazysim.geometry import Shape, distance
from crazysim.geometry.shapes import N_SIZES

PAIRS = [(a, b) for a in ("capsule", "box") for b in ("cylinder", "ellipsoid", "mesh")] + [("box", "box")]
N = 1250
DEEP_TOLERANCES = {("capsule", "ellipsoid"): 1e-2}
"""Tolerances of the depths of deep overlaps of some pairs, m."""


@pytest.mark.parametrize("a, b", PAIRS)
def test_convex_pairs(x64, rng, a, b):
    check_pair(
        DRONES[a],
        SHAPES[b],
        rng,
        N,
        separated_tolerance=1e-6,
        shallow_tolerance=1e-3,
        deep_tolerance=DEEP_TOLERANCES.get((a, b), 1e-3),
    )


@pytest.mark.parametrize("a, b", PAIRS)
def test_law_08_gradients_equal_central_differences(x64, rng, a, b):
    by_pos, by_rot = check_slopes(DRONES[a], SHAPES[b], rng, N, deepest=-0.05)
    # A direction errs by the square root of the error of a distance. On parallel faces any point may be nearest.
    assert np.mean(by_pos > 5e-3) < 0.005
    assert np.mean(by_rot > 5e-3) < 0.02


@pytest.mark.parametrize("a, b", PAIRS)
def test_law_07_no_nan(a, b):
    check_finite(DRONES[a], SHAPES[b], np.float64, N)


def test_every_kind_has_a_distance():
    """Every drone shape has a distance to every kind of shape that a scene may contain: here a ball is above each.

    The other distances are only traced: they are compared with those of C MuJoCo above and in ``test_distance.py``.
    """
    shapes = {
        kind: Shape(kind, (0.3,) * n) for kind, n in N_SIZES.items() if kind not in ("mesh", "hfield", "rectangle")
    }
    heights = {kind: {"plane": 0.0, "capsule": 0.6}.get(kind, 0.3) for kind in shapes}
    pos, rot = jnp.array([0.0, 0.0, 2.0]), jnp.eye(3)
    fns = {a: lambda a=a: {b: distance(DRONES[a], shape, pos, rot) for b, shape in shapes.items()} for a in DRONES}
    for fn in fns.values():
        assert {b: x.shape for b, x in jax.eval_shape(fn).items()} == dict.fromkeys(shapes, ())
    for b, result in jax.jit(fns["sphere"])().items():
        np.testing.assert_allclose(result, 2.0 - heights[b] - DRONES["sphere"].size[0], atol=1e-5, err_msg=b)
