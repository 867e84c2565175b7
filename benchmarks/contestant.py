"""Server process for one program, crazysim or Crazyflow: ``versus_crazyflow.py`` sends requests as JSON lines.

python benchmarks/contestant.py crazysim
"""

from __future__ import annotations

import importlib
import json
import statistics
import sys
import time
from typing import Any


def main(package: str) -> None:
    """Answer requests until standard input ends."""
    start_time = time.perf_counter()
    module = importlib.import_module(f"{package}.sim")
    import jax  # after the package, whose import time includes the import of JAX
    from measure import describe_machine

    import_s = time.perf_counter() - start_time
    contestants: dict[str, Any] = {}
    for line in sys.stdin:
        request = json.loads(line)
        answer: dict[str, Any] = {}
        match request["do"]:
            case "first_step":
                start_time = time.perf_counter()
                sim = module.Sim(n_worlds=1, device=request["device"])
                sim.step()
                jax.block_until_ready(sim.data.states.pos)
                answer = {"import_s": import_s, "to_first_step_s": time.perf_counter() - start_time}
            case "memory":
                sim = make_scene(module, package, request["n_worlds"], request["n_drones"], request["device"])
                answer = {"bytes": bytes_in_use(sim, package)}
            case "build":
                contestant = build(package, request["task"], request["case"], request["device"])
                contestants[request["name"]], answer = contestant, {"seconds": contestant.first_s}
            case "time":
                answer = {"seconds": contestants[request["name"]].seconds()}
            case "end":
                contestants.pop(request["name"]).require_flying()
            case "machine":
                answer = {package: importlib.import_module(package).__version__, **describe_machine(request["device"])}
        print(json.dumps(answer), flush=True)


def build(package: str, task: str, case: dict[str, Any], device: str) -> Any:
    """Return the case to time, such as a flight, its gradient or a scene query."""
    from measure import Flight

    if task == "gym":
        return GymSteps(package, case, device)
    if task in SCENE_QUERIES:
        return SceneQuery(package, task, case, device)
    settings = dict(case)
    n_steps = settings.pop("n_steps")
    sim = importlib.import_module(f"{package}.sim").Sim(**settings, device=device)
    if task == "loop":
        return Loop(sim, case["control"], n_steps)
    return Gradient(package, sim, n_steps) if task == "gradient" else Flight(sim, case["control"], n_steps, device)


class Loop:
    """The loop of every script: a command from NumPy, some steps, the positions into NumPy."""

    def __init__(self, sim: Any, control: str, n_steps: int, iterations: int = 50):
        import numpy as np
        from measure import start_hovering

        start_hovering(sim, control)
        self._sim, self._initial_data, self._n_steps, self._iterations = sim, sim.data, n_steps, iterations
        self._send = getattr(sim, f"{control}_control")
        self._command = np.array(getattr(sim.data.controls, control).staged_cmd)
        self.first_s = self.seconds()

    def seconds(self) -> float:
        """Return the time of one iteration, s."""
        import numpy as np

        self._sim.data = self._initial_data
        start_time = time.perf_counter()
        for _ in range(self._iterations):
            self._send(self._command)
            self._sim.step(self._n_steps)
            np.asarray(self._sim.data.states.pos)
        return (time.perf_counter() - start_time) / self._iterations

    def require_flying(self) -> None:
        """Check that the drones are still flying.

        Raises:
            SystemExit: If they are not.
        """
        from measure import is_flying

        if not is_flying(self._sim):
            raise SystemExit("a drone has crashed; no figure")


class Gradient:
    """Gradient of the final positions with respect to attitude commands, timed like ``measure.Flight``."""

    def __init__(self, package: str, sim: Any, n_steps: int):
        import jax
        import jax.numpy as jnp
        from measure import seconds, start_hovering

        functional = importlib.import_module(f"{package}.sim.functional")
        start_hovering(sim, "attitude")
        step, initial_data = sim.build_step_fn(), sim.data

        def loss(cmd: jax.Array) -> jax.Array:
            final_data = step(functional.attitude_control(initial_data, cmd), n_steps)
            return jnp.sum((final_data.states.pos - initial_data.states.pos) ** 2)

        self._grad, self._cmd = jax.jit(jax.grad(loss)), 1.01 * initial_data.controls.attitude.staged_cmd
        self._seconds = seconds
        self.first_s = self.seconds()

    def seconds(self) -> float:
        """Return the time of one call, s."""
        return self._seconds(lambda: self._grad(self._cmd))

    def require_flying(self) -> None:
        """Check that the gradient is finite and not zero.

        Raises:
            SystemExit: If it is zero everywhere, or not finite.
        """
        import jax.numpy as jnp

        slope = self._grad(self._cmd)
        if not (jnp.all(jnp.isfinite(slope)) and jnp.any(slope != 0)):
            raise SystemExit("the gradient is zero or not finite; no figure")


class GymSteps:
    """Steps of a Gymnasium vector environment in which drones reach a position.

    Drone, dynamics model (``so_rpy``), rates and autoreset are the same in both programs.
    """

    def __init__(self, package: str, case: dict[str, Any], device: str):
        import gymnasium
        import jax
        import numpy as np

        importlib.import_module(f"{package}.envs")
        settings = {"num_envs": case["n_worlds"], "freq": case["freq"], "dynamics": "so_rpy", "device": device}
        if package == "crazysim":
            settings |= {"drone": "cf2x_L250", "seconds": 10.0}  # the settings of Crazyflow's environment
        self._env = gymnasium.make_vec({"crazysim": "crazysim/Hover-v0"}.get(package, "DroneReachPos-v0"), **settings)
        # Near hover no world crashes, so resets are as rare as in use.
        box = self._env.single_action_space
        action = np.zeros(4) if package == "crazysim" else np.array([0, 0, 0, 0.0319 * 9.81])
        action = np.clip(action, box.low, box.high).astype(np.float32)
        self._action = jax.device_put(np.tile(action, (case["n_worlds"], 1)), jax.devices(device)[0])
        self._steps = case["n_steps"]
        self._env.reset(seed=0)
        self.first_s = self.seconds()
        self.seconds()

    def seconds(self) -> float:
        """Return the time of several steps with one synchronisation at the end, s."""
        import jax

        start_time = time.perf_counter()
        for _ in range(self._steps):
            self._results = self._env.step(self._action)
        jax.block_until_ready(self._results[:4])
        return time.perf_counter() - start_time

    def require_flying(self) -> None:
        """Check that few drones crash.

        Raises:
            SystemExit: If more than a tenth of the worlds ends with every step.
        """
        import numpy as np

        if np.mean(np.asarray(self._results[2])) > 0.1:
            raise SystemExit("more than a tenth of the worlds ends with every step; no figure")


OBJECTS = {
    "box": ('<geom type="box" size="0.1 0.1 0.1"/>', [[3, 0, 1], [4, 0, 1], [3, 3, 1], [4, 4, 1]]),
    "pole": ('<geom type="capsule" size="0.02 0.8"/>', [[3, 1, 1], [3, 2, 1]]),
    "ball": ('<geom type="sphere" size="0.1"/>', [[2, 0, 1.1], [-3, 2, 1]]),
}
"""Geoms and positions of eight movable objects, away from the drones."""
BATCH_SECONDS = 0.25
"""Duration of a batch of queries, s. The median is reported, because the first queries after a pause are slower."""
SCENE_QUERIES = ("contacts", "depth", "swarm_build")
"""Tasks that query or build a scene."""


def make_scene(module: Any, package: str, n_worlds: int, n_drones: int, device: str) -> Any:
    """Return a simulation of hovering drones among the objects, built with the API of the program."""
    import mujoco
    from measure import start_hovering

    sim = module.Sim(n_worlds=n_worlds, n_drones=n_drones, control="attitude", device=device)
    for name, (geom, positions) in OBJECTS.items():
        xml = f'<mujoco><worldbody><body name="{name}">{geom}</body></worldbody></mujoco>'
        if package == "crazysim":
            sim.scene.add(mujoco.MjSpec.from_string(xml).body(name), name, count=len(positions), pos=positions)
            continue
        frame = sim.spec.worldbody.add_frame()
        for k, pos in enumerate(positions):
            spec = mujoco.MjSpec.from_string(xml)
            body = frame.attach_body(spec.body(name), "", f":{k}")
            body.pos, body.mocap = pos, True
    if package != "crazysim":
        sim.build_mjx()
    start_hovering(sim, "attitude")
    return sim


def bytes_in_use(sim: Any, package: str) -> int:
    """Return the bytes in use on the device after a contact query."""
    import jax

    sim.step()
    jax.block_until_ready(sim.contact_report() if package == "crazysim" else sim.contacts())
    return sum(x.nbytes for x in jax.live_arrays())


class SceneQuery:
    """Scene query after a step, timed without the step, or the construction of a swarm."""

    def __init__(self, package: str, task: str, case: dict[str, Any], device: str):
        self._module, self._case, self._device = importlib.import_module(f"{package}.sim"), case, device
        self._task, self._sim = task, None
        if task != "swarm_build":
            self._sim = make_scene(self._module, package, case["n_worlds"], case["n_drones"], device)
        if task == "contacts":
            self._query = lambda: self._sim.contact_report() if package == "crazysim" else self._sim.contacts()
        elif package == "crazysim":
            self._query = lambda: self._sim.depth("fpv_cam:0", 64, 64)
        else:
            depth = importlib.import_module("crazyflow.sim.sensors.depth")
            self._query = lambda: depth.render_depth(self._sim, camera=1, resolution=(64, 64))
        self.first_s = self.seconds()

    def seconds(self) -> float:
        """Return the time of one query, s."""
        import jax

        if self._task == "swarm_build":
            start_time = time.perf_counter()
            self._sim = self._module.Sim(n_drones=self._case["n_drones"], device=self._device)
            return time.perf_counter() - start_time
        seconds: list[float] = []
        while sum(seconds) < BATCH_SECONDS:
            self._sim.step()
            jax.block_until_ready(self._sim.data.states.pos)
            start_time = time.perf_counter()
            jax.block_until_ready(self._query())
            seconds.append(time.perf_counter() - start_time)
        return statistics.median(seconds)

    def require_flying(self) -> None:
        """Check that the drones are still flying.

        Raises:
            SystemExit: If they are not.
        """
        from measure import is_flying

        if self._task != "swarm_build" and not is_flying(self._sim):
            raise SystemExit("a drone has crashed; no figure")


if __name__ == "__main__":
    main(sys.argv[1])
