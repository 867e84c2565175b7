"""Plans: the engine that steps data of one structure, the compiled step, and the reason why no faster engine runs.

Planning finds what an engine cannot run before the first step. There are three cases:

- A documented limit, which ``explain`` names. A stage without a scope splits the step: it runs unfused, between kernels
  of the stages before and after it. On a machine without a compiler, ``lanes`` runs. For data on several devices,
  ``plain`` runs if a stage is unfused, or if the data is not distributed by a mesh.
- Something unsupported (``UnsupportedError``). A stage splits the step too if one of its primitives has no rule, or has
  a parameter that a newer JAX has renamed; with a mesh, ``plain`` runs instead. If a kernel cannot be written, or its
  compiler refuses it, ``lanes`` runs. There is one ``EngineWarning``; with ``strict``, a
  ``ConfigError`` is raised instead. With ``engine="fused"``, a missing compiler or kernel is a ``ConfigError``.
- Any other exception (except ``ConfigError`` and ``MemoryError``, which are raised as they are). It is a bug in a stage
  or in the engine. With ``strict``, or with an engine chosen by name, it is raised. Otherwise ``plain`` is tried. If
  ``plain`` fails too, the bug is in the stage, and the error of ``plain`` is raised. If not, ``plain`` runs, with a
  warning that asks for a report.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import jax
from jax import Array
from jax.sharding import PartitionSpec

from crazysim.engine.backends import Build, Run, fused, interpret, kernel, lanes, plain
from crazysim.engine.errors import LimitError, UnsupportedError, report_unsupported
from crazysim.engine.host_call import HostCall, is_host_call_possible
from crazysim.engine.ir.program import Leaf, Program, Zeros
from crazysim.engine.lowering.groups import Group, independent_groups
from crazysim.engine.lowering.relative import adapt_to_data_leaves
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.lowering.tracing import Tracer
from crazysim.engine.optimise import optimise
from crazysim.engine.passes.layout import PackedRows, packed_rows
from crazysim.engine.pytree import leaf_indices, n_batch_axes, replace_leaves, scopes
from crazysim.engine.record import Record, Roles
from crazysim.engine.sharding import Location
from crazysim.engine.stage import Stage
from crazysim.errors import ConfigError

ENGINES = ("auto", "plain", "lanes", "fused", "interpret")
"""Values of ``engine=``. ``interpret`` runs programs in NumPy: it is slow, has no derivatives, and serves debugging."""

BACKENDS: dict[str, Build] = {"lanes": lanes.build, "fused": fused.build, "interpret": interpret.build}
"""Backends of the engines that run programs, by the name of the engine."""


SeparateLeaves = frozenset[int] | None
"""Leaves that stay separate arrays when the other written leaves are stored as rows of a few arrays. With an empty set
every written leaf is stored as rows, except for random keys. With None no leaf is stored as rows."""


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """Engine and compiled step for data of one structure."""

    engine: str
    """Engine that runs."""
    engine_reason: str
    """Reason why no faster engine was chosen; empty for ``fused``."""
    programs: tuple[Program, ...]
    """Programs that the engine runs, one for each group of populations that depend on each other. The group of the
    main population comes first. Empty for ``plain``."""
    location: Location
    """Devices that the step runs on."""
    inputs: tuple[int, ...]
    """Indices of the leaves that are passed to the compiled step. The leaves of the data come first, followed by the
    leaves that compiler passes add."""
    packed: tuple[int, ...]
    """Indices of the shared leaves that are passed as one concatenated leaf, the first after the leaves of the data."""
    rows: tuple[PackedRows, ...]
    """Leaves that hold other leaves as rows; they follow the packed leaf. Empty if no leaf is stored as rows."""
    written_leaves: tuple[int, ...]
    """Indices of the leaves that the compiled step returns."""
    roles: Roles
    """Leaves with a role in the step."""
    leaf_indices: Any
    """Record with the index of every leaf in place of the leaf, as ``leaf_indices`` returns it."""
    traced_count_step: Callable[..., Any]
    """Compiled step that takes the number of steps as an array."""
    static_count_step: Callable[..., Any]
    """Compiled step that takes the number of steps as a Python number, and can be differentiated in reverse mode."""
    numpy_step: Callable[..., Any] | None = None
    """Step in NumPy for arguments that are not traced; None unless ``interpret`` runs the whole step without a mesh."""
    host_call: HostCall | None = None
    """Step without XLA, for a simulation that holds its data between calls; None if it is not possible."""

    @property
    def program(self) -> Program | None:
        """Program of the drones; None for ``plain``."""
        return self.programs[0] if self.programs else None


class Planner(NamedTuple):
    """Planner of steps. Its fields are the inputs of planning other than the data."""

    stages: Sequence[Stage]
    """Stages of the step, in order."""
    engine: str
    """Engine that the user chose, one of ``ENGINES``."""
    strict: bool
    """Whether to raise an error where otherwise a slower engine would run, with a warning."""
    location: Location
    """Devices that hold the data."""
    reported: set[str]
    """Texts of the warnings so far, for data of any structure; no warning is repeated."""
    zeros: Zeros
    """Elements of shared parameters that are zero."""
    separate: SeparateLeaves
    """Leaves that stay separate arrays. If one kernel runs the whole step, all other leaves that it writes are stored
    as rows. None to store no leaf as rows."""

    def plan(self, data: Record, trace: Callable[[Plan], None]) -> Plan:
        """Return the plan that steps data of one structure.

        Args:
            data: The data, or its shapes and types.
            trace: Function that traces the compiled step of a plan, as its first call would, so that planning raises
                the errors of the trace.
        """
        if self.engine == "plain":
            return self._plan_plain(data, "it was chosen")
        try:
            plan, problems = self._plan_programs(data)
            if plan.numpy_step is None:
                trace(plan)
        except (ConfigError, MemoryError):
            raise
        except Exception as error:
            if self.strict or self.engine != "auto":
                raise
            failure = error
        else:
            self._report(problems)
            return plan
        reason = f"the engine failed with {type(failure).__name__}"
        plan = self._plan_plain(data, reason)  # raises an error of the stage itself
        self._report(
            [
                f"{reason}: {failure}{self._failing_stage(data)}, so the step runs on 'plain', which is slower. This "
                "is a bug of crazysim: please report it, with the files that CRAZYSIM_DUMP=folder writes; strict=True "
                "raises the error"
            ]
        )
        return plan

    def _plan_programs(self, data: Record) -> tuple[Plan, list[str]]:
        # If programs cannot step data on several devices, the plan runs ``plain``.
        distribution_limit = self._distribution_limit(data)
        if distribution_limit:
            return self._plan_plain(data, distribution_limit), []
        leaf_scopes = jax.tree.leaves(scopes(data))
        # ``zeros`` may be older than ``data``: a parameter that was shared may have one value per drone in ``data``.
        zeros = tuple([(i, indices) for i, indices in self.zeros if leaf_scopes[i] == "shared"])
        tracer = Tracer()
        # One program for each group of populations.
        groups = independent_groups(self.stages, data, tracer)
        lowered_programs = [
            lower_stages(g.stages, data, zeros, check=True, population=g.population, tracer=tracer) for g in groups
        ]
        has_one_kernel = self._has_kernels and [x.fused for x in lowered_programs] == [True]
        select_rows = None
        if (separate := self.separate) is not None and has_one_kernel:
            select_rows = lambda written_leaves: [i for i in written_leaves if i not in separate]  # noqa: E731
        programs = tuple([optimise(program, select_rows, pack=k == 0) for k, program in enumerate(lowered_programs)])
        unfused = [stage for program in programs for stage in program.unfused_stages]
        problems = [f"stage {s.explanation}" for s in unfused if not isinstance(s.error, LimitError)]
        if self.location.is_distributed and unfused:
            distribution_limit = f"with a mesh every stage must be fused, and {unfused[0].explanation}"
            return self._plan_plain(data, distribution_limit), problems
        # Kernels if possible, else lanes or the chosen engine.
        engine, reason, runs = self.engine, "it was chosen", []
        if engine in ("auto", "fused"):
            engine, reason = "lanes", fused.unavailable_reason(self.location.platform) or ""
            if not reason:
                try:
                    unpacked_program = None if select_rows is None else optimise(lowered_programs[0])
                    runs, engine = [fused.build(x, self.location, unpacked_program) for x in programs], "fused"
                except UnsupportedError as error:
                    error = self._error_of_stage(error, data)
                    reason = str(error)
                    problems.append(self._no_kernel_message(error))
            if reason and self.engine == "fused":
                raise ConfigError(f"engine 'fused' cannot run this pipeline: {reason}. Use 'lanes' or 'auto'.")
        runs = runs or [BACKENDS[engine](program, self.location) for program in programs]
        # One function that runs all programs.
        inputs = {i for program in programs for i in _input_leaves(program)}
        run, written_leaves = _join_runs(groups, programs, runs)
        plan = self._make_plan(engine, reason, data, programs, inputs, written_leaves, run, len(programs[0].leaves))
        # On a CPU without a mesh, kernels can be called without XLA.
        kernels = [run.kernels for run in runs if isinstance(run, fused.FusedRun) and run.kernels is not None]
        is_on_host = self.location.platform == "cpu" and self.location.mesh is None and len(kernels) == len(programs)
        if is_on_host and is_host_call_possible(kernels):
            owned_by_group = [group.owned_leaves for group in groups]
            host_call = HostCall(kernels, owned_by_group, jax.tree.leaves(data), plan.roles.nonfinite)
            plan = dataclasses.replace(plan, host_call=host_call)
        return plan, problems

    def _distribution_limit(self, data: Record) -> str:
        if not self.location.is_distributed:
            return ""
        if self.location.mesh is None:
            clock = jax.tree.leaves(data)[data.roles().clock]
            return f"the data is spread over devices by a {type(clock.sharding).__name__}, not over a mesh"
        stage = next((s for s in self.stages if s.scope == "batch"), None)
        if stage is None:
            return ""
        return f"a mesh needs stages of one drone or world; {stage.__name__!r}: {stage.unfused_reason}"

    def _plan_plain(self, data: Record, reason: str) -> Plan:
        run, written_leaves = plain.build(self.stages, data)
        all_leaves = tuple(range(len(jax.tree.leaves(data))))
        # XLA itself distributes the computation of ``plain`` over the devices.
        return self._make_plan("plain", reason, data, (), all_leaves, tuple(written_leaves), run, len(all_leaves))

    @property
    def _has_kernels(self) -> bool:
        return self.engine in ("auto", "fused") and fused.unavailable_reason(self.location.platform) is None

    def _make_plan(
        self,
        engine: str,
        reason: str,
        data: Record,
        programs: tuple[Program, ...],
        read_leaves: Collection[int],
        written_leaves: tuple[int, ...],
        run_programs: Run,
        n_leaves: int,
    ) -> Plan:
        roles, inputs = data.roles(), tuple(sorted(read_leaves))
        # If a stage writes the flags itself, no check is added.
        has_check = (
            any(p.check_segment is not None for p in programs) if programs else roles.nonfinite not in written_leaves
        )
        flag_leaves = (roles.nonfinite,) if has_check else ()
        written_leaves = (*written_leaves, *flag_leaves)
        drone_program = programs[0] if programs else None
        packed = drone_program.packed if drone_program is not None else ()
        rows = tuple(packed_rows(drone_program)) if drone_program is not None else ()

        formats = _leaf_formats(data, programs[0].leaves if programs else ())

        def advance(values: list[Any], n_steps: int | Array) -> list[Any]:
            leaves = replace_leaves([None] * n_leaves, inputs, values)
            outputs, flagged = run_programs(leaves, n_steps)
            return [*outputs, flagged] if flag_leaves else list(outputs)

        if programs and self.location.mesh is not None:
            advance = self._shard_over_mesh(advance, data, programs[0].leaves, inputs, written_leaves)
        advance = _check_inputs(advance, [formats[i] for i in inputs])
        plan = Plan(
            engine,
            reason,
            programs,
            self.location,
            inputs,
            packed,
            rows,
            written_leaves,
            roles,
            leaf_indices(data),
            *_jit_steps(advance),
        )
        in_numpy = engine == "interpret" and self.location.mesh is None and all(p.fused for p in programs)
        return dataclasses.replace(plan, numpy_step=_put_results_on_device(advance)) if in_numpy else plan

    def _shard_over_mesh(
        self,
        advance: Callable[..., Any],
        data: Record,
        program_leaves: Sequence[Leaf],
        inputs: Sequence[int],
        outputs: Sequence[int],
    ) -> Callable[..., Any]:
        over_worlds, shared = PartitionSpec(self.location.axis), PartitionSpec()
        specs = [over_worlds if n_batch_axes(scope) == 2 else shared for scope in jax.tree.leaves(scopes(data))]
        added_leaves = program_leaves[len(specs) :]  # the packed array, and rows, in which worlds are the last axis
        specs += [PartitionSpec(None, self.location.axis) if leaf.row_leaves else shared for leaf in added_leaves]

        def sharded_step(values: list[Any], n_steps: int | Array) -> list[Any]:
            count = [] if isinstance(n_steps, int) else [n_steps]
            local_step = jax.shard_map(
                lambda values, *count: advance(values, *(count or [n_steps])),
                mesh=self.location.mesh,
                in_specs=([specs[i] for i in inputs], *[shared for _ in count]),
                out_specs=[specs[i] for i in outputs],
                check_vma=False,
            )
            return local_step(values, *count)

        return sharded_step

    def _report(self, problems: list[str]) -> None:
        report_unsupported(problems, self.strict, self.reported, "Write the stage with supported operations")

    def _no_kernel_message(self, error: UnsupportedError) -> str:
        if error.stage:
            return f"stage {error.stage!r} has no kernel: {error.reason}"
        return f"the kernel of the stages {', '.join(s.__name__ for s in self.stages)} cannot be built: {error.reason}"

    def _error_of_stage(self, error: UnsupportedError, data: Record) -> UnsupportedError:
        # If there is none, return the error of the kernel of all stages.
        for stage in self.stages:
            try:
                kernel.require_source(optimise(lower_stages([stage], data)))
            except UnsupportedError as stage_error:
                return stage_error
        return error

    def _failing_stage(self, data: Record) -> str:
        for stage in self.stages:
            try:
                optimise(lower_stages([stage], data))
            except Exception:
                return f" in stage {stage.__name__!r}"
        return ""


def _leaf_formats(data: Record, program_leaves: Sequence[Leaf]) -> list[tuple[str, tuple[int, ...], Any]]:
    paths = jax.tree_util.tree_leaves_with_path(data)
    formats = [(f"data{jax.tree_util.keystr(path)}", x.shape, x.dtype) for path, x in paths]
    return formats + [(leaf.name, leaf.shape, leaf.dtype) for leaf in program_leaves[len(formats) :]]


def _device_dtype(x: Any) -> Any:
    return jax.dtypes.canonicalize_dtype(getattr(x, "dtype", x), allow_extended_dtype=True)


def _check_inputs(
    advance: Callable[..., Any], formats: Sequence[tuple[str, tuple[int, ...], Any]]
) -> Callable[..., Any]:
    # A kernel reads memory as its program says, whatever the arrays are. The comparison takes place in tracing.
    def checked_advance(values: list[Any], n_steps: int | Array) -> list[Any]:
        for x, (name, shape, dtype) in zip(values, formats, strict=True):
            if x.shape != shape or _device_dtype(x) != _device_dtype(dtype):
                raise ConfigError(
                    f"expected {name} of shape {shape} and type {dtype} in flat data, got {x.shape} and {x.dtype}. Use "
                    f"the result of flatten or advance as it is."
                )
        return advance(values, n_steps)

    return checked_advance


def _jit_steps(advance: Callable[..., Any]) -> tuple[Callable[..., Any], Callable[..., Any]]:
    return jax.jit(advance), jax.jit(lambda values, n: advance(values, n), static_argnums=1)


def _put_results_on_device(advance: Callable[..., Any]) -> Callable[..., Any]:
    def step(values: list[Any], n_steps: int | Array) -> list[Any]:
        committed_array = next((x for x in values if getattr(x, "committed", False)), None)
        device = None if committed_array is None else next(iter(committed_array.devices()))
        return jax.device_put(advance(values, n_steps), device)

    return step


def _join_runs(
    groups: Sequence[Group], programs: Sequence[Program], runs: Sequence[Run]
) -> tuple[Run, tuple[int, ...]]:
    runs = [adapt_to_data_leaves(program, run) for program, run in zip(programs, runs, strict=True)]
    if len(runs) == 1:
        return runs[0], tuple(programs[0].written_leaves)
    owned_by_group = [group.owned_leaves for group in groups]
    written_leaves = sorted({i for program in programs for i in program.written_leaves})

    def run_all(leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Array]:
        results: dict[int, Any] = {}
        flags = []
        for program, owned_leaves, run in zip(programs, owned_by_group, runs, strict=True):
            outputs, flagged = run(leaves[: len(program.leaves)], n_steps)
            results |= {
                i: x
                for i, x in zip(program.written_leaves, outputs, strict=True)
                if owned_leaves is None or i in owned_leaves
            }
            flags.append(flagged)
        return [results[i] for i in written_leaves], functools.reduce(operator.or_, flags)

    return run_all, tuple(written_leaves)


def _input_leaves(program: Program) -> list[int]:
    # If unfused stages split the step, all leaves that are written or checked are passed too.
    if program.fused:
        return kernel.input_leaves(program)
    checked = [leaf for leaf, _ in program.check_segment.reads] if program.check_segment is not None else []
    drone_leaf = next(i for i, leaf in enumerate(program.leaves) if leaf.scope == "drone")
    return [*program.read_leaves, *program.written_leaves, *checked, drone_leaf]
