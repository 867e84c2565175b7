"""Record reference trajectories of the simulator Crazyflow 0.4.0 for the golden tests.

The trajectories say what an independent program computes from the same start, the same airframe and the
same command. The script needs an environment of its own, because it imports Crazyflow and not crazysim:

    python -m venv peer && peer/bin/pip install crazyflow==0.4.0 jax==0.10.1 && peer/bin/python tests/golden/record.py

It writes one `<dynamics>-<control>.npz` beside itself for each allowed pair of dynamics and command level.
Names of pairs on the command line, such as `so_rpy-state`, limit the run to those files.

Every flight lasts 500 steps of 2 ms in two worlds with one drone each and is sampled every 50 steps. The
start, the command and the external force and torque are drawn from a fixed seed per world; the command,
force and torque then stay constant. The keys of a file are `<integrator>[-slow]/<airframe>/<quantity>`:

* `start_pos`, `start_quat`, `start_vel`, `start_ang_vel`, `start_rotor_vel`, `force`, `torque` and `command`
  have shape (2, 1, k) and say where the flight began and what drove it.
* `steps` has shape (10,) and holds the number of steps that each sample was taken after.
* `pos`, `quat`, `vel`, `ang_vel` and `rotor_vel` have shape (10, 2, 1, k) and come from a float64 run.
* `float32_error_pos` and so on have shape (10,) and hold the largest absolute difference of a float32 run of
  the same flight from the float64 run. The float32 run begins from the start rounded to float32.

Each precision runs in a process of its own, since Crazyflow needs the switch for 64 bit numbers before its
import. Both processes raise an exception when a flight comes near the floor, tips over or stays at an actuator
limit, where a wrong model would go unseen. The controllers of the first-principles flights may clip a rotor
command in the first 0.3 s, while they catch the disturbed start.
"""

from __future__ import annotations

import argparse
import itertools
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parent
PEER_VERSION = "0.4.0"
JAX_VERSION = "0.10.1"

SEED = 20261121
FREQ = 500
SAMPLE_EVERY = 50
N_SAMPLES = 10
N_WORLDS = 2
GRAVITY = 9.81
FIELDS = ("pos", "quat", "vel", "ang_vel", "rotor_vel")

CRAZYFLIES = ("cf2x_L250", "cf2x_P250", "cf2x_T350", "cf21B_500")
AIRFRAMES = {
    "first_principles": CRAZYFLIES,
    "so_rpy": (*CRAZYFLIES, "hb_x500"),
    "so_rpy_rotor": (*CRAZYFLIES, "hb_x500"),
    "so_rpy_rotor_drag": (*CRAZYFLIES, "hb_x500"),
}
CONTROLS = {
    "first_principles": ("state", "attitude", "body_rate", "force_torque", "rotor_vel"),
    "so_rpy": ("state", "attitude"),
    "so_rpy_rotor": ("state", "attitude"),
    "so_rpy_rotor_drag": ("state", "attitude"),
}
PAIRS = tuple((dynamics, control) for dynamics, controls in CONTROLS.items() for control in controls)
OPEN_LOOP = ("force_torque", "rotor_vel")
SLOW_FREQS = {
    ("first_principles", "state"): {"state_freq": 50, "attitude_freq": 250, "force_torque_freq": 250},
    ("first_principles", "attitude"): {"attitude_freq": 100, "force_torque_freq": 500},
}
# The section of Crazyflow's controller parameters that belongs to each stage of its controller.
CONTROLLER_SECTIONS = {
    "state": "state2attitude",
    "attitude": "attitude2force_torque",
    "body_rate": "body_rate2force_torque",
    "force_torque": "force_torque2rotor_vel",
}

# The signs with which the four rotors add up to a roll, pitch and yaw torque on every Crazyflie.
ROLL = np.array([-1.0, -1.0, 1.0, 1.0])
PITCH = np.array([-1.0, 1.0, 1.0, -1.0])
YAW = np.array([-1.0, 1.0, -1.0, 1.0])
# External torques are given for this roll inertia (kg m^2) and grow with that of the airframe.
REFERENCE_INERTIA = 20e-6

MIN_HEIGHT = 0.2
MAX_TILT = np.deg2rad(70.0)
# Nothing controls the tilt of an open-loop flight, so it has to leave more room.
MAX_TILT_OPEN_LOOP = np.deg2rad(60.0)
# Last step up to which a controller may command more than the rotors can give.
LAST_CLIPPED_STEP = 150


def variants(dynamics: str, control: str) -> dict[str, tuple[str, dict[str, int]]]:
    result: dict[str, tuple[str, dict[str, int]]] = {"euler": ("euler", {}), "rk4": ("rk4", {})}
    if (dynamics, control) == ("first_principles", "attitude"):
        result["symplectic_euler"] = ("symplectic_euler", {})
    if (dynamics, control) in SLOW_FREQS:
        result["euler-slow"] = ("euler", SLOW_FREQS[dynamics, control])
    return result


def hover_thrust(params: dict) -> float:
    weight = float(params["mass"]) * GRAVITY
    if "cmd_f_coef" in params:
        return (weight - float(params["acc_coef"])) / float(params["cmd_f_coef"])
    return weight


def force_to_rpm(force: float, params: dict) -> float:
    c, b, a = (float(x) for x in np.ravel(params["rpm2thrust"]))
    return (-b + np.sqrt(b * b - 4.0 * a * (c - force))) / (2.0 * a)


def rotor_limits(dynamics: str, params: dict) -> tuple[float, float]:
    """Compute the bounds of `rotor_vel`: rpm of one rotor, or N of collective thrust for fitted dynamics."""
    low, high = float(params["thrust_min"]), float(params["thrust_max"])
    if dynamics == "first_principles":
        return force_to_rpm(low, params), force_to_rpm(high, params)
    return 4.0 * low, 4.0 * high


def draw_signed(rng: np.random.Generator, low: float, high: float, size: int = 3) -> np.ndarray:
    """Draw numbers of a size in [low, high] with either sign, so that none is close to zero."""
    return rng.uniform(low, high, size) * rng.choice((-1.0, 1.0), size)


def draw_balanced_rotors(rng: np.random.Generator) -> np.ndarray:
    """Draw four different relative rotor speeds whose roll and pitch torque is tiny.

    A drone that no controller holds turns over within a second when its rotors differ by one percent at
    random, but not when opposite rotors agree: that difference only yaws it.
    """
    twist = draw_signed(rng, 0.003, 0.008, 1)
    tilt = draw_signed(rng, 5e-5, 1e-4, 2)
    return 1.0 + twist * YAW + tilt[0] * ROLL + tilt[1] * PITCH


def draw_world(dynamics: str, control: str, params: dict, world: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng([SEED, world])
    open_loop = control in OPEN_LOOP
    weight = float(params["mass"]) * GRAVITY
    thrust = hover_thrust(params)
    inertia_ratio = float(params["J"][0][0]) / REFERENCE_INERTIA

    pos = np.array([0.0, 0.0, 1.5]) + rng.uniform(-0.3, 0.3, 3)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    angle = np.deg2rad(rng.uniform(10.0, 20.0)) * (0.4 if open_loop else 1.0)
    quat = np.append(axis * np.sin(angle / 2.0), np.cos(angle / 2.0))
    # Under state control a Crazyflie with the motors of the first generation has half its weight to spare,
    # and loses its attitude when it has to brake a fast fall and to right itself at once.
    vel = rng.uniform(-0.5, 0.5, 3) * (0.5 if control == "state" else 1.0)
    ang_vel = rng.uniform(-1.0, 1.0, 3) * (0.1 if open_loop else 0.5 if control == "state" else 1.0)
    force = draw_signed(rng, 0.01, 0.04) * weight
    torque = draw_signed(rng, 1e-6, 3e-6 if open_loop else 1e-5) * inertia_ratio

    if dynamics == "first_principles":
        hover = force_to_rpm(weight / 4.0, params)
        if open_loop:
            rotor_vel = hover * rng.uniform(0.95, 1.05) * draw_balanced_rotors(rng)
        else:
            rotor_vel = hover * rng.uniform(0.95, 1.05, 4)
    elif dynamics == "so_rpy":
        rotor_vel = np.zeros(4)
    else:
        rotor_vel = np.full(4, thrust * rng.uniform(0.95, 1.05))

    if control == "state":
        # The controller answers an error in height with far more thrust than an error to the side, and a target
        # 0.3 m above would hold the rotors at their limit for most of the flight.
        direction = rng.normal(size=3) * (1.0, 1.0, 0.3)
        yaw = draw_signed(rng, 0.25, 0.35, 1)
        command = np.concatenate(
            (
                pos + 0.3 * direction / np.linalg.norm(direction),
                draw_signed(rng, 0.02, 0.1),
                draw_signed(rng, 0.02, 0.2),
                np.zeros(2),
                np.sin(yaw / 2.0),
                np.cos(yaw / 2.0),
                draw_signed(rng, 0.05, 0.2),
            )
        )
    elif control == "attitude":
        command = np.append(draw_signed(rng, 0.05, 0.2), thrust * rng.uniform(0.95, 1.1))
    elif control == "body_rate":
        command = np.append(draw_signed(rng, 0.1, 0.5), thrust * rng.uniform(0.98, 1.05))
    elif control == "force_torque":
        command = np.append(weight * rng.uniform(0.98, 1.05), draw_signed(rng, 5e-6, 1e-5))
    elif control == "rotor_vel":
        command = hover * draw_balanced_rotors(rng)
    else:
        raise ValueError(f"unknown command level {control}")
    return {
        "start_pos": pos,
        "start_quat": quat,
        "start_vel": vel,
        "start_ang_vel": ang_vel,
        "start_rotor_vel": rotor_vel,
        "force": force,
        "torque": torque,
        "command": command,
    }


def draw_flight(dynamics: str, control: str, params: dict) -> dict[str, np.ndarray]:
    """Draw what both worlds begin with, with shape (worlds, 1, k) for each quantity."""
    worlds = [draw_world(dynamics, control, params, world) for world in range(N_WORLDS)]
    return {name: np.stack([world[name] for world in worlds])[:, None, :] for name in worlds[0]}


def check_dtypes(sim, dtype: np.dtype, where: str) -> None:
    import jax
    import jax.numpy as jnp

    for path, leaf in jax.tree_util.tree_leaves_with_path(sim.data):
        if jnp.issubdtype(leaf.dtype, jnp.floating) and leaf.dtype != dtype:
            raise RuntimeError(f"{where}: {jax.tree_util.keystr(path)} is {leaf.dtype} and not {dtype}")
    # A step may compute in another float type and still return the right one, so its jaxpr is checked too.
    other = "f32[" if dtype == np.float64 else "f64["
    if other in str(sim._step.trace(sim.data, n_steps=SAMPLE_EVERY).jaxpr):
        raise RuntimeError(f"{where}: the step computes in another float type than {dtype}")


def check_params(sim, params: dict, gains: dict, dtype: np.dtype, where: str) -> None:
    """Raise unless the parameters inside a sim are those of Crazyflow's files to the last bit of the type.

    A parameter that was float32 for a moment is float64 again afterwards, but has lost its last digits.
    """
    pairs = []
    for name in params.keys() & vars(sim.data.params).keys():
        if name != "J_inv":  # Crazyflow inverts J in its own float type.
            pairs.append((name, getattr(sim.data.params, name), params[name]))
    for stage, section in CONTROLLER_SECTIONS.items():
        if (data := getattr(sim.data.controls, stage)) is not None:
            expected = {**gains["core"], **gains.get(section, {})}
            pairs += [(f"{stage}.{name}", value, expected[name]) for name, value in data.params.items()]
    for name, value, expected in pairs:
        if not np.array_equal(np.ravel(value).astype(dtype), np.ravel(expected).astype(dtype)):
            raise RuntimeError(f"{where}: parameter {name} is {value} and not {expected}")


def check_sample(
    state: dict[str, np.ndarray],
    actuators: np.ndarray,
    limits: tuple[float, float],
    dynamics: str,
    control: str,
    step: int,
    where: str,
) -> None:
    """Raise unless a sample is well inside the region in which the models are smooth."""
    if not all(np.isfinite(value).all() for value in (*state.values(), actuators)):
        raise RuntimeError(f"{where}: the state is not finite")
    if (height := state["pos"][..., 2].min()) < MIN_HEIGHT:
        raise RuntimeError(f"{where}: height {height:.2f} m")
    x, y, _, _ = np.moveaxis(state["quat"], -1, 0)
    tilt = np.arccos(1.0 - 2.0 * (x**2 + y**2)).max()
    if tilt > (MAX_TILT_OPEN_LOOP if control in OPEN_LOOP else MAX_TILT):
        raise RuntimeError(f"{where}: tilt {np.rad2deg(tilt):.0f} degrees")
    if np.abs(np.linalg.norm(state["quat"], axis=-1) - 1.0).max() > 1e-5:
        raise RuntimeError(f"{where}: the quaternion is not of unit length")
    # The state of the rotors lags behind the command, so look at both. so_rpy has no such state.
    values = {} if dynamics == "so_rpy" else {"rotor state": state["rotor_vel"]}
    if dynamics != "first_principles" or control in OPEN_LOOP or step > LAST_CLIPPED_STEP:
        values["rotor command"] = actuators
    for name, value in values.items():
        if not limits[0] < value.min() <= value.max() < limits[1]:
            raise RuntimeError(f"{where}: {name} {value.ravel()} is not inside {limits}")


def fly(
    dynamics: str, control: str, airframe: str, integrator: str, freqs: dict[str, int], dtype: np.dtype
) -> dict[str, np.ndarray]:
    import jax.numpy as jnp
    from crazyflow.control import load_params as load_gains
    from crazyflow.dynamics import load_params
    from crazyflow.sim import Sim

    where = f"{dynamics}-{control} {integrator} {freqs or ''} {airframe} {dtype}"
    params = load_params(dynamics, airframe)
    sim = Sim(
        n_worlds=N_WORLDS,
        n_drones=1,
        drone=airframe,
        dynamics=dynamics,
        control=control,
        integrator=integrator,
        freq=FREQ,
        **freqs,
    )
    flight = draw_flight(dynamics, control, params)
    start = {name: flight[f"start_{name}"] for name in FIELDS} | {k: flight[k] for k in ("force", "torque")}
    start = {name: jnp.asarray(value, dtype=dtype) for name, value in start.items()}
    sim.data = sim.data.replace(states=sim.data.states.replace(**start))
    getattr(sim, f"{control}_control")(jnp.asarray(flight["command"], dtype=dtype))
    check_dtypes(sim, dtype, where)
    check_params(sim, params, load_gains("mellinger", airframe), dtype, where)

    limits = rotor_limits(dynamics, params)
    samples: dict[str, list[np.ndarray]] = {name: [] for name in FIELDS}
    steps = np.arange(1, N_SAMPLES + 1) * SAMPLE_EVERY
    for step in steps:
        sim.step(SAMPLE_EVERY)
        state = {name: np.asarray(getattr(sim.data.states, name)) for name in FIELDS}
        if dynamics == "first_principles":
            actuators = np.asarray(sim.data.controls.rotor_vel)
        else:
            actuators = np.asarray(sim.data.controls.attitude.cmd[..., 3])
        check_sample(state, actuators, limits, dynamics, control, int(step), f"{where} step {step}")
        for name in FIELDS:
            samples[name].append(state[name].astype(np.float64))
    if not np.all(np.asarray(sim.data.core.steps) == steps[-1]):
        raise RuntimeError(f"{where}: Crazyflow counted {sim.data.core.steps} steps")
    sim.close()
    flight["steps"] = steps
    return flight | {name: np.stack(values) for name, values in samples.items()}


def record_pass(pairs: list[tuple[str, str]], path: Path) -> None:
    import crazyflow
    import jax

    if crazyflow.__version__ != PEER_VERSION or jax.__version__ != JAX_VERSION:
        raise RuntimeError(
            f"found crazyflow {crazyflow.__version__} and jax {jax.__version__}, "
            f"and not {PEER_VERSION} and {JAX_VERSION}"
        )
    dtype = np.dtype(np.float64 if jax.config.jax_enable_x64 else np.float32)
    recorded = {}
    for dynamics, control in pairs:
        start_time = time.perf_counter()
        for (variant, (integrator, freqs)), airframe in itertools.product(
            variants(dynamics, control).items(), AIRFRAMES[dynamics]
        ):
            flight = fly(dynamics, control, airframe, integrator, freqs, dtype)
            for name, value in flight.items():
                recorded[f"{dynamics}-{control}/{variant}/{airframe}/{name}"] = value
        print(f"{dtype} {dynamics}-{control}: {time.perf_counter() - start_time:.0f} s", flush=True)
    np.savez(path, **recorded)


def merge(pair: tuple[str, str], double: dict[str, np.ndarray], single: dict[str, np.ndarray]) -> None:
    """Write the file of one pair from the two passes and print its largest float32 errors."""
    name = "-".join(pair)
    prefix = f"{name}/"
    golden: dict[str, np.ndarray] = {}
    worst: dict[tuple[str, str], float] = {}
    for key, value in double.items():
        if not key.startswith(prefix):
            continue
        label = key.removeprefix(prefix)
        golden[label] = value
        flight, field = label.rsplit("/", 1)
        if field in FIELDS:
            error = np.abs(single[key] - value).max(axis=(1, 2, 3))
            golden[f"{flight}/float32_error_{field}"] = error
            variant = flight.split("/")[0]
            worst[variant, field] = max(worst.get((variant, field), 0.0), float(error.max()))
        elif not np.array_equal(single[key], value):
            raise RuntimeError(f"{key} differs between the passes")
    path = FOLDER / f"{name}.npz"
    np.savez_compressed(path, **golden)
    print(f"{path.name}: {len(golden)} arrays, {path.stat().st_size / 1000:.0f} kB")
    for variant in dict.fromkeys(variant for variant, _ in worst):
        errors = "  ".join(f"{field} {worst[variant, field]:.1e}" for field in FIELDS)
        print(f"  float32 error, {variant:<16}  {errors}")


def main() -> None:
    names = ["-".join(pair) for pair in PAIRS]
    parser = argparse.ArgumentParser(description="Record reference trajectories of Crazyflow.")
    parser.add_argument("pairs", nargs="*", help="which files to remake, such as so_rpy-state (default: all)")
    parser.add_argument("--pass-file", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if unknown := set(args.pairs) - set(names):
        parser.error(f"unknown pairs {sorted(unknown)}, choose from {names}")
    pairs = [pair for pair, name in zip(PAIRS, names, strict=True) if not args.pairs or name in args.pairs]
    if args.pass_file is not None:
        record_pass(pairs, args.pass_file)
        return

    with tempfile.TemporaryDirectory() as scratch:
        passes = {}
        for precision, x64 in (("float64", "1"), ("float32", "0")):
            path = Path(scratch) / f"{precision}.npz"
            environment = {
                **os.environ,
                "JAX_ENABLE_X64": x64,
                "JAX_PLATFORMS": "cpu",
                # Crazyflow needs this before anything imports SciPy.
                "SCIPY_ARRAY_API": "1",
            }
            command = [sys.executable, str(Path(__file__).resolve()), *args.pairs, "--pass-file", str(path)]
            # MuJoCo writes a log of its warnings where it runs.
            subprocess.run(command, env=environment, cwd=scratch, check=True)
            with np.load(path) as file:
                passes[precision] = dict(file)
        for pair in pairs:
            merge(pair, passes["float64"], passes["float32"])


if __name__ == "__main__":
    main()
