"""Law 2: batch axes are declared, never guessed from lengths."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import CHOSEN_PAIRS, LEVELS, PAIRS, count_documented_arrays, shared_sim, with_params, with_states

from crazysim import ConfigError, Control, Sim
from crazysim.core.data import SimData
from crazysim.engine import Step
from crazysim.engine.pytree import scopes

SIZES = [(n, m) for n in (1, 2, 3, 4) for m in (1, 2, 3, 4)]
EQUAL_SIZES, UNEQUAL_SIZES = ([size for size in SIZES if (size[0] == size[1]) == same] for same in (True, False))


def make_data(sim, n_worlds, n_drones):
    """Return the data that ``Sim`` would build for these numbers of worlds and drones, without building a scene."""
    freqs, ids = dict.fromkeys(Control, 100), np.arange(n_drones)
    settings = sim.dynamics, sim.control, sim.airframe, sim.freq, freqs, ids, 0, sim.configuration.controller
    return SimData.create(n_worlds, n_drones, *settings)


def with_drone_parameters(data):
    shape = data.states.pos.shape[:2]

    def broadcast(record):
        return jax.tree.map(lambda x: np.broadcast_to(x, (*shape, *x.shape)), record)

    controls = data.controls
    changes = {
        level: record.replace(params=broadcast(record.params))
        for level in LEVELS[:4]
        if (record := getattr(controls, level)) is not None and record.params is not None
    }
    return data.replace(params=broadcast(data.params), controls=controls.replace(**changes))


def array_types(tree):
    return jax.tree.structure(tree), [(x.shape, x.dtype) for x in jax.tree.leaves(tree)]


def run_all_stages(sim, data):
    """Return the data after all stages, run one after the other without an engine."""
    for stage in Step(sim.step_pipeline, "plain").stages:
        data = stage(data)
    return data


@pytest.mark.long("traces the step for every number of worlds and drones")
@pytest.mark.parametrize("dynamics, control", CHOSEN_PAIRS)
def test_a_step_keeps_every_shape_and_type(dynamics, control):
    """Law 2, for equal and unequal numbers of worlds and drones, with shared parameters and one per drone."""
    sim = shared_sim(dynamics=dynamics, control=control)
    # One pair is tested with all sizes. The other pairs, whose stages are batched alike, are tested with a few each.
    k = CHOSEN_PAIRS.index((dynamics, control))
    equal, unequal = EQUAL_SIZES[(k + 1) % 4], UNEQUAL_SIZES[k % 12]
    cases = [
        ("step", *equal),
        ("step", *unequal),
        *(("stages", *size) for size in (SIZES if control == "rotor_vel" else (equal,))),
    ]
    steps = {
        "step": functools.partial(Step(sim.step_pipeline, "interpret"), n_steps=1),
        "stages": functools.partial(run_all_stages, sim),
    }
    for name, n_worlds, n_drones in cases:
        data = make_data(sim, n_worlds, n_drones)
        if (n_worlds + n_drones) % 2 == 0:
            data = with_drone_parameters(data)
        after = jax.eval_shape(steps[name], data)
        assert array_types(after) == array_types(data), (name, n_worlds, n_drones)


@pytest.mark.parametrize("dynamics, control", PAIRS)
def test_scopes_determine_the_axes(dynamics, control):
    """Law 2: drone leaves are (n_worlds, n_drones, *core), world leaves (n_worlds, 1, *core), shared ones core."""
    sim = shared_sim(dynamics=dynamics, control=control)
    single_data = make_data(sim, 1, 1)
    counts = dict.fromkeys(("drone", "world", "shared"), 0)
    for n_worlds, n_drones in SIZES:
        data = make_data(sim, n_worlds, n_drones)
        for scope, x, single in zip(*map(jax.tree.leaves, (scopes(data), data, single_data)), strict=True):
            batch = {"drone": (n_worlds, n_drones), "world": (n_worlds, 1), "shared": ()}[scope]
            core = single.shape[len(batch) :]
            is_ids = x is data.core.drone_mocap_ids  # shared, with one number per drone
            assert x.shape == (*batch, *((n_drones,) if is_ids else core))
            counts[scope] += 1
        spread = scopes(with_drone_parameters(data))
        assert set(jax.tree.leaves((spread.params, spread.controls))) == {"drone"}
    assert all(counts.values())


def test_the_resized_data_equal_those_of_a_new_simulation():
    """The shapes above are those of a real simulation, with as many worlds as drones and with more drones."""
    for n_worlds, n_drones in ((3, 3), (2, 4)):
        sim = Sim(n_worlds, n_drones, control="state", attitude_freq=100, force_torque_freq=100)
        assert array_types(sim.data) == array_types(make_data(sim, n_worlds, n_drones))


@pytest.fixture(scope="module")
def three_by_three():
    """Return a simulation of three worlds of three drones, high up, without weight or thrust."""
    sim = Sim(3, 3, control="rotor_vel")
    p = sim.data.params
    curve = np.array(p.rpm2thrust)
    curve[:, 0] = 0.0
    data = with_params(sim.data, gravity_vec=np.zeros(3, np.float32), rpm2thrust=curve)
    sim.data = with_states(data, pos=[0.0, 0.0, 10.0], force=[0.03, -0.02, 0.01])
    return sim


@pytest.mark.parametrize("shape", [(3,), (3, 1, 1), (3, 3), (2, 3, 1), ()])
def test_a_mass_of_a_world_without_an_axis_of_drones_is_refused(three_by_three, shape):
    """Law 2: a parameter is shared or per drone; the user must broadcast a parameter of a world to its drones."""
    wrong = with_params(three_by_three.data, mass=np.full(shape, 0.03, np.float32))
    with pytest.raises(ConfigError) as error:
        three_by_three.step_fn(wrong, jnp.int32(1))
    assert f"data.params.mass has shape {shape}; expected 3 dimensions that begin with (3, 3)" in str(error.value)
    assert "or 1 if all drones share it" in str(error.value)


@pytest.mark.parametrize("dynamics, control", PAIRS)
def test_docstrings_give_the_shapes(dynamics, control):
    data = make_data(shared_sim(dynamics=dynamics, control=control), 2, 3)
    assert count_documented_arrays(data, n_worlds=2, n_drones=3, n_rotors=4) == len(jax.tree.leaves(data))


@pytest.mark.parametrize("controller", ["pid", "mellinger", "crazyflow", ("pid", "mellinger")], ids=str)
def test_docstrings_of_controllers_give_the_shapes(controller):
    """Law 2, for controllers other than the default, and for a choice of controllers per drone."""
    switch = {} if isinstance(controller, str) else {"switch": 0}
    sim = Sim(2, 3, control="state", controller=controller if isinstance(controller, str) else [*controller], **switch)
    record = sim.data.controls
    assert count_documented_arrays(record, n_worlds=2, n_drones=3, n_rotors=4) == len(jax.tree.leaves(record))
