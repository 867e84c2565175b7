"""Exported policies in other simulators: trained in crazysim, and flown unchanged."""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import importlib.util
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim.core.data import SimData
from crazysim.engine.backends import native
from crazysim.envs.phases import vectorize_over_worlds
from crazysim.envs.registry import make
from crazysim.envs.state import flatten
from crazysim.errors import ConfigError
from crazysim.lab.validate.rows import Row
from crazysim.lab.validate.simulators import COMMAND_PERIOD, SIMULATORS, Simulator, States

N_STARTS = 200
"""Number of starts of each policy in each simulator."""
POLICIES = {
    f"{task}{'_crazyflie' * randomized}": (task, {"randomize": "crazyflie"} if randomized else {})
    for task in ("hover", "track", "recover")
    for randomized in (False, True)
}
"""Task and options of the training of each policy, by name."""
PEERS = {
    "crazyflow": "crazyflow==0.4.0",
    "torchdiffeq": "rotorpy[batched]==3.0.0",
    "gym_pybullet_drones": "gym-pybullet-drones@git+https://github.com/learnsyslab/gym-pybullet-drones@90b178a",
}
"""Modules of simulators that may be missing, with the requirement for pip of each."""
SECTION_TEXT = f"""
Policies of `crazysim train`, with seed 0 and the recipes of their tasks, are exported and flown unchanged: the C
header commands attitudes and thrust at 50 Hz, and the ONNX file gives the same actions on the same observations.
The figure is the share of {N_STARTS} held-out starts from which the error stays below the tolerance of the task for
its last second, 5 s for `track`. Observations, errors and ends of episodes are those of our task on the states of
the other simulator.

All airframes have the mass, the inertia and the largest thrust of `cf21B_500`. The rest differs:

- crazysim: our default controller, 500 Hz. Drag of 0.022 N s/m across the rotors and 0.025 along them. The time
  constant of small changes of the rotor speeds is about 59 ms.
- C MuJoCo: our default controller in the loop, 500 Hz. No drag, although `track` was trained with drag. Thrusts follow
  their commands with a time constant of 59 ms; rotors have no inertia.
- Crazyflow: the same airframe, with Crazyflow's controller, 500 Hz.
- RotorPy: its brushless Crazyflie, whose thrust is proportional to the square of the speed, with a lag of 50 ms, a
  drag in hover of 0.046 N s/m across and 0.11 along the rotors, and translational lift. Its controller of attitudes
  (`cmd_ctatt`, 250 Hz) has its own gains, and cuts off rotor speeds below zero without a priority among thrust and
  torques, so that commands of yaw cost thrust. In the rows *our controller*, our default controller commands its
  rotors (500 Hz).
- gym-pybullet-drones: the physics `PYB` at 250 Hz, with the attitude part of its `DSLPIDControl`. Rotors follow at
  once and give at least 19% of their largest thrust; they are 28 mm from the axes instead of 35. No drag but
  Bullet's own damping, and gravity is 9.8 m/s^2.
""".strip()
"""Paragraphs of the section: method and differences of the simulators."""

PolicyFunction = Callable[[NDArray], NDArray]
"""Function that returns actions, (n, k), for observations, (n, n_obs), in float32."""


@dataclasses.dataclass(frozen=True)
class ExportedPolicy:
    """A trained policy, exported in both formats."""

    c: PolicyFunction
    """The C header, compiled."""
    onnx: PolicyFunction
    """The ONNX file."""
    centre: NDArray
    """Command at a zero action. (4,)"""
    scale: NDArray
    """Change of the command per unit of action. (4,)"""

    def command(self, obs: NDArray) -> NDArray:
        """Return the attitude commands of the C export for observations. (n, 4)"""
        return self.centre + self.scale * np.clip(self.c(obs), -1.0, 1.0)


@dataclasses.dataclass(frozen=True)
class FlightResult:
    """Outcome of the flights of one policy in one simulator."""

    success: float
    """Fraction of flights whose error is below the tolerance of the task for the last ``task.hold`` seconds."""
    crashed: float
    """Fraction of flights that ended early: the task terminated, or a state became non-finite."""
    error: float
    """Mean error of the flights that did not end early over the last ``task.hold`` seconds, m; NaN if all did."""
    observations: NDArray
    """Observations of all flights. (n_steps, n_starts, n_obs)"""


@functools.cache
def export_policy(name: str, folder: Path | None = None) -> ExportedPolicy:
    """Return a policy of ``POLICIES``, trained with seed 0 on its recipe, and exported.

    Args:
        folder: Folder that contains or receives the folders of the trainings; None to keep none.
    """
    from crazysim.lab.export.policies import to_c, to_onnx
    from crazysim.train import load_policy, run  # only here: they need packages of the extra train

    with tempfile.TemporaryDirectory() as temporary:
        run_folder = Path(temporary if folder is None else folder) / name
        if not (run_folder / "policy.npz").exists():
            task, options = POLICIES[name]
            partial_run = run_folder.with_name(f"{name}.partial")  # an interrupted training is no policy to fly
            shutil.rmtree(partial_run, ignore_errors=True)
            run(task, partial_run, film=False, log=lambda _: None, progress=False, options=options)
            partial_run.rename(run_folder)
        policy, _, meta = load_policy(run_folder)
        actions, n_obs = meta["actions"], sum(meta["observations"].values())
        centre, scale = (np.asarray(actions[key], float) for key in ("centre", "scale"))
        c = compile_header(to_c(policy, Path(temporary) / "policy.h", meta), n_obs, len(centre))
        return ExportedPolicy(c, _load_onnx(to_onnx(policy, Path(temporary) / "policy.onnx", meta)), centre, scale)


def compile_header(header: Path, n_obs: int, n_actions: int) -> PolicyFunction:
    """Return the function of an exported C header, compiled next to it."""
    if (compiler := native.compiler()) is None:
        raise ConfigError("expected a C++ compiler for the policies in C, got none. Install g++ or set CXX.")
    source, library = header.with_suffix(".cpp"), header.with_suffix(".so")
    source.write_text(
        f'#include "{header.name}"\n'
        f'extern "C" void act(int n, const float *obs, float *action) {{\n'
        f"    for (int i = 0; i < n; ++i) policy(obs + {n_obs} * i, action + {n_actions} * i);\n}}\n"
    )
    command = [*compiler.split(), "-O2", "-shared", "-fPIC", str(source), "-o", str(library)]
    subprocess.run(command, check=True, capture_output=True)
    act: Any = ctypes.CDLL(str(library)).act

    def compute_actions(obs: NDArray) -> NDArray:
        obs, out = np.ascontiguousarray(obs, np.float32), np.empty((len(obs), n_actions), np.float32)
        act(len(obs), *(x.ctypes.data_as(ctypes.c_void_p) for x in (obs, out)))
        return out

    return compute_actions


def _load_onnx(path: Path) -> PolicyFunction:
    runtime: Any = importlib.import_module("onnxruntime")
    session = runtime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    return lambda obs: session.run(None, {"observation": obs})[0]


def fly_task(
    task: str, command: Callable[[NDArray], NDArray], simulator: type[Simulator], n_starts: int = N_STARTS
) -> FlightResult:
    """Fly a task from its held-out starts in another simulator.

    The task provides starts, goals, observations, errors and ends of episodes. It reads the states of the other
    simulator, which replace the states in our data.

    Args:
        command: Policy, a function that returns attitude commands, (n, 4), for observations, (n, n_obs).
    """
    from crazysim.train.evaluation import EVALUATION_SEED

    env = make(task, n_worlds=n_starts, freq=round(1 / COMMAND_PERIOD))
    data = env.reset(jax.random.key(EVALUATION_SEED)).data

    def assess(world_data: SimData) -> tuple[Array, Array, Array]:
        return flatten(env.task.observe(world_data)), env.task.error(world_data), env.task.terminated(world_data)

    assess_all = jax.jit(vectorize_over_worlds(assess, False))
    states: States = {
        name: np.asarray(getattr(data.states, name), np.float64)[:, 0] for name in ("pos", "quat", "vel", "ang_vel")
    }
    drones = simulator(states)
    is_done, errors, observations = np.zeros(n_starts, bool), [], []
    for _ in range(env.max_steps):
        obs = np.asarray(assess_all(data)[0])[:, 0]
        states = drones.fly_period(command(obs))
        fields = {name: x[:, None].astype(np.float32) for name, x in states.items()}
        core = data.core.replace(steps=data.core.steps + env.n_substeps)
        data = data.replace(states=data.states.replace(**fields), core=core)
        _, error, terminated = assess_all(data)
        is_done |= np.asarray(terminated) | ~np.all([np.isfinite(x).all(axis=-1) for x in states.values()], axis=0)
        errors.append(np.asarray(error)[:, 0])
        observations.append(obs)
        if is_done.all():
            break
    last_errors = np.stack(errors[-round(env.task.hold / COMMAND_PERIOD) :])
    is_settled, completed_errors = np.all(last_errors < env.task.tolerance, axis=0) & ~is_done, last_errors[:, ~is_done]
    mean_error = float(completed_errors.mean()) if completed_errors.size else float("nan")
    return FlightResult(float(is_settled.mean()), float(is_done.mean()), mean_error, np.stack(observations))


def checks(data: Path | None) -> Sequence[Callable[[], Iterable[Row]]]:
    """Return the comparisons of all policies in all simulators.

    Args:
        data: Folder in whose folder ``policies`` the trainings are kept; None to keep none.
    """
    folder = None if data is None else data / "policies"
    return [partial(compare_policy, name, simulator, folder) for name in POLICIES for simulator in SIMULATORS]


def compare_policy(name: str, simulator: str, folder: Path | None = None) -> Iterable[Row]:
    """Yield the success of an exported policy in one simulator, or nothing if the simulator is not installed.

    For crazysim itself, also yield the largest difference between the actions of the two exports on all observations of
    the flights.
    """
    module = SIMULATORS[simulator].module
    if module and importlib.util.find_spec(module) is None:
        return
    policy, (task, options) = export_policy(name, folder), POLICIES[name]
    result = fly_task(task, policy.command, SIMULATORS[simulator])
    quantity = f"`{task}`{', trained with `randomize=crazyflie`' * bool(options)}"
    remark = f"crashed {100 * result.crashed:.3g} %"
    remark = remark if np.isnan(result.error) else f"mean error {result.error:.2g} m, {remark}"
    yield Row(f"{quantity}: success", simulator, 100 * result.success, "%", None, remark)
    if simulator == "crazysim":
        obs = result.observations.reshape(-1, result.observations.shape[-1])
        difference = float(np.abs(policy.c(obs) - policy.onnx(obs)).max())
        # actions are in [-1, 1], and sums of 64 products are rounded in another order
        yield Row(f"{quantity}: actions of the C header", "ONNX file", difference, "", (0, 1e-5))
