"""Initial data of a simulation: positions, sizes, rates and the controllers in use."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import PAIRS, shared_sim
from hypothesis import given
from hypothesis import strategies as st

from crazysim import Sim
from crazysim.core.data import SimState, command_shape, grid_2d


@given(n=st.integers(1, 200), spacing=st.floats(0.1, 5))
def test_grid_2d_keeps_distance_and_fills_from_its_centre(n, spacing):
    points = grid_2d(n, spacing)
    assert points.shape == (n, 2)
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1) + np.where(np.eye(n), np.inf, 0)
    if n > 1:
        assert np.min(distances) == pytest.approx(spacing)
    from_centre = np.linalg.norm(points, axis=-1)
    assert np.all(np.diff(from_centre) >= -1e-12)
    assert from_centre[-1] <= spacing * np.sqrt(n) / np.sqrt(2) + spacing


def test_drones_begin_at_rest_level_and_alike_in_every_world():
    states = SimState.create(3, 5, n_rotors=6)
    np.testing.assert_array_equal(states.pos[0], states.pos[2])
    np.testing.assert_array_equal(states.pos[..., 2], np.zeros((3, 5)))
    np.testing.assert_array_equal(states.quat, np.broadcast_to([0, 0, 0, 1], (3, 5, 4)))
    for name in ("vel", "ang_vel", "force", "torque", "rotor_vel"):
        assert not np.any(getattr(states, name)), name
    assert states.rotor_vel.shape == (3, 5, 6)


@pytest.mark.parametrize("control", ["state", "attitude", "body_rate"])
def test_the_cascade_of_crazyflow_uses_every_level_below(control):
    controls = Sim(control=control, controller="crazyflow").data.controls
    used_levels = {"state": {"state", "attitude"}}.get(control, {control}) | {"force_torque", "rotor_vel"}
    fields = ("state", "attitude", "body_rate", "force_torque", "rotor_vel")
    assert {name for name in fields if getattr(controls, name) is not None} == used_levels


@pytest.mark.parametrize("dynamics, control", PAIRS)
def test_nothing_is_commanded_at_the_start(dynamics, control):
    data = shared_sim(n_worlds=2, n_drones=2, dynamics=dynamics, control=control).data
    for ctrl in (data.controls.attitude, data.controls.body_rate, data.controls.force_torque):
        if ctrl is not None:
            assert not np.any(ctrl.cmd)
            assert not np.any(ctrl.staged_cmd)
    if data.controls.state is not None:
        expected = np.zeros((2, 2, 16))
        expected[..., 12] = 1
        np.testing.assert_array_equal(data.controls.state.staged_cmd, expected)
    assert command_shape(data, control) == (2, 2, {"state": 16}.get(control, 4))


def test_no_two_leaves_share_a_buffer_that_a_rollout_may_give_away():
    """Donating a leaf (``donate_argnums``) must not invalidate another leaf."""
    data = shared_sim(n_worlds=2, n_drones=2, dynamics="first_principles", control="state").data
    pointers = {}
    for path, x in jax.tree_util.tree_leaves_with_path(data):
        if not jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            pointers.setdefault(x.unsafe_buffer_pointer(), []).append(jax.tree_util.keystr(path))
    assert not [names for names in pointers.values() if len(names) > 1]
