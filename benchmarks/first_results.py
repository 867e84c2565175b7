"""Time from ``python`` to the first result of a new user, without and with persistent caches.

Each run is a separate process. ``wall_s`` and ``cpu_s`` (user and system, with the C++ compiler) are medians.

    python benchmarks/first_results.py [--repeat 3] [--cases step contacts ...]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time

from measure import describe_machine

from crazysim import __version__
from crazysim.engine.cache import CACHE_VARIABLE

CASES = {
    "step": """
sim = crazysim.Sim()
sim.step()
print(sim.data.states.pos)
""",
    "contacts": """
sim = crazysim.Sim(n_worlds=64, n_drones=2, control="state")
sim.step()
print(sim.contacts().any())
""",
    "gradient": """
import jax
import numpy as np
from crazysim import functional as F
sim = crazysim.Sim(n_worlds=64, n_drones=2, control="state")
step, target = sim.build_step_fn(), np.array(sim.data.states.pos)
def height(climb):
    data = F.state_control(sim.data, pos=target + climb * np.eye(3)[2])
    return step(data, 100).states.pos[..., 2].mean()
print(jax.grad(height)(0.5))
""",
    "gymnasium": """
import gymnasium
import numpy as np
import crazysim.envs
env = gymnasium.make_vec("crazysim/Hover-v0", num_envs=16)
env.reset(seed=1)
print(env.step(np.zeros((16, 4), np.float32))[1])
""",
    "render": """
print(crazysim.Sim().render("rgb_array").mean())
""",
}
"""Programs by case, without their first line ``import crazysim``."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    args = parser.parse_args()
    for case in args.cases:
        with tempfile.TemporaryDirectory() as folder:
            uncached = [measure_case(case, "off") for _ in range(args.repeat)]
            measure_case(case, folder)
            cached = [measure_case(case, folder) for _ in range(args.repeat)]
        for name, runs in (("off", uncached), ("on", cached)):
            wall, cpu = map(statistics.median, zip(*runs, strict=True))
            line = {"benchmark": "first_results", "case": case, "cache": name}
            times = {"wall_s": round(wall, 2), "cpu_s": round(cpu, 2), "crazysim": __version__}
            print(json.dumps(line | times | describe_machine("cpu")), flush=True)


def measure_case(case: str, cache: str) -> tuple[float, float]:
    """Return the wall time and the CPU time of a process that runs a case, s."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")} | {CACHE_VARIABLE: cache}
    program = f"import crazysim\n{CASES[case]}"
    usage_before, start_time = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-c", program], env=environment, check=True, stdout=subprocess.DEVNULL)
    wall, usage_after = time.perf_counter() - start_time, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, usage_after.ru_utime + usage_after.ru_stime - usage_before.ru_utime - usage_before.ru_stime


if __name__ == "__main__":
    main()
