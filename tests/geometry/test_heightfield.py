"""Height fields against the same ground built of prisms, one to a triangle, in C MuJoCo.

MuJoCo's own distances to a height field are no oracle: overlapping shapes come out apart.
"""

import jax
import mujoco
import numpy as np
import pytest
from oracle import DRONES, SHAPES, check_finite, geom, judge, rotations, unit

from crazysim.geometry import distance, hfield, point_distance

FIELD = SHAPES["hfield"]
CELL = (2 * 0.6 / 7, 2 * 0.5 / 5)


def prisms():
    """Return the corners of the prisms between every triangle and the bottom. (n, 6, 3)"""
    x_half, y_half, _, base = FIELD.size
    n_rows, n_columns = FIELD.heights.shape
    x, y = np.meshgrid(np.linspace(-x_half, x_half, n_columns), np.linspace(-y_half, y_half, n_rows))
    top = np.stack([x, y, FIELD.heights], axis=-1)
    out = []
    for i in range(n_rows - 1):
        for j in range(n_columns - 1):
            for b, c in ((top[i, j + 1], top[i + 1, j + 1]), (top[i + 1, j + 1], top[i + 1, j])):
                triangle = np.array([top[i, j], b, c])
                out.append(np.concatenate([triangle, triangle * [1, 1, 0] - [0, 0, base]]))
    return np.array(out)


def distances_to_prisms(a, pos, quat):
    """Return the distance to the nearest prism; where it is negative, only its sign means something. (n,)"""
    bodies = prisms()
    meshes = "".join(f'<mesh name="m{k}" vertex="{" ".join(map(str, v.ravel()))}"/>' for k, v in enumerate(bodies))
    geoms = "".join(f'<geom type="mesh" mesh="m{k}"/>' for k in range(len(bodies)))
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option ccd_iterations="200" ccd_tolerance="1e-9"/>
          <asset>{meshes}</asset>
          <worldbody>{geoms}<body mocap="true">{geom(a)}</body></worldbody>
        </mujoco>""")
    data, out = mujoco.MjData(model), np.empty(len(pos))
    for i in range(len(pos)):
        data.mocap_pos[0], data.mocap_quat[0] = pos[i], quat[i]
        mujoco.mj_kinematics(model, data)
        moving = len(bodies)
        out[i] = min(mujoco.mj_geomDistance(model, data, moving, k, 1.0, None) for k in range(moving))
    return out


def near(rng, n):
    """Return poses around the surface, its rim included."""
    return rng.uniform(-1, 1, (n, 3)) * [0.7, 0.6, 0.4] + [0, 0, 0.3], unit(rng.normal(size=(n, 4)))


@pytest.mark.parametrize("kind", DRONES)
def test_drones_over_a_height_field(x64, rng, kind):
    pos, quat = near(rng, 300)
    pos[:, :2] = np.clip(pos[:, :2], -0.4, 0.4) if kind != "sphere" else pos[:, :2]
    found, by_pos, _ = judge(DRONES[kind], FIELD)(pos, rotations(quat))
    expected = distances_to_prisms(DRONES[kind], pos, quat)
    apart = expected > 0
    assert min(np.sum(apart & (expected < 0.1)), np.sum(~apart)) > 40
    np.testing.assert_array_equal(found > 0, apart)
    exact = apart & (expected < 0.08)
    np.testing.assert_allclose(found[exact], expected[exact], atol=1e-5)
    assert np.all(found[apart] > expected[apart] - 1e-5)  # beyond, an upper bound
    np.testing.assert_allclose(np.linalg.norm(by_pos, axis=1), 1, atol=1e-6)


def test_depth_below_a_height_field_is_that_of_the_nearest_surface(x64, rng):
    """Lifted off the ground along the gradient by its depth, a point is on the surface, a wall or the bottom."""
    points = near(rng, 2000)[0]
    answer = jax.jit(jax.vmap(jax.value_and_grad(lambda p: point_distance(FIELD, p))))
    depth, slope = map(np.asarray, answer(points))
    shallow = (depth < 0) & (depth > -min(CELL))
    assert np.sum(shallow) > 300
    lifted = points - depth[:, None] * slope
    np.testing.assert_allclose(np.asarray(answer(lifted)[0])[shallow], 0, atol=1e-9)
    # No neighbour is deeper by more than its distance: nothing nearer was overlooked.
    moved = points + 0.02 * unit(rng.normal(size=points.shape))
    assert np.max(np.abs(np.asarray(answer(moved)[0]) - depth)[shallow]) < 0.02 + 1e-9


def test_reach_by_hand(x64):
    """A peak two cells away is nearer than the plain below: a sphere that large sees it, a point does not."""
    heights = np.zeros((9, 9))
    heights[4, 6] = 1.0
    field = hfield(heights, (0.4, 0.4, 1.0, 0.1))
    point = np.array([0.0, 0.0, 0.9])
    nearest = 0.2 * 10 / np.hypot(10, 1) - (1 - 0.9) * 1 / np.hypot(10, 1) * 1  # to the slope's plane, at most
    of_sphere = distance(DRONES["sphere"].__class__("sphere", (0.3,)), field, point, np.eye(3)) + 0.3
    assert float(point_distance(field, point)) > 0.5
    assert float(of_sphere) < nearest + 0.01


@pytest.mark.parametrize("kind", DRONES)
def test_law_07_no_nan(kind):
    check_finite(DRONES[kind], FIELD, np.float32)


def test_law_01_one_drone_then_many(x64, rng):
    pos, quat = near(rng, 4)
    rot = rotations(quat)
    of = jax.jit(lambda p, r: distance(DRONES["box"], FIELD, p, r))
    many = of(pos.reshape(2, 2, 3), rot.reshape(2, 2, 3, 3))
    np.testing.assert_allclose(np.ravel(many), [of(p, r) for p, r in zip(pos, rot, strict=True)], atol=1e-12)
