"""Simulations that together run every stage of the package, on which all engines and devices must agree.

``tests/test_agreement.py`` runs them on all engines, ``tests/gpu`` on the accelerator.
"""

import jax
import jax.numpy as jnp
import numpy as np
from cases import INTEGRATORS, PAIRS, centre, gap, hover_command, leaf_on_host, repulsion, send, with_states
from springs import KINDS, Tied, build_springs

from crazysim import (
    IMU,
    Battery,
    Bicycles,
    Cars,
    Clutter,
    ContactLog,
    ContactResponse,
    Downwash,
    DroneCollisions,
    Follow,
    Forest,
    FreeBodies,
    Gates,
    GroundEffect,
    Hook,
    Kalman,
    Latency,
    Maps,
    MotionCapture,
    MotorFailure,
    Pillars,
    Radar,
    RandomAirframe,
    Randomize,
    RangeFinder,
    Residual,
    Rooms,
    RotorAerodynamics,
    RotorJet,
    SharedLoad,
    Sim,
    SlungLoad,
    Terrain,
    Wind,
    WindField,
    load_airframe,
    rotation,
    stage,
)
from crazysim.control.controllers import CONTROLLERS
from crazysim.core.pipeline import insert_fn_before
from crazysim.geometry import Shape, distance, hull
from crazysim.lab.control.load_lqr import LoadLQR
from crazysim.lab.control.tracking_lqr import TrackingLQR
from crazysim.plugins import sensors, vehicles
from crazysim.plugins.effects import Grid
from crazysim.plugins.estimators import ESKF, Complementary
from crazysim.plugins.sensors import GPS, UWB, Barometer, Lighthouse, OpticalFlow, TimeOfFlight, Triad
from crazysim.trajectories import figure_eight

ROUNDING = 1e-4
"""Tolerance after 100 steps in float32: some 1,000 roundings of 1e-7, since errors in the speeds of rotors and in
angular velocities add up in attitudes and positions. Two engines of the CPU differ by 2e-5 at most."""
COMMAND_NOISE = {
    "state": [0.2, 0.2, 0.2, *[0.0] * 13],
    "attitude": [0.2, 0.2, 0.2, 0.0],
    "body_rate": [0.5, 0.5, 0.5, 0.0],
    "force_torque": [0.0, 1e-6, 1e-6, 1e-6],
    "rotor_vel": [0.0] * 4,
}
"""Largest differences of commands from hover commands, in addition to 2% of each number."""


def make_flying_sim(device="cpu", n_worlds=8, n_drones=2, plugins=(), prepare=None, height=1.5, **settings):
    """Return a simulation whose drones differ in states and commands. World k does not depend on ``n_worlds``."""
    sim = Sim(n_worlds, n_drones, device=device, rng_key=4, **settings)
    rng = np.random.default_rng(3)

    def draw(size, k):
        return size * rng.uniform(-1, 1, (100, n_drones, k))[:n_worlds]

    quat = np.append(draw(0.1, 3), np.ones((n_worlds, n_drones, 1)), axis=-1)
    sim.data = with_states(
        sim.data,
        pos=draw(0.1, 3) + np.stack(np.broadcast_arrays(0.0, 0.5 * np.arange(n_drones), height), axis=-1),
        quat=quat / np.linalg.norm(quat, axis=-1, keepdims=True),
        vel=draw(0.5, 3),
        ang_vel=draw(1.0, 3),
    )
    if prepare is not None:
        prepare(sim)
    for plugin in plugins:
        sim.add(plugin)
    hover = hover_command(sim.data, (0, 0, height))
    command = hover * (1 + draw(0.02, len(hover))) + draw(1.0, len(hover)) * COMMAND_NOISE[sim.control.value]
    sim.data = send(sim.data, command)
    return sim


def assert_agree(actual, expected, tolerance, label=""):
    """Assert that flags and integers are equal, and floats equal up to rounding.

    Differences of large numbers have the errors of these numbers, so the tolerance is relative to the largest number of
    an array, or to 1.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(actual)
    assert structure == jax.tree.structure(expected)
    for (path, x), y in zip(leaves, jax.tree.leaves(expected), strict=True):
        x, y, name = leaf_on_host(x), leaf_on_host(y), f"{label} {jax.tree_util.keystr(path)}"
        if np.issubdtype(y.dtype, np.floating):
            size = np.abs(y[np.isfinite(y)]).max(initial=1.0)
            np.testing.assert_allclose(x, y, rtol=0, atol=tolerance * size, err_msg=name)
        else:
            np.testing.assert_array_equal(x, y, err_msg=name)


ANGLES = np.pi / 3 * np.arange(6) + np.pi / 6
CRAZYFLIE = load_airframe("cf21B_500").tables
HEXAROTOR = {
    **CRAZYFLIE,
    "name": "hexarotor",
    "rotors": {
        **CRAZYFLIE["rotors"],
        "position": np.stack([0.05 * np.cos(ANGLES), 0.05 * np.sin(ANGLES), 0 * ANGLES], axis=-1),
        "yaw_torque_sign": [1, -1, 1, -1, 1, -1],
    },
}
FLEET = ("cf21B_500", "bumblebee", HEXAROTOR, "cf2x_L250")
"""Airframes with different numbers of rotors."""
SPHERE = Shape("sphere", (0.1,))
SHAPES = [
    Shape("plane"),
    Shape("sphere", (0.35,)),
    Shape("capsule", (0.2, 0.4)),
    Shape("box", (0.3, 0.5, 0.2)),
    Shape("cylinder", (0.4, 0.25)),
    Shape("ellipsoid", (0.5, 0.3, 0.15)),
    hull([[0.4, 0, 0], [-0.3, 0.3, 0], [-0.2, -0.4, 0.1], [0, 0.1, 0.5], [0.1, 0, -0.3]]),
]
FIGURE_EIGHT = figure_eight(2.0, 1.0, speed=1.0)
MAPS = [
    f"<mujoco><worldbody><geom type='box' size='.1 .1 1' pos='{x} 1 1'/><geom size='{x}'/></worldbody></mujoco>"
    for x in (0.2, 0.4, 0.6)
]
HILLS = 0.5 * (1 + np.sin(np.arange(41) / 6)[:, None] * np.cos(np.arange(41) / 5))
FIELD = Grid(np.arange(54).reshape(3, 3, 2, 3) % 7 - 3.0, (-1.0, -1.0, 0.0), (1.0, 1.0, 4.0))
EFFECTS = {
    Battery: {"capacity": 0.25, "resistance": 0.1},
    Downwash: {},
    GroundEffect: {},
    Latency: {"delay": 2},
    Randomize: {"mass": (0.9, 1.1), "drag": (0.5, 1.5), "wind": (0.0, 2.0)},
    RotorAerodynamics: {"flapping": 1e-8, "ceiling": 4.0},
    MotorFailure: {"effectiveness": 0.9, "fail_step": [-1, -1, -1, 30], "rate": 0.1},
    Residual: {
        "linear": np.full((6, 14), 1e-6),
        "hidden": np.arange(28).reshape(2, 14) / 50,
        "output": np.full((6, 2), 1e-6),
    },
    Wind: {"velocity": (2.0, 1.0, 0.0), "speed_20ft": 7.7, "roughness": 0.05},
    WindField: {"field": FIELD, "spread": (0.5, 0.5, 0.0)},
}
"""Every effect, with settings that change the flight."""
RANGES = {
    "mass": (0.9, 1.2),
    "inertia": (0.8, 1.1),
    "thrust": (0.9, 1.0),
    "rotor_thrust": (0.95, 1.05),
    "torque": (0.5, 2.0),
    "lag": (0.7, 1.3),
    "drag": (0.0, 3.0),
    "wind": (1.0, 3.0),
}
"""Ranges of all quantities that ``Randomize`` draws without the help of another plugin."""
PATHS = {"params.rotor_vel_max": 0.2, "plugins.battery.resistance": (0.5, 2.0)}
"""Ranges of numbers that ``Randomize`` draws by their path."""


def triad_errors(size):
    return Triad(noise=1e-3 * size, bias=0.1 * size, bias_spread=0.1 * size, random_walk=0.01 * size,
                 instability=0.1 * size, scale=0.1, scale_spread=0.03, misalignment=0.02, misalignment_spread=0.02,
                 bandwidth=80.0)  # fmt: skip


OFFSET, TURN = (0.01, 0.0, -0.02), (0.1, 0.2, 0.3)
"""Position, m, and roll, pitch and yaw, rad, at which sensors are mounted."""
ANCHORS = [(2.0, 2.0, 2.0), (-2.0, -2.0, 2.5)]
STATIONS = [(0, 0, -2.4), (0, 0.6, 0.8)]
DELAY_SETTINGS = {"delay": 0.004, "jitter": 0.004, "dropout": 0.1}
SENSORS = {
    "imu": lambda: IMU(triad_errors(1.0), triad_errors(1.0), OFFSET, TURN, 1e-8, **DELAY_SETTINGS),
    "motion_capture": lambda: MotionCapture(1e-3, 1e-2, 50.0, OFFSET, TURN, freq=250, **DELAY_SETTINGS),
    "optical_flow": lambda: OpticalFlow(0.1, pos=OFFSET),
    "time_of_flight": lambda: TimeOfFlight(0.01, pos=OFFSET, resolution=None, freq=100, delay=0.01),
    "barometer": lambda: Barometer(1.0, 2.0, 10.0, 30.0, 200.0),
    "magnetometer": lambda: sensors.Magnetometer((1e-5, 2e-5, -4.5e-5), triad_errors(1e-4), TURN, freq=100),
    "rotor_speeds": lambda: sensors.RotorSpeeds(5.0, freq=250, delay=0.002),
    "battery_voltage": lambda: sensors.BatteryVoltage(0.01),
    "multi_ranger": lambda: sensors.MultiRanger(0.01, freq=100),
    "uwb": lambda: UWB(ANCHORS, 0.1, 0.05, 0.3, 0.5, OFFSET, freq=100, delay=0.006),
    "lighthouse": lambda: Lighthouse(ANCHORS, STATIONS, 1e-3, [OFFSET, (0, 0.01, 0)], freq=100),
    "gps": lambda: GPS(0.5, 1.0, 20.0, 0.1, OFFSET, freq=100),
}
"""Every sensor, with all of its errors but rounding and limits."""
REQUIRED_BY = {"battery_voltage": lambda: Battery(0.25, 0.1), "multi_ranger": lambda: RangeFinder()}
"""Plugins that some sensors need."""


def effects():
    return [effect(**options) for effect, options in EFFECTS.items()]


def all_sensors():
    return [make() for make in (*REQUIRED_BY.values(), *SENSORS.values())]


def biased_imu():
    return IMU(gyro=Triad(noise=2.4e-4, bias_spread=0.0175), accel=Triad(noise=2e-3, bias_spread=0.2))


def kalman():
    """Return sensors of few numbers, each of which adds an update of 9 states to compile, and the filter.

    Without motion capture, a start that differs by 6e-8 m gives attitudes that differ by 1e-3 after 100 steps; with it,
    2e-7.
    """
    filter_inputs = [
        biased_imu(),
        MotionCapture(noise=0.01, freq=100),
        OpticalFlow(noise=0.2),
        TimeOfFlight(),
        UWB(ANCHORS, noise=0.1, tdoa=True),
        Lighthouse(ANCHORS[:1], STATIONS[1:], noise=4e-4),
    ]
    return [*filter_inputs, Kalman(filter_inputs)]


def eskf():
    filter_inputs = [biased_imu(), UWB(ANCHORS[:1], noise=0.1)]
    return [*filter_inputs, ESKF(filter_inputs)]


def complementary():
    filter_inputs = [IMU.bmi088(), Barometer(noise=2.0), TimeOfFlight(noise=0.01)]
    return [*filter_inputs, Complementary(filter_inputs)]


def add_drifting_pad(sim):
    pad = sim.scene.add("landing_pad", pos=[0, 0, 0.5])

    @stage("world")
    def drift(data):
        pos, _ = pad.pose(data)
        return pad.set_pose(data, pos + jnp.array([0.001, 0, 0]), vel=jnp.array([0.5, 0, 0]))

    sim.step_pipeline["drift"] = drift


def add_ball(sim):
    sim.scene.add("sphere", pos=[0.1, 0, 1.1], radius=0.1, mocap=False)


def let_drones_meet(sim):
    pos, vel = [[0, 0, 1.0], [0.12, 0.02, 1.01]], [[0.5, 0, -0.3], [-0.5, 0, -0.3]]
    shape = sim.data.states.pos.shape
    sim.data = with_states(sim.data, pos=np.broadcast_to(pos, shape), vel=np.broadcast_to(vel, shape))


@stage("drone")
def distances(data):
    s = data.states
    rot = rotation.matrix(s.quat)
    values = jnp.stack([distance(SPHERE, shape, s.pos, rot) for shape in SHAPES])
    slope = jax.grad(lambda pos: distance(SPHERE, SHAPES[0], pos, rot))(s.pos)
    return data.replace(states=s.replace(force=values[:3] + values[3:6], torque=values[4:] + slope))


def replace_stages(**stages):
    """Return a function that replaces all stages of a simulation except ``increment_steps``."""

    def prepare(sim):
        sim.step_pipeline = stages | {"increment_steps": sim.step_pipeline["increment_steps"]}

    return prepare


def insert_before_integration(*stages):
    """Return a function that inserts stages into a simulation before ``integration``."""

    def prepare(sim):
        for fn in stages:
            insert_fn_before(sim.step_pipeline, "integration", fn)

    return prepare


def mean_torque(data):
    mean = jnp.mean(data.states.pos, axis=(0, 1))
    return data.replace(states=data.states.replace(torque=0 * data.states.torque + 1e-6 * mean))


NAMED_CONTROLLERS = [name for name in CONTROLLERS if name not in ("auto", "crazyflow", "load_lqr", "tracking_lqr")]
"""Controllers of states that need no settings, except the default ``"auto"``."""


def select_controller(state, setpoint, time):
    """Return the index of the active controller; each is active for six steps."""
    return jnp.int32(time * 500 / 6) % len(NAMED_CONTROLLERS)


def make_builder(plugins=list, **settings):
    def build(**options):
        return make_flying_sim(plugins=plugins(), **settings | options)

    build.plugins = plugins
    return build


def build_tracking_sim(**options):
    t = np.linspace(0, 1, 11)
    controller = TrackingLQR(setpoints=jax.vmap(FIGURE_EIGHT.evaluate)(t), dt=0.1)
    return make_flying_sim(plugins=follow(), control="state", controller=controller, **options)


def follow():
    return [Follow([FIGURE_EIGHT])]


build_tracking_sim.plugins = follow


def build_fleet(**options):
    """Return a simulation of drones of several airframes, one of which has six rotors."""
    sim = Sim(3, drone=FLEET, control="attitude", integrator="rk4", **options)
    rng = np.random.default_rng(0)
    sim.data = with_states(sim.data, pos=rng.uniform(0.9, 1.1, (3, 4, 3)), vel=[0.1, 0.1, 0.1])
    sim.attitude_control(rng.uniform([0, 0, 0, 0.3], [0.2, 0.1, 0.2, 0.4], (3, 4, 4)))
    return sim


STEPS = {
    f"{dynamics}-{control}-{INTEGRATORS[i % 3]}": {
        "dynamics": dynamics, "control": control, "integrator": INTEGRATORS[i % 3],
    } for i, (dynamics, control) in enumerate(PAIRS)
}  # fmt: skip
"""Every kind of dynamics and command level, and every integrator."""
CASES = {name: make_builder(**settings) for name, settings in STEPS.items()}
CASES |= {
    "crazyflow": make_builder(control="state", controller="crazyflow"),
    "controllers": make_builder(control="state", controller=NAMED_CONTROLLERS, switch=select_controller),
    "load_lqr": make_builder(
        lambda: [SlungLoad(0.05, 0.4)], drone="bumblebee", control="state", controller=LoadLQR()
    ),
    "tracking_lqr": build_tracking_sim,
    "effects": make_builder(effects, control="attitude"),
    "randomize": make_builder(
        lambda: [Randomize(PATHS, **RANGES, charge=(0.2, 0.6), delay=(1, 4)), Battery(),
                 Latency(delay=np.zeros((8, 2), int), max_delay=4)],
        control="rotor_vel",
    ),
    "airframes": make_builder(lambda: [RandomAirframe(), Randomize(mass=(0.9, 1.1))], control="rotor_vel"),
    "sensors": make_builder(all_sensors, control="rotor_vel"),
    "kalman": make_builder(kalman, n_drones=1, control="state"),
    "eskf": make_builder(eskf, n_drones=1, control="state"),
    "complementary": make_builder(complementary, control="attitude"),
    "load": make_builder(
        lambda: [SlungLoad(0.005, 0.3, cable=True, drag=0.01), RotorJet(), ContactResponse(iterations=2)],
        control="attitude", prepare=add_ball,
    ),
    "shared": make_builder(lambda: [SharedLoad(0.005)], control="attitude", integrator="symplectic_euler"),
    "hook": make_builder(lambda: [Hook.bumblebee(0.2), ContactLog()], control="state", drone="bumblebee"),
    "vehicles": make_builder(
        lambda: [Cars(2, path=figure_eight(6.0, 2.0, period=12.0), controller=vehicles.PathLQR(), trailer=True),
                 Bicycles(pos=(0.0, 3.0)), Radar((0.0, 0.0, 0.5))],
        control="rotor_vel",
    ),
    "terrain": make_builder(
        lambda: [Terrain(HILLS, (8.0, 8.0)), RangeFinder([(0, 1, 0), (0.5, 0, -1)], drones=True), ContactLog()],
        control="attitude",
    ),
    "bodies": make_builder(
        lambda: [FreeBodies(3, size=(0.2, 0.2, 0.2), mass=0.2, pos=[(0, 0, 0.11), (0.02, 0, 0.35), (1, 0, 2.0)])],
        control="state",
    ),
    "scenery": make_builder(
        lambda: [Forest(size=(8.0, 8.0)), Pillars(size=(8.0, 8.0), speed=1.0), Clutter(size=(4.0, 4.0, 2.0)), Gates(),
                 Rooms()],
        control="rotor_vel",
    ),
    "maps": make_builder(
        lambda: [Maps(MAPS), RangeFinder([(0, 1, 0), (0.5, 0, -1)]), ContactLog()], control="rotor_vel"
    ),
    "collisions": make_builder(lambda: [DroneCollisions()], control="attitude", prepare=let_drones_meet),
    "impact": make_builder(lambda: [ContactResponse()], control="attitude", height=0.05),
    "objects": make_builder(control="attitude", prepare=add_drifting_pad),
    "distances": make_builder(height=0.0, control="rotor_vel", prepare=replace_stages(distances=distances)),
    "fleet": build_fleet,
    "populations": lambda **options: build_springs(KINDS, 3, 2, 4, **options),
    "populations of equal sizes": lambda **options: build_springs(KINDS, 2, 2, 2, **options),
    "many members": lambda **options: build_springs(Tied, 2, 2, 9, **options),
    "stages of all scopes": make_builder(
        n_drones=4, control="attitude", prepare=insert_before_integration(repulsion, centre, mean_torque)
    ),
    "pairs of 17": make_builder(n_worlds=3, n_drones=17, control="rotor_vel", prepare=insert_before_integration(gap)),
    "downwash of 9": make_builder(lambda: [Downwash()], n_worlds=4, n_drones=9, control="attitude"),
}  # fmt: skip
"""Functions that return the simulations, by name."""
PLUGINS = {name: build.plugins for name, build in CASES.items() if hasattr(build, "plugins")}
"""Functions that return the plugins of these simulations."""
SPLIT_CASES = ("bodies", "collisions", "stages of all scopes", "many members")
"""Simulations with stages that no engine fuses."""
TOLERANCES = {"impact": 0.005}
"""Tolerances other than ``ROUNDING``. Corners of boxes that touch a floor amplify rounding: starts that differ by 1e-7
of their values give angular velocities that differ by 0.003 rad/s after 20 steps. At other heights, such as 0.03 m, a
corner touches in the last digit, and the difference is 0.6 rad/s."""
