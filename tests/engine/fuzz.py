"""Differential fuzzer: random programs must give the same results on every engine as on ``plain``.

    python tests/engine/fuzz.py --programs 20000 --seed 1
    python tests/engine/fuzz.py --programs 5000 --seed 1 --device gpu

Programs (``programs``) are drawn at random. Each becomes a stage of one drone or of one world, and many stages make a
step, so that compilers are called once for all of them. Every value of every program is written to a record and
compared. The inputs contain zeros of both signs, ties, huge and tiny numbers, infinities and NaN.

Integers, bools and moved numbers must be equal; ``rounding`` defines which differences rounding explains. As a
difference grows in later lines, a value is compared with the result of JAX for the operands that the engine computed.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import functools
import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

if __name__ == "__main__":  # the environment must be set before JAX is imported
    sys.path.insert(0, str(Path(__file__).parents[1]))
    import compiling

    os.environ.update(compiling.environment(os.environ))
    os.environ["XLA_FLAGS"] += " --xla_disable_hlo_passes=algsimp"  # it replaces NaN times False by zero
    os.environ["CXXFLAGS"] = f"{os.environ.get('CXXFLAGS', '')} -O0"

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from programs import Program, draw_program, evaluate, prune_program
from rounding import allow_gpu_results, are_within_rounding, is_close, keeps_sign_of_zero

from crazysim import Sim
from crazysim.engine import Step
from crazysim.engine.backends import fused
from crazysim.engine.backends.source import require_block_source
from crazysim.engine.errors import UnsupportedError
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.pytree import PyTree, leaf
from crazysim.engine.stage import Stage, as_stages, stage

N_WORLDS, N_DRONES = 36, 2
COMPARED_ENGINES = ("lanes", "interpret", "fused")


class Inputs(PyTree):
    numbers: dict = leaf("drone", 0)
    """Scalars. ()"""
    vectors: dict = leaf("drone", 1)
    """Vectors. (n,)"""
    matrices: dict = leaf("drone", 2)
    """Matrices. (n, m)"""


class Results(PyTree):
    """Values of the programs, by the name of the stage with the suffix ``f`` (floats) or ``o`` (other types)."""

    drone: dict = leaf("drone", 1)
    """Values from stages of one drone. (n,)"""
    world: dict = leaf("world", 1)
    """Values from stages of one world. (n,)"""


SHAPES = {"f": [(), (3,), (4,), (2, 3), (3, 3)], "i": [(), (3,), (2, 3)], "u": [(), (3,)], "b": [(), (3,)]}
DTYPES = {"f": np.float32, "i": np.int32, "u": np.uint32, "b": np.bool_}
SPECIAL_NUMBERS = np.float32(
    [0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 2.0, np.nan, np.inf, -np.inf, 1e-3, 1e30, -1e30, 1e-30, 8e37, 89.0, -104.0,
     8388609.0, -2147483648.0, 4294967296.0, 1.5, -2.5, 1.1754944e-38, 1e5, 0.99999994]
)  # fmt: skip


def draw_inputs(rng: np.random.Generator) -> Inputs:
    fields: list[dict] = [{}, {}, {}]
    for letter, shapes in SHAPES.items():
        for shape in shapes:
            size = (N_WORLDS, N_DRONES, *shape)
            if letter == "f":
                options = [rng.uniform(-3, 3, size), rng.integers(-4, 5, size) / 2, rng.choice(SPECIAL_NUMBERS, size)]
            elif letter == "b":
                options = [rng.integers(0, 2, size)] * 3
            else:
                low, extremes = (
                    (0, [0, 1, 31, 32, 2**32 - 1, 2**31]) if letter == "u" else (-3, [-(2**31), 2**31 - 1, -1, 0, 33])
                )
                options = [rng.integers(low, 9, size), rng.integers(low, 3, size), rng.choice(np.array(extremes), size)]
            third = np.arange(N_WORLDS) * 3 // N_WORLDS
            x = np.choose(third.reshape(-1, *([1] * (len(size) - 1))), options)
            fields[len(shape)][letter + "".join(map(str, shape))] = jnp.asarray(x.astype(DTYPES[letter]))
    return Inputs(*fields)


def inputs_by_name(g: Inputs) -> dict:
    """Return all inputs by name: the letter of the type and the shape, such as ``f23``."""
    return {**g.numbers, **g.vectors, **g.matrices}


def input_shapes(scope: str) -> dict[str, jax.ShapeDtypeStruct]:
    batch_shape = () if scope == "drone" else (N_DRONES,)
    return {
        letter + "".join(map(str, s)): jax.ShapeDtypeStruct((*batch_shape, *s), DTYPES[letter])
        for letter, shapes in SHAPES.items()
        for s in shapes
    }


@dataclasses.dataclass(frozen=True)
class Case:
    program: Program
    scope: str

    @functools.cached_property
    def avals(self) -> list[jax.ShapeDtypeStruct]:
        return jax.eval_shape(self.program.values, input_shapes(self.scope))

    def stage(self, name: str) -> Stage:
        def write(data):
            results = data.plugins["results"]
            floats, others = pack_values(
                self.program.values(inputs_by_name(data.plugins["inputs"])), len(self.program.inputs)
            )
            new = getattr(results, self.scope) | {f"{name}f": floats, f"{name}o": others}
            return data.replace(plugins=data.plugins | {"results": results.replace(**{self.scope: new})})

        return Stage(write, self.scope, name=name)

    def empty_slots(self, name: str) -> dict:
        results = self.avals[len(self.program.inputs) :]
        n_floats = sum(aval.size for aval in results if jnp.issubdtype(aval.dtype, jnp.floating))
        n_others = sum(aval.size for aval in results) - n_floats
        batch = (N_WORLDS, N_DRONES if self.scope == "drone" else 1)
        return {
            f"{name}f": np.zeros((*batch, n_floats), np.float32),
            f"{name}o": np.zeros((*batch, n_others), np.int32),
        }

    @functools.cached_property
    def signed(self) -> list[bool]:
        n = len(self.program.inputs)
        lines = enumerate(self.program.lines)
        return [keeps_sign_of_zero(functools.partial(_apply_to_values, line), self.avals[: n + j]) for j, line in lines]

    def unpack_values(self, floats: np.ndarray, others: np.ndarray) -> list[np.ndarray]:
        values, offsets = [], [0, 0]
        for aval in self.avals[len(self.program.inputs) :]:
            k = 0 if jnp.issubdtype(aval.dtype, jnp.floating) else 1
            part = (floats, others)[k][..., offsets[k] : offsets[k] + aval.size]
            offsets[k] += aval.size
            part = part.view(np.uint32) if aval.dtype == np.uint32 else part
            values.append(part.reshape(-1, *aval.shape).astype(aval.dtype))
        return values


def pack_values(values: Sequence, n_inputs: int) -> tuple:
    floats, others = [jnp.zeros(0, np.float32)], [jnp.zeros(0, np.int32)]
    for x in values[n_inputs:]:
        x = jnp.ravel(x)
        if jnp.issubdtype(x.dtype, jnp.floating):
            floats.append(x.astype(np.float32))
        else:
            others.append(lax.bitcast_convert_type(x, np.int32) if x.dtype == np.uint32 else x.astype(np.int32))
    return jnp.concatenate(floats), jnp.concatenate(others)


@stage("drone")
def reverse_vectors(data):
    """Reverse the vectors, so that they change at every step, and engines do not hoist results."""
    inputs = data.plugins["inputs"]
    vectors = {name: x[::-1] for name, x in inputs.vectors.items()}
    return data.replace(plugins=data.plugins | {"inputs": inputs.replace(vectors=vectors)})


@dataclasses.dataclass
class Finding:
    """A program for which an engine returns a wrong result."""

    case: Case
    engine: str
    description: str

    def __str__(self) -> str:
        return f"--- {self.engine}, one {self.case.scope}: {self.description}\n{self.case.program}"


class Fuzzer:
    """Runner of programs on all engines, which counts the outcomes."""

    def __init__(self, seed: int, engines: Sequence[str] = COMPARED_ENGINES, device: str = "cpu"):
        self.platform = device
        self.engines = tuple(e for e in engines if e != "fused" or fused.unavailable_reason(device) is None)
        self.rng = np.random.default_rng(seed)
        sim = Sim(n_worlds=N_WORLDS, n_drones=N_DRONES, control="rotor_vel", device=device)
        self.device, self.data = sim.device, sim.data
        self.inputs = jax.device_put(draw_inputs(self.rng), sim.device)
        self.counts: collections.Counter[str] = collections.Counter()
        self.refused: collections.Counter[str] = collections.Counter()

    def draw(self, n: int) -> list[Case]:
        cases = []
        for _ in range(n):
            scope = "drone" if self.rng.random() < 0.8 else "world"
            cases.append(Case(draw_program(self.rng, input_shapes(scope), int(self.rng.integers(1, 5))), scope))
        return cases

    def check(self, cases: Sequence[Case]) -> Iterator[Finding]:
        self.counts["programs"] += len(cases)
        yield from self._check(list(cases))

    def _check(self, cases: list[Case]) -> Iterator[Finding]:
        if not cases:
            return
        data, stages = self._build_stages(cases)
        try:
            program = lower_stages(as_stages(stages), data)
        except Exception as error:
            if len(cases) == 1 and self._refused_by_jax(cases):
                self.counts["refused by JAX"] += 1
            elif len(cases) == 1:
                yield Finding(cases[0], "lowering", f"{type(error).__name__}: {error}")
            else:
                yield from self._check(cases[: len(cases) // 2])
                yield from self._check(cases[len(cases) // 2 :])
            return
        refused = {unfused.name: unfused.error.reason for unfused in program.unfused_stages}
        if refused:
            self.counts["refused"] += len(refused)
            self.refused.update(refused.values())
            yield from self._check([case for k, case in enumerate(cases) if f"p{k}" not in refused])
            return
        if "fused" in self.engines:
            try:
                for segment in program.fused_segments:
                    require_block_source(segment.block)
            except UnsupportedError as error:
                (case_without_source,) = [case for k, case in enumerate(cases) if f"p{k}" == error.stage]
                self.counts["without source"] += 1
                self.refused[error.reason] += 1
                yield from self._check([case for case in cases if case is not case_without_source])
                yield from self._compare([case_without_source], tuple(e for e in self.engines if e != "fused"))
                return
        yield from self._compare(cases, self.engines)

    def _build_stages(self, cases: Sequence[Case]) -> tuple[Any, dict[str, Stage]]:
        stages = {f"p{k}": case.stage(f"p{k}") for k, case in enumerate(cases)} | {"reverse_vectors": reverse_vectors}
        slots: dict[str, dict] = {"drone": {}, "world": {}}
        for k, case in enumerate(cases):
            slots[case.scope] |= case.empty_slots(f"p{k}")
        plugins = {"inputs": self.inputs, "results": Results(**slots)}
        return self.data.replace(plugins=plugins), stages

    def run(self, cases: Sequence[Case], engine: str) -> list[list[np.ndarray]]:
        data, stages = self._build_stages(cases)
        results = Step(stages, engine, self.platform, device=self.device)(data).plugins["results"]
        slots = {k: np.asarray(x) for k, x in {**results.drone, **results.world}.items()}
        return [case.unpack_values(slots[f"p{k}f"], slots[f"p{k}o"]) for k, case in enumerate(cases)]

    def _refused_by_jax(self, cases: Sequence[Case]) -> bool:
        """Return True if ``plain`` fails too, so that there is nothing to compare with."""
        try:
            self.run(cases, "plain")
        except Exception:
            return True
        return False

    def _compare(self, cases: Sequence[Case], engines: Sequence[str]) -> Iterator[Finding]:
        results: dict[str, list[list[np.ndarray]]] = {}
        for engine in ("plain", *engines):
            try:
                start_time = time.perf_counter()
                results[engine] = self.run(cases, engine)
                self.counts[f"ms {engine}"] += int(1e3 * (time.perf_counter() - start_time))
            except Exception as error:
                if len(cases) == 1 and engine == "plain":
                    self.counts["refused by JAX"] += 1
                elif len(cases) == 1:
                    yield Finding(cases[0], engine, f"{type(error).__name__}: {str(error)[:2000]}")
                else:
                    half = len(cases) // 2
                    yield from self._compare(cases[:half], engines)
                    yield from self._compare(cases[half:], engines)
                return
        for k, case in enumerate(cases):
            for engine in engines:
                self.counts[f"compared on {engine}"] += 1
                finding = self._first_difference(case, engine, results["plain"][k], results[engine][k])
                if finding is None:
                    continue
                yield finding
                break

    def _first_difference(self, case: Case, engine: str, plain: list, other_results: list) -> Finding | None:
        n = len(case.program.inputs)
        inputs = [self._lanes(case.scope, name) for name in case.program.inputs]
        for j, (a, b) in enumerate(zip(plain, other_results, strict=True)):
            line_fn = functools.partial(_apply_to_values, case.program.lines[j])
            signed = case.signed[j]
            bad = ~is_close(a, b, signed)
            lanes = np.flatnonzero(bad.reshape(len(a), -1).any(1))
            # A compiler may compute an operand once more and round it differently, so the inputs are tried as well.
            value_fn = functools.partial(_apply_to_inputs, case.program, n + j)
            for fn, operands in ((line_fn, [*inputs, *other_results[:j]]), (value_fn, inputs)):
                if len(lanes):
                    self.counts["examined for rounding"] += 1
                    lanes = lanes[~are_within_rounding(fn, [x[lanes] for x in operands], b[lanes], signed)]
            if len(lanes):
                values = {f"v{k}": x[lanes[0]] for k, x in enumerate([*inputs, *other_results[:j]])}
                text = case.program.lines[j]
                inputs_text = ", ".join(
                    f"{name}={_text(x)}" for name, x in values.items() if re.search(rf"\b{name}\b", text)
                )
                description = f"{text} with {inputs_text}: plain {_text(a[lanes[0]])}, {engine} {_text(b[lanes[0]])}"
                return Finding(
                    Case(prune_program(case.program, n + j), case.scope), engine, f"{description} ({len(lanes)} lanes)"
                )
        return None

    def _lanes(self, scope: str, name: str) -> np.ndarray:
        x = np.asarray(inputs_by_name(self.inputs)[name])
        return x.reshape(-1, *x.shape[2:]) if scope == "drone" else x


def _apply_to_values(line: str, *values: Any):
    return evaluate(line, values)


def _apply_to_inputs(program: Program, k: int, *inputs: Any):
    return program.values(dict(zip(program.inputs, inputs, strict=True)))[k]


def _text(x) -> str:
    x = np.asarray(x)
    return np.array2string(x.astype(np.float32) if x.dtype.kind == "V" else x, separator=",", precision=9).replace(
        "\n", ""
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Compare the engines on random programs.",
        epilog="5,000 programs on a GPU: python tests/engine/fuzz.py --programs 5000 --seed 1 --device gpu. Where a "
        "command may not take that long, run parts with --programs 1000 and seeds 1 to 5. It exits with 1 if there is "
        "a finding.",
    )
    parser.add_argument("--programs", type=int, default=1000, help="number of programs")
    parser.add_argument("--seed", type=int, default=0, help="seed of programs and inputs")
    parser.add_argument("--batch", type=int, default=40, help="programs that are compiled together")
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu", help="platform that runs the programs")
    args = parser.parse_args()
    fuzzer, start_time, n_findings = Fuzzer(args.seed, device=args.device), time.perf_counter(), 0
    jax.config.update("jax_default_device", fuzzer.device)  # for the computations that explain a difference
    if args.device == "gpu":
        allow_gpu_results()
    print(f"# {', '.join(fuzzer.engines)} against plain on {fuzzer.device.device_kind}", flush=True)
    for n_done in range(0, args.programs, args.batch):
        for finding in fuzzer.check(fuzzer.draw(min(args.batch, args.programs - n_done))):
            n_findings += 1
            print(finding, flush=True)
        print(
            f"# {fuzzer.counts['programs']} programs, {n_findings} findings, {time.perf_counter() - start_time:.0f} s",
            flush=True,
        )
        jax.clear_caches()
    for reason, n in fuzzer.refused.most_common():
        print(f"# refused {n}: {reason}")
    print(f"# {args.programs} programs, seed {args.seed}, {n_findings} findings; {dict(fuzzer.counts)}")
    sys.exit(bool(n_findings))


if __name__ == "__main__":
    main()
