"""Height fields compared with the same ground built of prisms, one per triangle, in C MuJoCo.

MuJoCo's own distances to a height field cannot serve as reference: it reports overlapping shapes as separated.
"""

import jax
import mujoco
import numpy as np
import pytest
from oracle import DRONES, SHAPES, check_finite, compile_distance_and_slopes, geom_xml, normalize, rotations

from crazysim.geometry import Shape, hfield
from crazysim.geometry import distance as eager_distance
from crazysim.geometry import point_distance as eager_point_distance

distance = jax.jit(eager_distance, static_argnums=(0, 1))
point_distance = jax.jit(eager_point_distance, static_argnums=0)

FIELD = SHAPES["hfield"]
N = 1250
CELL = (2 * 0.6 / 7, 2 * 0.5 / 5)
"""Size of a cell along x and y, m."""


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
    """Return the distance to the nearest prism, m; of a negative distance only the sign is meaningful. (n,)"""
    corners_of_prisms = prisms()
    meshes = "".join(
        f'<mesh name="m{k}" vertex="{" ".join(map(str, v.ravel()))}"/>' for k, v in enumerate(corners_of_prisms)
    )
    geoms = "".join(f'<geom type="mesh" mesh="m{k}"/>' for k in range(len(corners_of_prisms)))
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option ccd_iterations="200" ccd_tolerance="1e-9"/>
          <asset>{meshes}</asset>
          <worldbody>{geoms}<body mocap="true">{geom_xml(a)}</body></worldbody>
        </mujoco>""")
    data, out = mujoco.MjData(model), np.empty(len(pos))
    for i in range(len(pos)):
        data.mocap_pos[0], data.mocap_quat[0] = pos[i], quat[i]
        mujoco.mj_kinematics(model, data)
        moving = len(corners_of_prisms)
        out[i] = min(mujoco.mj_geomDistance(model, data, moving, k, 1.0, None) for k in range(moving))
    return out


def draw_poses_near_surface(rng, n):
    return rng.uniform(-1, 1, (n, 3)) * [0.7, 0.6, 0.4] + [0, 0, 0.3], normalize(rng.normal(size=(n, 4)))


@pytest.mark.parametrize("kind", DRONES)
def test_drones_over_a_height_field(x64, rng, kind):
    pos, quat = draw_poses_near_surface(rng, N)
    pos[:, :2] = np.clip(pos[:, :2], -0.4, 0.4) if kind != "sphere" else pos[:, :2]
    result, by_pos, _ = (x[:200] for x in compile_distance_and_slopes(DRONES[kind], FIELD)(pos, rotations(quat)))
    expected = distances_to_prisms(DRONES[kind], pos[:200], quat[:200])
    is_apart = expected > 0
    assert min(np.sum(is_apart & (expected < 0.1)), np.sum(~is_apart)) > 30
    np.testing.assert_array_equal(result > 0, is_apart)
    exact = is_apart & (expected < 0.08)
    np.testing.assert_allclose(result[exact], expected[exact], atol=1e-5)
    assert np.all(result[is_apart] > expected[is_apart] - 1e-5)  # beyond, an upper bound
    np.testing.assert_allclose(np.linalg.norm(by_pos, axis=1), 1, atol=1e-6)


def test_depth_below_a_height_field_is_that_of_the_nearest_surface(x64, rng):
    """Moved along the gradient by its depth, a point is on the surface, a wall or the bottom."""
    points = draw_poses_near_surface(rng, N)[0]
    sphere = lambda p: compile_distance_and_slopes(DRONES["sphere"], FIELD)(p, np.tile(np.eye(3), (N, 1, 1)))  # noqa: E731
    depth, slope, _ = sphere(points)
    depth = depth + 0.1
    shallow = (depth < 0) & (depth > -min(CELL))
    assert np.sum(shallow) > 200
    lifted = points - depth[:, None] * slope
    np.testing.assert_allclose((sphere(lifted)[0] + 0.1)[shallow], 0, atol=1e-9)
    # No neighbour is deeper by more than its distance: nothing nearer was overlooked.
    moved = points + 0.02 * normalize(rng.normal(size=points.shape))
    assert np.max(np.abs(sphere(moved)[0] + 0.1 - depth)[shallow]) < 0.02 + 1e-9


def test_reach_by_hand(x64):
    """A peak two cells away is nearer than the plain below: a sphere of that radius is affected, a point is not."""
    heights = np.zeros((9, 9))
    heights[4, 7] = 1.0  # at x = 0.3, y = 0; along x the slope begins at 0.2
    field, point = hfield(heights, (0.4, 0.4, 1.0, 0.1)), np.array([0.0, 0.0, 0.9])
    np.testing.assert_allclose(point_distance(field, point), 0.9, atol=1e-12)
    sphere_distance = distance(Shape("sphere", (0.3,)), field, point, np.eye(3))
    np.testing.assert_allclose(sphere_distance, (0.2 * 10 + 0.9) / np.sqrt(101) - 0.3, atol=1e-12)


@pytest.mark.parametrize("kind", DRONES)
def test_law_07_no_nan(kind):
    check_finite(DRONES[kind], FIELD, np.float64, N)
