"""Law 9 for any input: a public function with an argument of any type, shape or size works, or says what it expected.

It neither hangs nor raises an error of Python, NumPy, JAX or MuJoCo. ``test_law_09_wrong_numbers.py`` has the settings
of plugins and tasks.
"""

import contextlib
import copy
import dataclasses
import functools
import inspect
import os
import pickle
import signal
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes

import crazysim
from crazysim import MPPI, ConfigError, Sim, SlungLoad, Wind, envs, load_airframe, trajectories
from crazysim.core import functional as F
from crazysim.drones import estimate_airframe
from crazysim.envs import DroneSingleEnv, DroneVectorEnv, make, registry
from crazysim.envs.brax import BraxEnv
from crazysim.envs.pettingzoo import DroneParallelEnv
from crazysim.envs.tasks.hover import Hover
from crazysim.geometry import Shape, hfield, hull
from crazysim.lab.export.casadi import to_casadi
from crazysim.lab.identify import read_log
from crazysim.media import Flight, Recorder, Trail, View, flight_of
from crazysim.sim.visualize import draw_label, draw_points, draw_setpoints
from crazysim.train import TrainConfig

PACKAGE = Path(crazysim.__file__).parent
TIME_LIMIT = 600
"""Time after which a call counts as one that hangs, s; a compilation takes some seconds, on a busy machine a minute."""


@dataclasses.dataclass
class Lazy:
    make: Callable[[], Any]


@functools.cache
def sim():
    sim = Sim(2, 2, control="state", plugins=[SlungLoad(0.01), Wind()])
    sim.handle = sim.scene.add("sphere", "ball", count=2, pos=(0, 0, 5.0))
    return sim


@functools.cache
def env(n_worlds=2, n_drones=1):
    return make("hover", n_worlds, n_drones=n_drones)


@functools.cache
def adapter(kind):
    return kind(env(1))


def adapted(kind, method, **arguments):
    adapter(kind).reset(seed=0)
    return getattr(adapter(kind), method)(**arguments)


def on_sim(method):
    def call(**arguments):
        before = sim().data
        try:
            return getattr(sim(), method)(**arguments)
        finally:
            sim().data = before

    return call


def in_new_scene(**arguments):
    return Sim().scene.add(**arguments)


def state():
    return env().reset(jax.random.key(0))


def register_for_a_moment(**arguments):
    tasks, ids = dict(envs.TASKS), set(gymnasium.registry)
    try:
        return envs.register(**arguments)
    finally:
        envs.TASKS.clear()
        envs.TASKS.update(tasks)
        for added in set(gymnasium.registry) - ids:
            del gymnasium.registry[added]


FALL = lambda params, data: jnp.zeros((2, 2, 16))  # noqa: E731
CIRCLE = trajectories.circle()
CALLS = {
    "Sim": (Sim, {
        "n_worlds": 1, "n_drones": 1, "drone": "cf21B_500", "dynamics": "first_principles", "control": "state",
        "integrator": "euler", "freq": 500, "state_freq": 100, "attitude_freq": 500, "body_rate_freq": 500,
        "force_torque_freq": 500, "device": "cpu", "xml_path": None, "rng_key": 0, "mesh": None, "engine": "auto",
        "strict": False, "controller": "auto", "switch": None, "estimator": None, "aero": None, "plugins": (),
    }),
    "make": (make, {
        "task": "hover", "n_worlds": 2, "freq": 50, "actions": None, "sensors": (), "effects": (), "randomize": None,
        "camera": None, "depth_image": None, "seconds": 5.0,
    }),
    "sim.step": (on_sim("step"), {"n_steps": 1}),
    "sim.reset": (on_sim("reset"), {"mask": None}),
    "sim.seed": (on_sim("seed"), {"seed": 0}),
    "sim.state_control": (on_sim("state_control"), {
        "check_finite": False, "pos": np.zeros(3), "vel": np.zeros(3), "acc": np.zeros(3), "yaw": 0.0,
        "feedforward": np.zeros((2, 2, 8)),
    }),
    "sim.state_control whole": (on_sim("state_control"), {"controls": np.zeros((2, 2, 16))}),
    "sim.rollout": (on_sim("rollout"), {
        "policy": FALL, "params": None, "n_control_steps": 1, "every": 1,
        "progress": False,
    }),
    "sim.contacts": (on_sim("contacts"), {"body": None}),
    "sim.contact_report": (on_sim("contact_report"), {"objects": None, "floor": True, "drones": True}),
    "sim.depth": (on_sim("depth"), {
        "camera": "fpv_cam", "width": 4, "height": 4, "drones": True, "hide_own": True, "along": "axis",
    }),
    "sim.sync": (on_sim("sync"), {"world": None}),
    "sim.add": (lambda plugin, name: Sim().add(plugin, name), {"plugin": Wind(), "name": "breeze"}),
    "sim.remove": (lambda plugin: Sim(plugins=[Wind()]).remove(plugin), {"plugin": "wind"}),
    "sim.replace": (lambda plugin: Sim(plugins=[Wind()]).replace(plugin), {"plugin": Wind((1, 0, 0))}),
    "sim.shard": (lambda mesh: Sim(2).shard(mesh), {"mesh": crazysim.engine.sharding.world_mesh(jax.devices()[:2])}),
    "sim.data": (lambda value: setattr(sim(), "data", value), {"value": Lazy(lambda: sim().data)}),
    "sim.default_data": (lambda value: setattr(sim(), "default_data", value), {"value": Lazy(lambda: sim().data)}),
    "sim[name]": (lambda name: sim()[name], {"name": "Crazyflie_0"}),
    "member.set": (lambda pos: sim()["Crazyflie_0"].set(pos=pos), {"pos": np.zeros(3)}),
    "member.command": (lambda command: sim()["Crazyflie_0"].command(command), {"command": np.zeros(16)}),
    "F.state_control": (lambda **k: F.state_control(sim().data, **k), {"controls": np.zeros((2, 2, 16))}),
    "F.state_control data": (lambda data: F.state_control(data, np.zeros((2, 2, 16))),
        {"data": Lazy(lambda: sim().data)}),
    "scene.add": (in_new_scene, {
        "source": "box", "name": "a", "count": 1, "pos": np.zeros(3), "quat": (0, 0, 0, 1), "mocap": True,
        "rgba": (1, 0, 0, 1), "size": (0.1, 0.1, 0.1),
    }),
    "scene.add gate": (in_new_scene, {"source": "gate", "width": 0.5, "height": 0.5, "bar": 0.05, "stand": 1.0}),
    "scene.add_map": (lambda **k: Sim().scene.add_map(**k), {
        "source": 0.2 * np.eye(3), "name": "a", "resolution": 0.1, "pos": np.zeros(3), "quat": (0, 0, 0, 1),
        "scale": None, "min_points": 1, "rgba": (1, 0, 0, 1),
    }),
    "handle[k]": (lambda k: sim().handle[k], {"k": 1}),
    "handle.set_pose": (lambda **k: sim().handle.set_pose(**k), {
        "data": Lazy(lambda: sim().data), "pos": np.zeros(3), "quat": (0, 0, 0, 1), "vel": np.zeros(3), "mask": None,
    }),
    "ActionDelay": (lambda **k: envs.ActionDelay(env(), **k).reset(jax.random.key(0)), {"n": 1}),
    "AutoReset": (lambda **k: envs.AutoReset(env(), **k), {"mode": "SameStep"}),
    "CameraImages": (lambda **k: envs.CameraImages(env(), **k), {"camera": crazysim.Camera(4, 4), "names": None}),
    "FrameStack": (lambda **k: envs.FrameStack(env(), **k).reset(jax.random.key(0)), {"n": 2}),
    "Normalize": (lambda **k: envs.Normalize(env(), **k), {"stats": None}),
    "ObservationNoise": (lambda std: envs.ObservationNoise(env(), {"pos": std}).reset(jax.random.key(0)), {"std": 0.1}),
    "ObservationNoise std": (lambda **k: envs.ObservationNoise(env(), **k), {"std": {}}),
    "Observe": (lambda **k: envs.Observe(env(), **k), {"fn": lambda obs, data: obs}),
    "Observe result": (
        lambda x: envs.Observe(env(), lambda obs, data: x).reset(jax.random.key(0)), {"x": {"a": np.zeros((1, 3))}}
    ),
    "Observe entry": (
        lambda x: envs.Observe(env(), lambda obs, data: {"a": x}).reset(jax.random.key(0)), {"x": np.zeros((1, 3))}
    ),
    "RandomizeWith": (lambda **k: envs.RandomizeWith(env(), **k), {"fn": lambda data, key: data, "params": ()}),
    "wrapper env": (lambda env: envs.FrameStack(env, 2), {"env": Lazy(functools.partial(env, 1))}),
    "DroneEnv": (lambda **k: envs.DroneEnv(env().sim, env().task, **k), {
        "freq": 50, "actions": None, "measured": False
    }),
    "DroneEnv parts": (envs.DroneEnv, {"sim": Lazy(lambda: env().sim), "task": Lazy(lambda: env().task)}),
    "DroneVectorEnv": (DroneVectorEnv, {
        "env": Lazy(functools.partial(env, 1)), "autoreset_mode": "NextStep", "render_mode": None,
        "render_worlds": None,
        "render_size": (64, 48), "numpy": False,
    }),
    "DroneSingleEnv": (DroneSingleEnv, {"env": Lazy(functools.partial(env, 1)), "render_mode": None,
        "render_size": (64, 48)}),
    "BraxEnv": (BraxEnv, {"env": Lazy(functools.partial(env, 1))}),
    "DroneParallelEnv": (DroneParallelEnv, {"env": Lazy(functools.partial(env, 1)), "render_mode": None,
        "render_size": (64, 48)}),
    "vector reset": (functools.partial(adapted, DroneVectorEnv, "reset"), {"seed": 0, "options": None}),
    "single reset": (functools.partial(adapted, DroneSingleEnv, "reset"), {"seed": 0, "options": None}),
    "parallel reset": (functools.partial(adapted, DroneParallelEnv, "reset"), {"seed": 0, "options": None}),
    "vector step": (functools.partial(adapted, DroneVectorEnv, "step"), {"actions": np.zeros((1, 4))}),
    "single step": (functools.partial(adapted, DroneSingleEnv, "step"), {"action": np.zeros(4)}),
    "parallel step": (functools.partial(adapted, DroneParallelEnv, "step"), {"actions": {"drone_0": np.zeros(4)}}),
    "parallel action": (
        lambda action: adapted(DroneParallelEnv, "step", actions={"drone_0": action}), {"action": np.zeros(4)}
    ),
    "env.reset": (lambda key: env().reset(key), {"key": jax.random.key(0)}),
    "env.step": (lambda action: env().step(state(), action), {"action": np.zeros((2, 1, 4), np.float32)}),
    "env.step state": (lambda state: env().step(state, np.zeros((2, 1, 4), np.float32)), {"state": Lazy(state)}),
    "env.set_goal": (lambda pos: env().set_goal(state(), pos), {"pos": np.zeros(3)}),
    "env.restart": (lambda mask: env().restart(state(), mask), {"mask": None}),
    "envs.rollout": (
        lambda **k: envs.rollout(env(), state(), **k),
        {"policy": lambda obs, key, memory: (jnp.zeros((2, 1, 4)), (), ()), "key": jax.random.key(0), "n_steps": 2},
    ),
    "register": (register_for_a_moment, {"name": "any_input", "task": envs.TASKS["hover"].task,
        "control": "attitude", "n_drones": 1}),
    "circle": (trajectories.circle, {"radius": 1.0, "period": 3.0, "height": 1.0, "along": False}),
    "circle speed": (trajectories.circle, {"speed": 1.0}),
    "figure_eight": (trajectories.figure_eight, {"width": 2.0, "depth": 1.0, "period": 4.0, "height": 1.0}),
    "helix": (trajectories.helix, {"radius": 1.0, "climb": 0.5, "turns": 3.0, "period": 3.0, "height": 0.5}),
    "hover": (trajectories.hover, {"pos": np.zeros(3), "yaw": 0.0, "duration": 1.0}),
    "line": (trajectories.line, {"start": np.zeros(3), "end": np.ones(3), "duration": 1.0, "yaw": 0.0}),
    "lissajous": (trajectories.lissajous, {
        "amplitudes": (1.0, 1.0, 0.2), "frequencies": (1, 2, 3), "phases": np.zeros(3), "period": 5.0,
        "center": (0, 0, 1.0),
    }),
    "minimum_snap": (trajectories.minimum_snap, {
        "waypoints": np.eye(3), "durations": (1.0, 1.0), "limits": None, "yaw": 0.0, "corridors": None,
        "velocities": None, "accelerations": None, "jerks": None,
    }),
    "minimum_snap limits": (trajectories.minimum_snap, {
        "waypoints": np.eye(3), "limits": trajectories.Limits(speed=1.0, acceleration=2.0)
    }),
    "of_bezier": (trajectories.of_bezier, {
        "ends": [1.0], "control_points": [np.zeros((8, 4))], "repeats": False
    }),
    "spline": (trajectories.spline, {
        "times": np.arange(8.0), "points": np.ones((8, 3)), "degree": 5, "yaw": 0.0, "at_rest": True
    }),
    "evaluate": (CIRCLE.evaluate, {"t": 0.5}),
    "derivatives": (CIRCLE.derivatives, {"t": 0.5, "order": 2}),
    "check": (trajectories.check, {
        "trajectories": CIRCLE, "limits": trajectories.Limits(speed=1.0), "airframe": None, "starts": 0.0,
        "duration": 1.0, "names": None, "tolerance": 0.001,
    }),
    "Limits": (trajectories.Limits, {"speed": 1.0, "thrust": 2.0, "floor": 0.0}),
    "load_csv": (trajectories.load_csv, {"path": "nowhere.csv"}),
    "pack_compressed": (trajectories.pack_compressed, {"trajectory": trajectories.line(np.zeros(3), np.ones(3), 1.0)}),
    "load_airframe": (load_airframe, {"source": "cf21B_500"}),
    "estimate_airframe": (estimate_airframe, {
        "mass": 0.5, "propeller": 0.127, "arm": 0.11, "n_rotors": 4, "layout": "x", "positions": None, "spins": None,
        "thrust_to_weight": 3.0, "pitch": None, "inertia": None, "time_constant": None,
    }),
    "Shape": (Shape, {"kind": "sphere", "size": (0.1,)}),
    "hfield": (hfield, {"heights": np.zeros((3, 3)), "size": (1.0, 1.0, 1.0, 1.0)}),
    "hull": (hull, {"vertices": np.vstack([np.zeros(3), np.eye(3)]), "faces": None}),
    "read_log": (read_log, {"path": "nowhere.csv", "columns": None, "motion": None, "between": (0.0, np.inf)}),
    "View": (View, {
        "worlds": (0,), "width": 64, "height": 48, "camera": -1, "cam_config": None, "follow": None, "hold": None,
        "lag": 0.3, "trail": 0.0, "setpoints": False, "rgba": None, "text": None,
    }),
    "Trail": (Trail, {"seconds": 1.0}),
    "Recorder": (lambda **k: Recorder(sim(), **k), {"worlds": None, "path": None}),
    "flight_of": (lambda **k: flight_of(sim(), **k), {"states": Lazy(lambda: on_sim("rollout")(policy=FALL)),
        "dt": 0.1, "worlds": None}),
    "Flight.load": (Flight.load, {"path": "nowhere.journal"}),
    "to_casadi": (to_casadi, {"sim": Lazy(Sim), "parameters": (), "world": 0, "drone": 0}),
    "draw_points": (draw_points, {"sim": Lazy(sim), "points": np.zeros(3), "rgba": None, "size": 0.01}),
    "draw_label": (draw_label, {"sim": Lazy(sim), "point": np.zeros(3), "text": "here"}),
    "draw_setpoints": (draw_setpoints, {"sim": Lazy(sim), "world": 0, "rgba": None, "size": 0.02}),
    "MPPI": (lambda **k: MPPI(env().sim, **k), {
        "horizon": 5, "samples": 4, "substeps": 2, "knots": 2, "freq": None, "noise": None, "temperature": 0.05,
        "seed": 0,
    }),
    "TrainConfig.create": (functools.partial(TrainConfig.create, "hover"), {"algorithm": "ppo", "seed": 0,
        "n_worlds": 4}),
    "SplatScene": (crazysim.SplatScene, {"path": "nowhere.ply", "pos": np.zeros(3), "quat": (0, 0, 0, 1),
        "scale": None}),
    "from_mjcf": (Sim.from_mjcf, {"xml_path": "nowhere.xml", "n_worlds": 1, "kinds": None, "plugins": ()}),
    "stage": (crazysim.stage, {"scope": "drone", "when": None, "phase": "each"}),
}  # fmt: skip
"""Calls and their arguments, of which one at a time gets any value. A call that always fails is tried all the same."""

SPECIAL = [
    None, True, False, 0, 1, -1, 5, 10**12, -(10**12), 2**70, 1.5, -0.5, np.nan, np.inf, 1e300, 1j, "", "text",
    "nowhere.txt", b"1",
    [], {}, (), set(), object(), [None], ["text"], {"a": 1}, [[1.0], [1.0, 2.0]], (1, 2), np.zeros(3), np.zeros((2,
    3)), np.zeros(0),
    np.array(["text"]), np.array([None]), np.nan * np.zeros(3), Sim, Path("nowhere"), range(3), iter([1]),
    np.float32(2), np.int8(-3),
]  # fmt: skip
DTYPES = (bool, np.int8, np.int64, np.uint32, np.float16, np.float32, np.float64, np.complex64, "U3", object)
ANY_ARRAY = st.builds(
    lambda shape, dtype, fill, on_device: (
        jnp.asarray if on_device and np.dtype(dtype).kind not in "UO" else np.asarray
    )(np.full(shape, fill).astype(dtype)),
    array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4),
    st.sampled_from(DTYPES),
    st.sampled_from([0, 1, -1, 100]),
    st.booleans(),
)
ANY_VALUE = st.one_of(st.sampled_from(SPECIAL), ANY_ARRAY, st.integers(), st.floats(), st.text(max_size=3))


def like(default):
    """Return numbers of any size in the shape of a right argument: products of finite numbers may overflow."""
    try:
        right = np.array(None if isinstance(default, (Lazy, bool, str)) else default, float)
    except (TypeError, ValueError):
        right = np.zeros(0)
    if not right.size or np.any(np.isnan(right)):
        return st.nothing()
    return st.builds(
        lambda number, is_changed: np.where(np.resize(is_changed, right.shape), number, right),
        st.one_of(st.sampled_from([1e30, -1e36, 1e300, -1e300, 1e-300, 1e10]), st.floats()),
        st.lists(st.booleans(), min_size=1, max_size=3),
    )


AMOUNTS = ("n_steps", "n_control_steps", "n_worlds", "samples", "horizon", "substeps", "count", "width", "height")
"""Arguments that say how much a call does; numbers from ``MANY`` to 2^31 take long, as they should."""
MANY = 10**4


def is_much(name, value):
    return name in AMOUNTS and isinstance(value, int) and MANY < value < 2**31


def is_clear(error):
    frame = traceback.extract_tb(error.__traceback__)[-1]
    is_ours = isinstance(error, (ConfigError, crazysim.errors.RenderError)) or "expected " in str(error)
    return is_ours and "unpack" not in str(error) and Path(frame.filename).is_relative_to(PACKAGE)


def describe_fault(call, arguments):
    def interrupt(*_):
        raise TimeoutError(f"took more than {TIME_LIMIT} s")

    previous = signal.signal(signal.SIGALRM, interrupt)
    signal.alarm(TIME_LIMIT)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = call(**{name: x.make() if isinstance(x, Lazy) else x for name, x in arguments.items()})
            jax.block_until_ready(result)  # the next call does not wait for this one
    except Exception as error:
        return None if is_clear(error) else f"{type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, previous)
    return None


NO_FILES = ("load_csv", "read_log", "Flight.load", "SplatScene", "from_mjcf")
"""Calls that are tried with a file that does not exist."""


@pytest.fixture(autouse=True, scope="module")
def folder(tmp_path_factory):
    for build in (sim, state, functools.partial(env, 1)):
        build()
    with contextlib.chdir(tmp_path_factory.mktemp("any_input")):
        yield


@pytest.mark.parametrize("label", [x for x in CALLS if x not in NO_FILES])
def test_the_calls_work_with_right_arguments(label):
    call, arguments = CALLS[label]
    call(**{name: x.make() if isinstance(x, Lazy) else x for name, x in arguments.items()})


@pytest.mark.parametrize("label", CALLS)
@settings(max_examples=settings.default.max_examples // 6)
@given(data=st.data())
def test_any_argument_is_taken_or_refused_with_what_was_expected(label, data):
    call, arguments = CALLS[label]
    name = data.draw(st.sampled_from(sorted(arguments)))
    value = data.draw(st.one_of(ANY_VALUE, like(arguments[name])))
    assume(not is_much(name, value))
    fault = describe_fault(call, arguments | {name: value})
    assert fault is None, f"{label}({name}={value!r}): {fault}"


RAGGED = [[1.0], [1.0, 2.0]]
EMPTY_TEXTS = np.zeros(0, "U3")


@pytest.mark.parametrize(
    "label, name, value",
    [
        ("Sim", "aero", np.zeros(0, bool)), ("Sim", "engine", np.zeros(0, bool)), ("Sim", "engine", EMPTY_TEXTS),
        ("check", "trajectories", np.array(False)), ("check", "names", np.array("a")),
        ("sim.contact_report", "objects", np.array(False)), ("sim.contact_report", "objects", jnp.array(0)),
        ("member.set", "pos", RAGGED), ("member.set", "pos", np.array("text")), ("member.command", "command", RAGGED),
        ("sim.depth", "camera", np.array(0, np.int8)), ("sim.depth", "camera", jnp.array(0)),
        ("sim.depth", "along", EMPTY_TEXTS), ("sim.rollout", "every", np.array(0, np.int8)),
        ("sim.rollout", "every", jnp.array(1)), ("envs.rollout", "policy", 95.0),
        ("evaluate", "t", RAGGED), ("evaluate", "t", [1.0, 2.0]), ("derivatives", "t", RAGGED),
        ("evaluate", "t", range(3)),
        ("to_casadi", "sim", Lazy(env)), ("to_casadi", "parameters", 3), ("draw_points", "sim", Lazy(env)),
        ("DroneVectorEnv", "render_mode", np.zeros(0, bool)), ("estimate_airframe", "layout", EMPTY_TEXTS),
    ],
)  # fmt: skip
def test_arrays_in_place_of_names_options_lists_and_whole_numbers(label, name, value):
    call, arguments = CALLS[label]
    assert describe_fault(call, arguments | {name: value}) is None


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # of Python 3.12, beside JAX's own
def test_a_process_that_was_forked_after_a_call_of_jax_refuses_with_the_remedy():
    """Its calls would hang; gymnasium.make_vec(..., vectorization_mode="async") starts such processes."""
    calls = (Sim, lambda: sim().step(), lambda: env().reset(jax.random.key(0)), lambda: adapter(DroneVectorEnv).reset())
    adapter(DroneVectorEnv)
    sim()
    reader, writer = os.pipe()
    with pytest.warns(RuntimeWarning, match="fork"):
        child = os.fork()
    if child == 0:
        texts = []
        for call in calls:
            try:
                call()
            except Exception as error:
                texts.append(str(error))
        os.write(writer, "\n".join(texts).encode())
        os._exit(0)
    os.waitpid(child, 0)
    os.close(writer)
    with open(reader) as pipe:
        texts = pipe.read().splitlines()
    assert [("spawn" in text, "make_vec" in text) for text in texts] == [(True, True)] * len(calls)


@pytest.mark.parametrize(
    ("kind", "action"),
    [
        (DroneVectorEnv, np.zeros((1, 4))),
        (DroneSingleEnv, np.zeros(4)),
        (DroneParallelEnv, {"drone_0": np.zeros(4)}),
    ],
)
def test_a_closed_environment_steps_after_a_reset_alone(kind, action):
    closed = kind(env(1))
    for _ in range(2):
        closed.reset(seed=0)
        closed.step(action)
        closed.close()
        with pytest.raises(ConfigError, match=r"expected a running episode, got none.*Call reset\(\)"):
            closed.step(action)


@pytest.mark.parametrize("copying", [pickle.dumps, copy.deepcopy])
@pytest.mark.parametrize("make_one", [sim, env, functools.partial(adapter, DroneVectorEnv),
    functools.partial(adapter, DroneSingleEnv), functools.partial(adapter, DroneParallelEnv)])  # fmt: skip
def test_a_copy_of_a_simulation_is_refused_with_the_remedy(copying, make_one):
    with pytest.raises(TypeError, match=r"Make it again with the same settings, .*sim.data"):
        copying(make_one())


def test_states_and_tasks_can_be_pickled_and_copied():
    for value in (state(), sim().data, env().task, load_airframe("cf21B_500")):
        assert jax.tree.structure(pickle.loads(pickle.dumps(value))) == jax.tree.structure(copy.deepcopy(value))


def test_every_option_of_the_simulation_can_be_set_by_make():
    defaults = {name: p.default for name, p in inspect.signature(Sim).parameters.items()}
    for name in registry.SIM_OPTIONS:
        assert make("hover", **{name: defaults[name]}).sim.n_worlds == 1
    assert make("hover", sim_freq=1000).sim.freq == 1000
    with pytest.raises(ConfigError, match="sim_freq") as error:
        make("hover", foo=1)
    assert "n_worlds, n_drones" not in str(error.value)


class Branching(Hover):
    """A task with a Python ``if`` on a traced value."""

    def observe(self, data):
        return super().observe(data) if data.states.pos[0, 2] > 0 else {}


def branching_stage(data):
    return data if data.states.pos[0] > 0 else data.replace()


def branch_in_stage():
    sim = Sim()
    sim.step_pipeline = sim.step_pipeline | {"branch": crazysim.stage("drone")(branching_stage)}
    sim.step()


@pytest.mark.parametrize(
    "call",
    [
        lambda: make(Branching()),
        branch_in_stage,
        lambda: envs.Observe(env(), lambda obs, data: obs if obs["pos"][0, 0] > 0 else {}).reset(jax.random.key(0)),
        lambda: envs.Observe(env(), lambda obs, data: {"a": np.sin(obs["pos"])}).reset(jax.random.key(0)),
    ],
    ids=["task", "stage", "wrapper", "NumPy"],
)
def test_a_python_branch_on_a_traced_value_is_explained(call):
    with pytest.raises(TypeError) as error:
        call()
    assert "jnp.where" in "".join(error.value.__notes__)
