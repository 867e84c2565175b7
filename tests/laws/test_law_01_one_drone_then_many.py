"""Law 1: physics and control are written for one drone, and accept any leading axes: ``f(batch)[i] == f(batch[i])``."""

import ast
import functools
import importlib
import inspect
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import FITTED_DYNAMICS

import crazysim
from crazysim import Dynamics, Sim, load_airframe
from crazysim.control import (
    AllocationParams,
    AttitudeParams,
    StateParams,
    allocation,
    attitude_controller,
    state_controller,
)
from crazysim.control.controllers import CONTROLLERS
from crazysim.dynamics import drag, first_principles, fitted, inflow, rigid_body, rotor

BATCH = (3, 2)
AIRFRAME = load_airframe("cf21B_500")
MODULES = (rigid_body, rotor, inflow, drag, first_principles, fitted, allocation, attitude_controller, state_controller)


def public_functions(module):
    functions = [f for f in vars(module).values() if inspect.isfunction(f) and f.__module__ == module.__name__]
    return [f for f in functions if "Array" in f.__annotations__["return"] and not f.__name__.startswith("_")]


CASES = [
    pytest.param(
        module, function, model, id="-".join(filter(None, [function.__module__[9:], function.__name__, model]))
    )
    for module in MODULES
    for function in public_functions(module)
    for model in (FITTED_DYNAMICS if module is fitted else (None,))
]


def make_parameters(module, model):
    if module is fitted:
        return fitted.Params.create(AIRFRAME, Dynamics(model))
    records = {allocation: AllocationParams, attitude_controller: AttitudeParams, state_controller: StateParams}
    return records.get(module, first_principles.Params).create(AIRFRAME)


def draw_command(module, function, rng):
    """Return random commands, some of them beyond limits or without thrust."""
    if module in (rotor, first_principles):
        return rng.uniform(-2e3, 3e4, (*BATCH, 4))
    if module is state_controller:
        return rng.normal(size=(*BATCH, 16))
    thrust, others = rng.uniform(-0.2, 0.8, (*BATCH, 1)), rng.uniform(-1, 1, (*BATCH, 3))
    if function is allocation.force_torque2rotor_vel:
        return np.concatenate([thrust, 0.01 * others], -1)
    return np.concatenate([others, thrust], -1)


def draw_arguments(module, function, model, rng, per_drone):
    shared = make_parameters(module, model)
    if per_drone:
        shared = jax.tree.map(lambda x: x * rng.uniform(0.9, 1.1, (*BATCH, *x.shape)), shared)
    draw_functions = {
        "quat": lambda: (q := rng.normal(size=(*BATCH, 4))) / np.linalg.norm(q, axis=-1, keepdims=True),
        "cmd": lambda: draw_command(module, function, rng),
        "prev_cmd": lambda: draw_command(module, function, rng),
        "rotor_vel": lambda: (
            rng.uniform(0, 2.5e4, (*BATCH, 4)) if module is not fitted else rng.uniform(0, 1, (*BATCH, 4))
        ),
        "rotor_acc": lambda: rng.normal(size=(*BATCH, 4)) * 1e4,
        "inertia": lambda: rng.uniform(1e-5, 2e-5, (*BATCH, 3)),
        "thrust": lambda: rng.uniform(0, 0.2, (*BATCH, 4)),
        "drag_torque": lambda: rng.uniform(0, 1e-3, (*BATCH, 4)),
    }
    if module is inflow:
        ranges = {
            "static_thrust": (0, 0.2),
            "ang_vel": (0, 2500),
            "axial_vel": (-5, 5),
            "in_plane_square": (0, 25),
            "blade": (1e-6, 1e-5),
            "radius": (0.02, 0.03),
            "air_density": (1.0, 1.3),
            "ceiling": (1.0, 1.5),
            "gap": (0, 0.2),
        }
        draw_functions = {name: functools.partial(rng.uniform, *ends, (*BATCH, 4)) for name, ends in ranges.items()}
    batched, shared_arguments = {}, {}
    for name in inspect.signature(function).parameters:
        if name in CONSTANTS:
            continue
        if name == "params":
            (batched if per_drone else shared_arguments)[name] = shared
        elif name in ("coefficients", "yaw_torque_sign") or hasattr(shared, name):
            value = {"coefficients": "rpm2thrust", "yaw_torque_sign": "mixing_matrix"}.get(name, name)
            value = getattr(shared, value)
            (batched if per_drone else shared_arguments)[name] = (
                value[..., 2, :] if name == "yaw_torque_sign" else value
            )
        else:
            batched[name] = draw_functions.get(name, lambda: rng.normal(size=(*BATCH, 3)))()
    return jax.tree.map(np.asarray, batched), shared_arguments


CONSTANTS = {"ctrl_freq": 100.0, "dt": 0.002}
"""Arguments that are known when a function is compiled."""


@pytest.mark.parametrize("module, function, model", CASES)
def test_functions_of_a_batch_equal_those_of_each_drone(module, function, model, x64, rng):
    constants = {name: x for name, x in CONSTANTS.items() if name in inspect.signature(function).parameters}
    compiled = jax.jit(lambda arguments: function(**arguments, **constants))
    for per_drone in (False, True):
        batched, shared = draw_arguments(module, function, model, rng, per_drone)
        if not batched and not per_drone:  # a function of parameters only: there is nothing to compare
            continue
        batch_results = jax.tree.leaves(jax.device_get(compiled(batched | shared)))
        assert batch_results
        for i in np.ndindex(BATCH):
            drone = jax.tree.map(lambda x, i=i: x[i], batched)
            drone_results = jax.tree.leaves(jax.device_get(compiled(drone | shared)))
            for of_batch, of_drone in zip(batch_results, drone_results, strict=True):
                assert of_batch.shape == (*BATCH, *of_drone.shape)
                assert np.all(np.isfinite(of_drone))
                # float64 rounding: one drone and many may be vectorised and contracted (FMA) differently
                scale = 1e-13 * max(1.0, float(np.abs(of_batch).max()))
                np.testing.assert_allclose(of_batch[i], of_drone, rtol=1e-12, atol=scale)


@pytest.mark.parametrize("name", [name for name in CONTROLLERS if name not in ("load_lqr", "tracking_lqr")])
def test_drones_in_a_batch_fly_like_single_drones(name, rng):
    """Law 1: drones with random states and setpoints fly in a batch like single drones.

    Controllers that need a load or a trajectory of their own are compared in tests/control.
    """

    def fly(sim, data, drawn_states):
        states = data.states.replace(**{key: jnp.asarray(x, np.float32) for key, x in drawn_states.items()})
        sim.data = data.replace(states=states)
        setpoint = np.zeros((sim.n_worlds, sim.n_drones, 16))
        setpoint[..., :3], setpoint[..., 15] = drawn_states["pos"] + drawn_states["vel"], 1.0
        setpoint[..., 12:14] = [0.6, 0.8]  # a yaw
        sim.state_control(setpoint)
        sim.step(25)
        return [np.asarray(x) for x in jax.tree.leaves(sim.data.states)]

    quat = np.array([0, 0, 0, 1.0]) + 0.2 * rng.normal(size=(*BATCH, 4))
    drawn_states = {
        "pos": rng.uniform(0.5, 1.5, (*BATCH, 3)),
        "quat": quat / np.linalg.norm(quat, axis=-1, keepdims=True),
        "vel": 0.3 * rng.normal(size=(*BATCH, 3)),
        "ang_vel": 0.5 * rng.normal(size=(*BATCH, 3)),
        "rotor_vel": rng.uniform(1.2e4, 1.6e4, (*BATCH, 4)),
    }
    batch_sim, single_sim = (
        Sim(*counts, control="state", controller=name, engine="interpret") for counts in (BATCH, (1, 1))
    )
    batch, start = fly(batch_sim, batch_sim.data, drawn_states), single_sim.data
    for i in [(0, 0), (2, 1)]:
        single = fly(single_sim, start, {key: x[i][None, None] for key, x in drawn_states.items()})
        for x, y in zip(batch, single, strict=True):
            # float32 rounding, which 25 steps of feedback with gains of PWM amplify
            np.testing.assert_allclose(x[i], y[0, 0], rtol=1e-3, atol=1e-4 * max(1.0, float(np.abs(y).max())))


def test_the_cases_cover_dynamics_and_control():
    """No module of physics or control that computes arrays is missing.

    ``parameters`` only loads arrays. Modules that controllers import count as covered by them.
    """
    covered = {m.__name__ for m in MODULES}
    for path in CONTROLLERS.values():
        module = importlib.import_module(path.partition(":")[0])
        covered |= {module.__name__} | {getattr(x, "__module__", "") for x in vars(module).values()}
    names = ("__init__", "levels", "models", "parameters")
    names += ("protocol", "controllers", "setpoint", "switch")
    for path in source_files():
        name = "crazysim." + ".".join(path.relative_to(Path(crazysim.__file__).parent).with_suffix("").parts)
        assert name in covered or path.stem in names, name
    assert len(CASES) >= 17


def source_files():
    root = Path(crazysim.__file__).parent
    paths = [p for package in ("dynamics", "control") for p in sorted((root / package).glob("*.py"))]
    assert len(paths) >= 10
    return paths


def test_physics_and_control_contain_no_batching():
    """Law 1: they contain no vmap, no loop of JAX, and no batch index.

    Riccati equations have loops over doublings, and gains along a trajectory over its setpoints.
    """
    batching = {"vmap", "pmap", "shard_map", "scan", "fori_loop", "while_loop", "n_worlds", "n_drones"}
    for path in source_files():
        forbidden = batching - {"scan", "vmap"} if path.stem in ("riccati", "tracking_lqr") else batching
        for node in ast.walk(ast.parse(path.read_text())):
            names = {getattr(node, key, None) for key in ("id", "attr", "arg", "name")}
            assert not names & forbidden, f"{path.name}:{node.lineno} uses {names & forbidden}"
