"""What a change of mechanisms must leave as it is: flights bit for bit, operations, public names and messages.

    python tests/snapshot.py write BEFORE.json          # in a checkout of the state before
    python tests/snapshot.py write AFTER.json           # after the change, on the same machine
    python tests/snapshot.py compare BEFORE.json AFTER.json

Flights are those of ``tests/sweep.py`` and of every task, on the engines that users get. Bits depend on the machine,
its compiler and JAX, so files are compared on one machine and are not kept.
"""

import argparse
import ast
import hashlib
import importlib
import json
import pkgutil
from pathlib import Path

import conftest  # noqa: F401  # the caches, compilers and devices of the tests
import jax
import jax.numpy as jnp
import numpy as np
import sweep
from env_cases import random_action, task_names
from raised import raised

import crazysim
from crazysim.engine import Step
from crazysim.engine.tools.explain import explain
from crazysim.envs import make

ENGINES = ("plain", "fused")
N_STEPS = 20


def leaf_digests(tree):
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): digest(x) for path, x in leaves}


def digest(x):
    x = jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    array = np.asarray(x)
    return f"{array.dtype}{list(array.shape)} {hashlib.sha256(array.tobytes()).hexdigest()[:16]}"


def flights():
    result = {}
    for name, build in sweep.CASES.items():
        sim = build()
        for engine in ENGINES:
            step = Step(sim.step_pipeline, engine)
            result[f"{name}, {engine}"] = leaf_digests(step(sim.data, jnp.int32(N_STEPS)))
        result[f"{name}, explained"] = {"": explain(step, sim.data)}
    return result


def environments():
    result = {}
    for name in task_names():
        env = make(name, n_worlds=8)
        reset, step = jax.jit(env.reset), jax.jit(env.step)
        state = reset(jax.random.key(0))
        for seed in range(3):
            state = step(state, random_action(state, seed))
        result[name] = leaf_digests(state)
    return result


def public_names():
    names = {"crazysim": sorted(crazysim.__all__)}
    for module in pkgutil.walk_packages(crazysim.__path__, "crazysim."):
        if module.name.rpartition(".")[2].startswith("_"):
            continue
        try:
            exported = getattr(importlib.import_module(module.name), "__all__", None)
        except ImportError:
            continue
        if exported is not None:
            names[module.name] = sorted(exported)
    return {module: dict.fromkeys(exported, "exported") for module, exported in names.items()}


def messages():
    found = {}
    for path in sorted(Path(crazysim.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            match raised(node) or node:
                case (error, text) if error.endswith("Error"):
                    found[text] = found.get(text, 0) + 1
                case ast.Call(func=kind, args=[text, *_]) if ast.unparse(kind).endswith(("Error", "Warning", "warn")):
                    found.setdefault(ast.unparse(text), 0)
    return {"messages": found}


PARTS = {"flights": flights, "environments": environments, "public names": public_names, "messages": messages}


def write(path, parts):
    path.write_text(json.dumps({part: PARTS[part]() for part in parts}, indent=0))


def compare(before, after):
    n = 0
    for part in before:
        for name in sorted(before[part] | after[part]):
            old, new = before[part].get(name, {}), after[part].get(name, {})
            for key in sorted(old | new):
                if old.get(key) != new.get(key):
                    n += 1
                    print(f"{part}: {name}: {key}: {old.get(key, 'absent')} -> {new.get(key, 'absent')}")
    print(f"{n} differences")
    return n


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    writer = commands.add_parser("write")
    writer.add_argument("file", type=Path)
    writer.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    comparer = commands.add_parser("compare")
    comparer.add_argument("files", type=Path, nargs=2)
    options = parser.parse_args()
    if options.command == "write":
        write(options.file, options.parts)
    else:
        raise SystemExit(compare(*[json.loads(path.read_text()) for path in options.files]) > 0)
