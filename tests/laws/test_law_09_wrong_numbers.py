"""Law 9 for every number of every plugin, sensor, filter, path controller and task: wrong values are errors at once.

Fields are found by introspection, so that a new class is tested as soon as it is in the package.
"""

import dataclasses
import importlib
import pkgutil
import re

import jax.numpy as jnp
import numpy as np
import pytest

import crazysim.envs.tasks
import crazysim.lab.bodies
import crazysim.lab.estimators
import crazysim.lab.plugins
import crazysim.lab.tasks
import crazysim.lab.vehicles
import crazysim.plugins
from crazysim import Sim
from crazysim.core.plugin import FunctionPlugin, Plugin
from crazysim.core.population import Population
from crazysim.core.settings import allowed_types, collect_settings
from crazysim.envs.task import Task
from crazysim.envs.tasks.goals import GoalTask
from crazysim.envs.tasks.touch_down import TouchDown
from crazysim.errors import ConfigError
from crazysim.lab.live.mocap.playback import Playback
from crazysim.lab.live.mocap.tracker import Rules
from crazysim.lab.live.mocap.twins import Twin
from crazysim.lab.live.sitl import Origin
from crazysim.lab.tasks.bring_load import BringLoad
from crazysim.lab.vehicles.following import PathController
from crazysim.plugins.effects import Battery, Grid
from crazysim.plugins.estimators.error_state_filter import ErrorStateFilter
from crazysim.plugins.estimators.estimator import Estimator
from crazysim.plugins.payloads import SlungLoad
from crazysim.plugins.scenery.forest import StandingObstacles
from crazysim.plugins.scenery.scenery import Scenery
from crazysim.plugins.sensors import IMU, Barometer, ImageSensor, MotionCapture, RangeFinder, Triad
from crazysim.plugins.sensors.onboard import NoisySensor
from crazysim.plugins.sensors.sensor import Sensor
from crazysim.plugins.vehicles import Path
from crazysim.tables import MAX_NUMBER
from crazysim.trajectories import circle

ABSTRACT = {
    FunctionPlugin, Population, Sensor, NoisySensor, ImageSensor, Estimator, ErrorStateFilter, Scenery,
    StandingObstacles, GoalTask, TouchDown, BringLoad,
}  # fmt: skip
"""Base classes, which are not added, as are plugins without a name."""
TABLES = {"heights"}
"""Fields of two axes of any lengths."""
LISTS = {"elevation", "azimuth"}
"""Fields of one axis of any length."""
FOUR_POINTS = np.array([[0.0, 0, 2], [4, 0, 2], [0, 4, 2], [4, 4, 1]])
EXAMPLES = {
    "Cars": {"path": Path.of_points([(0, 0), (1, 0), (2, 1)])},
    "Follow": {"trajectories": circle(1.0)},
    "Hook": {"mass": 0.01},
    "Latency": {"delay": 2},
    "Lighthouse": {"stations": FOUR_POINTS[:2], "rpy": np.zeros((2, 3))},
    "Magnetometer": {"field": (0.0, 2e-5, -4.5e-5)},
    "Origin": {"latitude": 47.0, "longitude": 8.0, "altitude": 500.0},
    "Playback": {"handles": (), "pos": np.zeros((2, 1, 3)), "quat": np.zeros((2, 1, 4)), "freq": 10.0},
    "Radar": {"pos": (0.0, 0.0, 1.0)},
    "Residual": {"linear": np.zeros((6, 14)), "hidden": np.zeros((3, 14)), "output": np.zeros((6, 3))},
    "SharedLoad": {"mass": 0.01},
    "SlungLoad": {"mass": 0.01},
    "Maps": {"maps": ("<mujoco/>",)},
    "Terrain": {"heights": np.zeros((3, 3)), "size": (4.0, 4.0)},
    "UWB": {"anchors": FOUR_POINTS},
    "WindField": {"field": Grid(np.zeros((2, 2, 2, 3)))},
}
"""Settings that classes need."""
REQUIRED_PLUGINS = {
    "BatteryVoltage": [Battery()],
    "MultiRanger": [RangeFinder()],
    "RotorJet": [SlungLoad(0.01)],
    "Complementary": [IMU(), Barometer()],
    "ESKF": [IMU(), MotionCapture()],
    "Kalman": [IMU(), MotionCapture()],
}
"""Plugins that other plugins need."""
NEVER_NEGATIVE = re.compile(
    r"(?<!mis)(noise|spread|mass|inertia|density|radius|length|size|range|reach|resistance|capacity|efficiency|charge"
    r"|voltage|friction|restitution|softness|damping|delay|jitter|dropout|time|iterations|resolution|bandwidth|limit"
    r"|seconds|tolerance|hold|max_\w+|n_\w+|effectiveness|roughness|exponent|instability|random_walk|imbalance)"
)
"""Names of quantities that are at least zero."""


UNCHECKED = ["Bicycles.members", "Cars.members", "Follow.degrees", "FreeBodies.members", "Twin.fixed"]
"""Settings whose annotation mixes numbers with other types; their classes check them."""


def concrete_classes(base, *packages):
    for package in packages:
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    roots = tuple(package.__name__ for package in packages)

    def subclasses_of(kind):
        return {kind, *[x for sub in kind.__subclasses__() for x in subclasses_of(sub)]}

    classes = [kind for kind in subclasses_of(base) - ABSTRACT - {base} if kind.__module__.startswith(roots)]
    named = [kind for kind in classes if not issubclass(kind, Plugin) or hasattr(kind, "name")]
    return sorted(named, key=lambda kind: kind.__name__)


PLUGINS = concrete_classes(
    Plugin, crazysim.plugins, crazysim.lab.bodies, crazysim.lab.estimators, crazysim.lab.plugins, crazysim.lab.vehicles
)
TASKS = concrete_classes(Task, crazysim.envs.tasks, crazysim.lab.tasks)
OTHER_CLASSES = [
    Origin,
    Playback,
    Rules,
    Triad,
    Twin,
    *concrete_classes(PathController, crazysim.lab.vehicles),
]


def is_numeric(kind, name):
    return {int, float, np.ndarray} & set(allowed_types(kind)[name])


def numeric_fields(kind):
    return [(name, declared) for name, declared in collect_settings(kind).items() if is_numeric(kind, name)]


def make_example(kind, **changes):
    settings = dict(EXAMPLES.get(kind.__name__, {}))
    if issubclass(kind, Estimator):
        settings["sensors"] = REQUIRED_PLUGINS[kind.__name__]
    return kind(**(settings | changes))


def impossible_values(kind, name, declared, rng):
    """Yield values that a field must refuse: not finite, of other types, and out of its range."""
    example_value, kinds = getattr(make_example(kind), name), allowed_types(kind)[name]
    is_whole = declared.dtype is not None or int in kinds
    yield from () if str in kinds else ("1.0", "")
    yield from (
        np.nan,
        [np.nan],
        -np.inf,
        np.inf,
        b"1",
        [],
        {},
        object(),
        [[1.0], [1.0, 2.0]],
        1j,
        [None],
        True,
    )
    allows_none = type(None) in kinds or kind.__dataclass_fields__[name].default is None
    if not allows_none and example_value is not None:
        yield None
    if is_whole:
        yield 1.5
    if np.ndarray in kinds and example_value is not None:
        array = np.resize(
            np.asarray(example_value, float),
            rng.integers(1, 4, rng.integers(1, 3)) if np.ndim(example_value) == 0 else np.shape(example_value),
        )
        array.flat[rng.integers(array.size)] = rng.choice([np.nan, -np.inf])
        yield array
    for bound, sign in ((declared.range.low, -1), (declared.range.high, 1)):
        if abs(bound) < MAX_NUMBER:
            beyond = bound + sign * max(1e-3 * abs(bound), 1e-3)
            yield int(np.ceil(sign * beyond)) * sign if is_whole else float(beyond)


def describe_unless_refused(call, label):
    """Return None if a call raises ``ConfigError`` with the given value, else a description of what it did."""
    try:
        call()
    except ConfigError as error:
        return None if "got" in str(error) else f"{label}: {error}"
    except Exception as error:
        return f"{label}: {type(error).__name__}: {error}"
    return f"{label}: accepted"


@pytest.mark.parametrize("kind", [*PLUGINS, *OTHER_CLASSES, *TASKS], ids=lambda kind: kind.__name__)
def test_impossible_numbers_are_refused_where_they_are_given(kind):
    rng, result = np.random.default_rng(len(kind.__name__)), []
    fields = numeric_fields(kind)
    for name, declared in fields:
        for value in impossible_values(kind, name, declared, rng):
            result.append(
                describe_unless_refused(
                    lambda name=name, value=value: make_example(kind, **{name: value}), f"{name}={value!r}"
                )
            )
    for name in allowed_types(kind):
        if name not in dict(fields) and type(None) not in allowed_types(kind)[name] and allowed_types(kind)[name]:
            result += [describe_unless_refused(lambda name=name: make_example(kind, **{name: None}), f"{name}=None")]
            result += [describe_unless_refused(lambda name=name: make_example(kind, **{name: np.nan}), f"{name}=nan")]
    assert not [text for text in result if text], "\n".join(text for text in result if text)


def single_numbers(number):
    """Yield a number as an array without axes, and in the types of NumPy and JAX that have it."""
    types = (np.int8, np.uint16, np.int64, np.float16, np.float32, np.float64, np.longdouble)
    kinds = "iu" if isinstance(number, int) else "f"
    x = np.asarray(number)
    yield from (x, jnp.asarray(x))
    with np.errstate(all="ignore"):
        yield from (x.astype(t)[()] for t in types if np.dtype(t).kind in kinds and x.astype(t) == x)


@pytest.mark.parametrize("kind", [*PLUGINS, *OTHER_CLASSES, *TASKS], ids=lambda kind: kind.__name__)
def test_single_numbers_of_any_type_are_numbers_of_python(kind):
    """Steps of 500 Hz overflow the type of ``freq=np.int8(100)``, and JAX does not know long doubles."""
    for name, _ in numeric_fields(kind):
        number = getattr(make_example(kind), name)
        for value in single_numbers(number) if type(number) in (int, float) else ():
            kept = getattr(make_example(kind, **{name: value}), name)
            assert type(kept) is type(number), f"{name}={value!r}"
            assert kept == pytest.approx(number, rel=1e-6)


@pytest.mark.parametrize("kind", [*PLUGINS, *OTHER_CLASSES, *TASKS], ids=lambda kind: kind.__name__)
def test_quantities_that_are_never_negative_are_declared_so(kind):
    fields = numeric_fields(kind)
    wrong = [name for name, declared in fields if NEVER_NEGATIVE.search(name) and declared.range.low < 0]
    assert not wrong


def test_every_setting_of_a_package_has_a_type_that_is_checked():
    """A setting with a number in its annotation is checked as a number, whatever its name."""
    missed = []
    for kind in [*PLUGINS, *OTHER_CLASSES, *TASKS]:
        for field in dataclasses.fields(kind):
            is_number = re.search(r"\b(float|int|ArrayLike)\b", str(field.type))
            if is_number and not allowed_types(kind)[field.name]:
                missed.append(f"{kind.__name__}.{field.name}")
    assert sorted(missed) == UNCHECKED


@pytest.fixture(scope="module")
def sims():
    sims_by_key = {}

    def get_sim(kind):
        needs = REQUIRED_PLUGINS.get(kind.__name__, [])
        control = "state" if kind.__name__ == "Follow" else "attitude"
        integrator = "symplectic_euler" if kind.__name__ == "SharedLoad" else "euler"
        key = (control, integrator, *[type(plugin) for plugin in needs])
        if key not in sims_by_key:
            sims_by_key[key] = Sim(2, 3, control=control, integrator=integrator)
            for plugin in needs:
                sims_by_key[key].add(plugin)
        return sims_by_key[key]

    return get_sim


def part_names(sim):
    objects = sim.data.objects
    pipelines, records = (sim.step_pipeline, sim.reset_pipeline), (sim.data.plugins, sim.default_data.plugins)
    bodies = [body.name for body in sim.spec.worldbody.bodies]
    return [
        *map(list, (sim.plugins, *pipelines, *records)),
        sim.names,
        bodies,
        () if objects is None else objects.names,
    ]


@pytest.mark.parametrize("kind", PLUGINS, ids=lambda kind: kind.__name__)
def test_arrays_of_another_shape_are_refused_when_the_plugin_is_added_and_change_nothing(kind, sims):
    sim, result = sims(kind), []
    before = part_names(sim)
    for name, declared in numeric_fields(kind):
        if np.ndarray not in allowed_types(kind)[name] and not declared.is_parameter:
            continue
        low, high = max(declared.range.low, -1.0), min(declared.range.high, 1.0)
        fill = 1 if declared.dtype else 0.5 * (low + high)
        for shape in ((11,), (7, 5)):
            if (name in TABLES and len(shape) == 2) or (name in LISTS and len(shape) == 1):
                continue

            def add(name=name, shape=shape, fill=fill):
                sim.add(make_example(kind, **{name: np.full(shape, fill)}))

            result.append(describe_unless_refused(add, f"{name} of shape {shape}"))
            if kind.__name__ in [type(x).__name__ for x in sim.plugins.values()]:
                sim.remove(make_example(kind).name)
            elif part_names(sim) != before:
                result.append(f"{name} of shape {shape} left something behind")
    assert not [text for text in result if text], "\n".join(text for text in result if text)
    sim.add(make_example(kind))
    sim.remove(make_example(kind).name)
