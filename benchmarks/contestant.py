"""One program, crazysim or Crazyflow, in a process of its own: ``versus_crazyflow.py`` asks it by JSON lines.

python benchmarks/contestant.py crazysim
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from typing import Any


def main(package: str) -> None:
    """Answer requests until standard input ends."""
    begin = time.perf_counter()
    module = importlib.import_module(f"{package}.sim")
    import jax  # behind the package, whose import it is a part of
    from measure import machine

    import_s = time.perf_counter() - begin
    timed: dict[str, Any] = {}
    for line in sys.stdin:
        request = json.loads(line)
        answer: dict[str, Any] = {}
        match request["do"]:
            case "first_step":
                begin = time.perf_counter()
                sim = module.Sim(n_worlds=1, device=request["device"])
                sim.step()
                jax.block_until_ready(sim.data.states.pos)
                answer = {"import_s": import_s, "to_first_step_s": time.perf_counter() - begin}
            case "build":
                made = build(package, request["task"], request["case"], request["device"])
                timed[request["name"]], answer = made, {"seconds": made.first_s}
            case "time":
                answer = {"seconds": timed[request["name"]].seconds()}
            case "end":
                timed.pop(request["name"]).require_flying()
            case "machine":
                answer = {package: importlib.import_module(package).__version__, **machine(request["device"])}
        print(json.dumps(answer), flush=True)


def build(package: str, task: str, case: dict[str, Any], device: str) -> Any:
    """Return what is to be timed: a flight, or its gradient."""
    from measure import Flight

    settings = dict(case)
    n_steps = settings.pop("n_steps")
    sim = importlib.import_module(f"{package}.sim").Sim(**settings, device=device)
    return Gradient(package, sim, n_steps) if task == "gradient" else Flight(sim, case["control"], n_steps, device)


class Gradient:
    """The gradient of how far drones fly by their attitude commands, timed as ``measure.Flight`` is."""

    def __init__(self, package: str, sim: Any, n_steps: int):
        """Compile it."""
        import jax
        import jax.numpy as jnp
        from measure import hovering, seconds

        functional = importlib.import_module(f"{package}.sim.functional")
        hovering(sim, "attitude")
        step, start = sim.build_step_fn(), sim.data

        def loss(cmd: jax.Array) -> jax.Array:
            end = step(functional.attitude_control(start, cmd), n_steps)
            return jnp.sum((end.states.pos - start.states.pos) ** 2)

        self._grad, self._cmd = jax.jit(jax.grad(loss)), 1.01 * start.controls.attitude.staged_cmd
        self._seconds = seconds
        self.first_s = self.seconds()

    def seconds(self) -> float:
        """Return the seconds of a call."""
        return self._seconds(lambda: self._grad(self._cmd))

    def require_flying(self) -> None:
        """Refuse a figure of a gradient that is none.

        Raises:
            SystemExit: If it is zero everywhere, or not finite.
        """
        import jax.numpy as jnp

        slope = self._grad(self._cmd)
        if not (jnp.all(jnp.isfinite(slope)) and jnp.any(slope != 0)):
            raise SystemExit("the gradient is zero or not finite; no figure")


if __name__ == "__main__":
    main(sys.argv[1])
