"""Success on airframes that were not in the training, of policies with and without memory and privileged critic.

    python benchmarks/memory.py [--device gpu] [--tasks hover track] [--variants memoryless memory] [--seeds 0:4]
    python benchmarks/memory.py --device gpu --tasks hover --variants memory --seeds 0:4 --iterations 300
    python benchmarks/memory.py --worlds 16 --iterations 2 --starts 8 --seeds 0:2 --seconds 0.4

Every variant of a task is trained by PPO on drones that ``randomize="generic"`` draws around one airframe, all seeds in
one program. The memory of a variant is a gated recurrent unit in policy and critic, but not in a privileged critic. The
policy that a training keeps (``TrainResult.policy``) is then flown on other drones. They are drawn in the same way
around the airframe of the training (``drawn``) and around each of the other Crazyflies. Each evaluation uses the
controller gains and the action ranges of its airframe.

There is a JSON line for each seed. Runs in the folder ``--out`` are continued from their checkpoints.
"""

from __future__ import annotations

import argparse
import json
import math
import warnings
from pathlib import Path
from typing import Any

from measure import describe_machine, round_digits

from crazysim.commands.training import parse_seeds
from crazysim.envs import make
from crazysim.train import evaluate, run_many
from crazysim.train.training import CHECKPOINT_FILE

VARIANTS: dict[str, dict[str, Any]] = {
    "memoryless": {},
    "privileged": {"critic": "privileged"},
    "memory": {"memory": 64},
    "memory-privileged": {"memory": 64, "critic": "privileged"},
}
"""Hyperparameters of the variants, by name."""
AIRFRAMES = ("cf2x_L250", "cf2x_P250", "cf2x_T350")
"""Crazyflies other than ``cf21B_500``, the airframe of the training."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--tasks", nargs="+", default=["hover", "track"])
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["memoryless", "memory"])
    parser.add_argument("--seeds", type=parse_seeds, default=[0], help="such as 0:4")
    parser.add_argument("--worlds", type=int, default=2048, help="worlds of each seed")
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--starts", type=int, default=1000, help="drones of each evaluation")
    parser.add_argument("--out", type=Path, default=Path("out/memory"), help="folder of the runs")
    parser.add_argument("--seconds", type=float, help="length of an episode, s; by default the task's")
    args = parser.parse_args()
    options: dict[str, Any] = {"randomize": "generic", "device": args.device}
    options |= {} if args.seconds is None else {"seconds": args.seconds}
    drone_options = {drone: options | {"drone": drone} for drone in AIRFRAMES}
    options_by_drones: dict[str, dict[str, Any]] = {"drawn": options} | drone_options
    machine_facts = describe_machine(args.device)
    for task in args.tasks:
        envs = {name: make(task, args.starts, **env_options) for name, env_options in options_by_drones.items()}
        for variant in args.variants:
            folder = args.out / f"{task}-{variant}"
            training = {"n_steps": 64, "minibatches": 16, "discount": 0.98, "iterations": args.iterations}
            results = run_many(
                task,
                folder,
                seeds=args.seeds,
                resume=(folder / CHECKPOINT_FILE).exists(),
                evaluation_worlds=args.starts,
                progress=False,
                algorithm="ppo",
                n_worlds=args.worlds,
                options=options,
                config=training | VARIANTS[variant],
            )
            for seed, result in zip(args.seeds, results.values(), strict=True):
                line = {"benchmark": "memory", "task": task, "variant": variant, "seed": seed, "starts": args.starts}
                line |= {name: round_digits(result.metrics[name]) for name in ("env_steps", "seconds")}
                for name, env in envs.items():
                    with warnings.catch_warnings():  # ranges of actions differ between airframes on purpose
                        warnings.filterwarnings("ignore", message="actions of an environment have other ranges")
                        metrics = evaluate(env, result.policy)
                    numbers = {key: metrics[key] for key in ("success", "crashed", "error")}
                    line[name] = {key: round_digits(x) for key, x in numbers.items() if not math.isnan(x)}
                print(json.dumps(line | machine_facts), flush=True)


if __name__ == "__main__":
    main()
