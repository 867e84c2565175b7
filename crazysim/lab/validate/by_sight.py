"""Policies of the task ``forest`` with images of MuJoCo that are slow, late and noisy, flown by C MuJoCo."""

from __future__ import annotations

import copy
import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim.core.data import SimData
from crazysim.envs.env import Env
from crazysim.envs.phases import vectorize_over_worlds
from crazysim.envs.registry import make
from crazysim.envs.task import TASK_RECORD_NAME
from crazysim.envs.tasks.forest import CHECK_FREQ
from crazysim.errors import expect
from crazysim.lab.validate.rows import Row
from crazysim.lab.validate.simulators import (
    AIRFRAME,
    COMMAND_PERIOD,
    Crazysim,
    Mujoco,
    MujocoWithDrag,
    Simulator,
    States,
)
from crazysim.plugins.sensors.camera import Camera
from crazysim.plugins.sensors.depth_errors import StereoNoise
from crazysim.scene.depth import HIDDEN_TOLERANCE

N_FORESTS = 100
"""Number of forests in which each policy flies."""
RATES, LATENCIES = (50, 30, 15), (0, 20, 40, 60)
"""Images per second, Hz, of which the first is the rate of the commands; times from image to delivery, ms."""
NOISES = ("none", "stereo", "stereo, filled")
"""Errors of images."""
NEAR_PLANE = 0.002
"""Distance from which MuJoCo's renderer draws, m: cameras of drones that touch a tree are nearer than its default."""
VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)
"""Groups of geoms that MuJoCo's renderer shows by default, for its rays."""
EVALUATION_STATES = "pos", "quat", "vel", "ang_vel"
"""States that other simulators replace."""
SECTION_TEXT = f"""
Policies of the task `forest`, unchanged, cross {N_FORESTS} held-out forests. The figure is the share of forests that
are crossed within 12 s without a touch. Depth images of the same trees are those of crazysim's kernel, of
`mj_multiRay` of C MuJoCo, or of MuJoCo's renderer, 50, 30 or 15 a second, 0 to {LATENCIES[-1]} ms late. Commands follow
at 50 Hz, each by the newest image that has arrived; between two commands the pose of the camera is interpolated.
*stereo* adds `StereoNoise()`; its holes, depths of 0, are the points which a ray from the second imager does not reach.
In *stereo, filled*, each hole gets the largest depth of the pixels beside it before the policy sees the image. C
MuJoCo flies as in *Sim to sim* with our controller and without drag, or *with drag*, the linear drag of our airframe;
task and trees are ours.
""".strip()
"""Paragraph of the section."""


SIMULATORS: dict[str, type[Simulator]] = {
    "crazysim": Crazysim,
    "C MuJoCo with drag": MujocoWithDrag,
    "C MuJoCo": Mujoco,
}
"""Simulators by name."""


class Condition(NamedTuple):
    """How a policy flies and sees."""

    simulator: str = "C MuJoCo with drag"
    """One of ``SIMULATORS``."""
    images: str = "mj_multiRay"
    """One of ``IMAGES``."""
    freq: int = RATES[0]
    """Images per second, Hz."""
    latency: int = 0
    """Time from image to delivery, ms."""
    noise: str = NOISES[0]
    """One of ``NOISES``."""


CONDITIONS = (
    Condition("crazysim", "crazysim"),
    Condition("crazysim"),
    *(Condition(latency=latency) for latency in LATENCIES),
    *(Condition(freq=freq) for freq in RATES[1:]),
    *(Condition(freq=x, latency=y, noise="stereo") for x, y in itertools.product(RATES, LATENCIES)),
    *(Condition(freq=x, latency=y, noise="stereo, filled") for x, y in ((50, 0), (30, 20))),
    *(Condition("C MuJoCo", freq=x, latency=y, noise=noise) for x, y, noise in ((50, 0, "none"), (30, 20, "stereo"))),
    Condition(images="renderer", freq=30, latency=20, noise="stereo"),
)
"""Conditions in which a policy is flown."""


class OwnRays:
    """Depth images of crazysim's kernel.

    Args:
        env: Environment of the task.
        data: Its data after the reset.
        camera: Camera with two imagers.
    """

    def __init__(self, env: Env, data: SimData, camera: Camera):
        sim: Any = env.sim
        self.camera, self._data, self._mount = camera, data, camera.drone_camera(sim)
        self._cast = jax.jit(sim.scene.depth_fn(self._mount))

    def take(self, states: States, flying: NDArray, has_holes: bool = True) -> tuple[NDArray, NDArray]:
        """Return depths, m, and whether the second imager does not see the points. (n, height, width) each

        Args:
            flying: Worlds whose images are needed. (n,)
            has_holes: Whether the second imager is needed.
        """
        del flying, has_holes
        hits = self._cast(with_states(self._data, states))
        return np.asarray(hits.distance)[:, 0], np.asarray(hits.is_hidden)[:, 0]


class MujocoRays(OwnRays):
    """Depth images of C MuJoCo's rays."""

    def __init__(self, env: Env, data: SimData, camera: Camera):
        super().__init__(env, data, camera)
        scene, data = env.sim.scene, env.sim.plugins.with_moved_objects(data)
        self._worlds = []
        for world in range(env.sim.n_worlds):
            scene.sync_one(data, world)
            self._worlds.append(copy.copy(scene.mj_data))
        self._model = copy.copy(scene.mj_model)
        drone = self._model.body("drone:0").id
        self._mocap = self._model.body_mocapid[drone]
        own = self._model.body_rootid[self._model.geom_bodyid] == drone  # a drone never sees itself
        self._model.geom_matid[own], self._model.geom_rgba[own, 3] = -1, 0.0

    def take(self, states: States, flying: NDArray, has_holes: bool = True) -> tuple[NDArray, NDArray]:
        depth = np.full((len(flying), *self.camera.image_size), np.inf)
        is_hidden = np.zeros_like(depth, bool)
        for k in np.flatnonzero(flying):
            depth[k], is_hidden[k] = self._take_one(self._worlds[k], states["pos"][k], states["quat"][k], has_holes)
        return depth, is_hidden

    def _take_one(self, data: mujoco.MjData, pos: NDArray, quat: NDArray, has_holes: bool) -> tuple[NDArray, Any]:
        data.mocap_pos[self._mocap], data.mocap_quat[self._mocap] = pos, np.roll(quat, 1)
        mujoco.mj_kinematics(self._model, data)
        body = np.zeros(9)
        mujoco.mju_quat2Mat(body, np.roll(quat, 1))
        body = body.reshape(3, 3)
        left, rot = pos + body @ self._mount.pos[0], body @ self._mount.rot
        rays = self.camera.rays.reshape(-1, 3) @ rot.T
        distance = self._cast_rays(data, left, rays)
        depth = self._depth(data, distance.reshape(self.camera.image_size))
        if not has_holes:
            return depth, False
        right = left - self.camera.baseline * rot[:, 1]
        to_point = left + np.minimum(distance, 1e3)[:, None] * rays - right
        length = np.linalg.norm(to_point, axis=-1)
        is_nearer = self._cast_rays(data, right, to_point / length[:, None]) < (1 - HIDDEN_TOLERANCE) * length
        return depth, (is_nearer & np.isfinite(distance)).reshape(self.camera.image_size)

    def _depth(self, data: mujoco.MjData, distance: NDArray) -> NDArray:
        del data
        return distance * self.camera.rays[..., 0]

    def _cast_rays(self, data: mujoco.MjData, origin: NDArray, rays: NDArray) -> NDArray:
        n, geoms, distance = len(rays), np.zeros(len(rays), np.int32), np.zeros(len(rays))
        mujoco.mj_multiRay(
            self._model, data, origin, rays.ravel(), VISIBLE_GROUPS, True, -1, geoms, distance, None, n, mujoco.mjMAXVAL
        )
        return np.where(distance < 0, np.inf, distance)


class MujocoRenderer(MujocoRays):
    """Depth images of MuJoCo's renderer, with holes by C MuJoCo's rays."""

    def __init__(self, env: Env, data: SimData, camera: Camera):
        super().__init__(env, data, camera)
        self._camera_id = self._model.camera("fpv_cam:0").id
        self._model.cam_fovy[self._camera_id] = camera.fovy
        self._model.vis.map.znear = NEAR_PLANE / self._model.stat.extent
        self._model.vis.quality.offsamples = 0  # a depth is that of the middle of a pixel
        self._renderer = mujoco.Renderer(self._model, *camera.image_size)
        self._renderer.enable_depth_rendering()
        self._renderer.scene.flags[:] = 0  # neither shadows nor the sky change depths

    def _depth(self, data: mujoco.MjData, distance: NDArray) -> NDArray:
        del distance
        mujoco.mj_camlight(self._model, data)
        self._renderer.update_scene(data, self._camera_id)
        return self._renderer.render().astype(np.float64)


IMAGES: dict[str, type[OwnRays]] = {"crazysim": OwnRays, "mj_multiRay": MujocoRays, "renderer": MujocoRenderer}
"""Sources of images by name."""


class Forests(NamedTuple):
    """Held-out forests and what judges flights through them."""

    env: Env
    """Environment of all forests, without images."""
    data: SimData
    """Data at the start."""
    judge: Callable[[SimData], SimData]
    """Stage of the task that ends flights."""
    observe: Callable[[SimData], dict[str, Array]]
    """Observations without images."""


@functools.cache
def make_forests(n: int) -> Forests:
    from crazysim.train.evaluation import held_out_key  # only here: it needs packages of the extra train

    env = make("forest", n, drone=AIRFRAME, freq=round(1 / COMMAND_PERIOD), camera=())
    data = env.reset(held_out_key()).data
    # Flights are judged in this step of every ``CHECK_FREQ``.
    last_step = env.sim.freq // CHECK_FREQ - 1
    data = data.replace(core=data.core.replace(steps=jnp.full_like(data.core.steps, last_step)))
    judge = jax.jit(env.sim.step_pipeline[TASK_RECORD_NAME])
    return Forests(env, data, judge, jax.jit(vectorize_over_worlds(env.task.observe, False)))


@functools.cache
def image_source(name: str, n: int, camera: Camera) -> OwnRays:
    return IMAGES[name](make_forests(n).env, make_forests(n).data, camera)


class Pilot(NamedTuple):
    """A policy that sees."""

    act: Callable[[Any, Any], tuple[Array, Any]]
    """Function from observations and memory to actions, (n, 1, 4), and the memory after the step."""
    initial_memory: Callable[[int, int], Any]
    """Function from the numbers of worlds and drones to the memory at the start."""
    camera: Camera
    """Camera of its observation ``depth``, with two imagers."""


@functools.cache
def load_pilot(folder: Path) -> Pilot:
    """Load the policy of a run of the task ``forest``."""
    from crazysim.train import load_policy  # only here: it needs packages of the extra train

    policy, _, meta = load_policy(folder)
    kind = meta["task"], meta["actions"]["level"], meta["freq"]
    expect(kind == ("forest", "attitude", 50), "a policy of forest that commands attitudes at 50 Hz", kind)
    image = meta["images"]["depth"]
    camera = Camera(image["width"], image["height"], fovy=image["fovy"], max_depth=image["far"], noise=StereoNoise())
    return Pilot(jax.jit(policy.act), policy.initial_memory, camera)


def fill_holes(depth: Array) -> Array:
    """Fill holes, depths of 0, with the largest depth of the eight pixels beside them. (height, width)"""
    height, width = depth.shape
    padded = jnp.pad(depth, 1)
    beside = [padded[i : i + height, k : k + width] for i in range(3) for k in range(3)]
    return jnp.where(depth > 0, depth, jnp.max(jnp.stack(beside), axis=0))


@partial(jax.jit, static_argnames=("camera", "noise"))
def add_errors(depth: Array, is_hidden: Array, key: Array, camera: Camera, noise: str) -> Array:
    """Return depths as the policy sees them. (n, height, width)"""
    cosine = jnp.asarray(camera.rays[..., 0], jnp.float32)
    depth = jnp.minimum(depth, camera.far).astype(jnp.float32)
    if noise != "none":
        measure = jax.vmap(lambda *x: camera.measure(*x) * cosine)
        depth = measure(depth / cosine, is_hidden, jax.random.split(key, len(depth)))
    return jax.vmap(fill_holes)(depth) if noise == "stereo, filled" else depth


def with_states(data: SimData, states: States) -> SimData:
    """Return data with states of one drone in each world."""
    fields = {name: np.asarray(x[:, None], np.float32) for name, x in states.items()}
    return data.replace(states=data.states.replace(**fields))


def between(before: States, after: States, fraction: float) -> States:
    """Interpolate states; in a period of 20 ms positions are off by less than 1 mm at 20 m/s^2."""
    mean = {name: (1 - fraction) * before[name] + fraction * after[name] for name in before}
    sign = np.where(np.sum(before["quat"] * after["quat"], axis=-1, keepdims=True) < 0, -1, 1)
    quat = (1 - fraction) * sign * before["quat"] + fraction * after["quat"]
    return mean | {"quat": quat / np.linalg.norm(quat, axis=-1, keepdims=True)}


def fly_forest(pilot: Pilot, condition: Condition, n: int) -> tuple[float, float]:
    """Fly through held-out forests; return the shares that are crossed, and that end by a touch or outside."""
    env, data, judge, observe = make_forests(n)
    (act, initial_memory, camera), flying = pilot, np.ones(n, bool)
    source, memory = image_source(condition.images, n, camera), initial_memory(n, 1)
    states: States = {name: np.asarray(getattr(data.states, name), np.float64)[:, 0] for name in EVALUATION_STATES}
    drones = SIMULATORS[condition.simulator](states)

    def look(states: States, index: int) -> Array:
        depth, is_hidden = source.take(states, flying, condition.noise != "none")
        key = jax.random.fold_in(jax.random.key(0), index)
        return add_errors(jnp.asarray(depth), jnp.asarray(is_hidden), key, camera, condition.noise).reshape(n, 1, -1)

    shown, n_taken = look(states, 0), 1
    in_transit: list[tuple[float, Array]] = []
    for step in range(env.max_steps):
        action, memory = act(dict(observe(with_states(data, states))) | {"depth": shown}, memory)
        command = np.asarray(env.actions.command(action), np.float64)[:, 0]
        before, states, end = states, drones.fly_period(command), (step + 1) * COMMAND_PERIOD
        # Images that are taken in this period, and those that have arrived at its end.
        while (time := n_taken / condition.freq) < end + 1e-9:
            image = look(between(before, states, 1 - (end - time) / COMMAND_PERIOD), n_taken)
            in_transit.append((time + condition.latency / 1000, image))
            n_taken += 1
        while in_transit and in_transit[0][0] < end + 1e-9:
            _, shown = in_transit.pop(0)
        n_checks = round(CHECK_FREQ * COMMAND_PERIOD)
        for k in range(n_checks):
            data = judge(with_states(data, between(before, states, (k + 1) / n_checks)))
        record: Any = env.task.read(data)
        success, failure = (np.asarray(x)[:, 0] for x in (record.success, record.failure))
        flying = ~(success | failure)
        if not flying.any():
            break
    return float(success.mean()), float(failure.mean())


def find_runs(data: Path | None, policy: Path | None) -> list[Path]:
    """Return the policy if it is a run of ``forest``, or else such runs in the folder ``policies`` of the data."""
    runs = [] if data is None else sorted(data.glob("policies/*"))
    return [policy] if policy is not None and sees_forest(policy) else [run for run in runs if sees_forest(run)]


def sees_forest(folder: Path) -> bool:
    """Whether a file or folder is a run of the task ``forest``."""
    from crazysim.train import checkpoint

    if not (folder / "policy.npz").is_file():
        return False
    return checkpoint.read(folder / "policy.npz")[1]["task"] == "forest"


def checks(folders: Sequence[Path]) -> Sequence[Callable[[], Iterable[Row]]]:
    return [partial(measure_flight, folder, condition) for folder in folders for condition in CONDITIONS]


def measure_flight(folder: Path, condition: Condition) -> Iterable[Row]:
    """Yield the success of a policy in one condition."""
    simulator, images, freq, latency, noise = condition
    crossed, failed = fly_forest(load_pilot(folder), condition, N_FORESTS)
    quantity = f"images of {images}, {freq} Hz, {latency} ms late, noise: {noise}"
    remark = f"{100 * failed:.3g} % touched or left"
    yield Row(quantity, f"{folder.name}, {simulator}", 100 * crossed, "%", None, remark)
