"""All use of JAX beyond its documented, stable interface; new releases of JAX should require changes here only.

Most names have a test in ``tests/engine/test_jaxcompat.py``, which continuous integration runs on the oldest and the
newest JAX that are supported; the other names are tested with the code that uses them. This list states how each use
would be replaced if a release removed it, and whether the replacement is implemented:

- **The constructor of Jaxpr** (``select_inputs``, ``constants_to_inputs``): the function is traced again by
  ``jax.make_jaxpr``. Implemented here.
- **batched_device_put** (``put_host_array``): ``jax.device_put``, ten times slower for a command. Implemented here, and
  used where jaxlib lacks the function.
- **Donation on the host**: steps without XLA (``engine/host_call.py``) rely on JAX to copy an array that is donated
  while NumPy has a view of it. The compiled step replaces them, and ``jit_donating`` donates nothing. Implemented here.
- **The custom call __gpu$xla.gpu.ptx**, by which XLA launches kernels on a GPU (``engine/backends/cuda.py``): a handler
  of XLA's foreign function interface that launches them. Implemented in ``engine/backends/ffi_handlers.py``.
- **Custom primitives** (``batched_primitive``, ``simple_primitive``, ``primitive_by_platform``, ``barrier``):
  ``jax.custom_batching.custom_vmap``, ``jax.custom_jvp`` and ``jax.lax.platform_dependent``, and a
  ``jax.lax.optimization_barrier`` for each array, which takes longer to trace. Not implemented.
- **Rules that read equations** (``Equation``, ``bind``, ``as_function``, ``expand_primitive``): no replacement. A stage
  with a primitive that has changed is run unfused.
- **Threefry's primitive** (``threefry2x32_p``): its rounds as operations on integers. Implemented in
  ``engine/backends/interpret.py``, for that engine only.
- **The compilation cache of one thread** (``compilation_cache``): without it, programs are only kept in the folder that
  JAX is configured with. It is used where these names are missing.
- **The files of the compilation cache** (``use_cache``): JAX's own, which it neither checks nor replaces. They are used
  where the name is missing.
- **The log level of XLA** (``set_xla_log_level``): the variable ``TF_CPP_MIN_LOG_LEVEL`` alone, which has no effect if
  JAX was imported before crazysim. It is used where jaxlib lacks the function.
- **The coordinator of several hosts** (``connected_hosts``): exchanges of arrays instead of its store of texts. Not
  implemented.
- **jax.experimental.multihost_utils** (``gather_from_hosts``, ``broadcast_from_first``): programs with replicated
  results. Not implemented.
- **backends_are_initialized** (``require_unforked_process``): a flag that the first call sets. Not implemented.
- **_cache_size** (``n_compilations``): a counter in the traced function. Not implemented.

``CRAZYSIM_JAX_FALLBACKS=1`` selects all fallbacks, to try them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jaxlib
import numpy as np
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jax.experimental import multihost_utils
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Primitive, jaxpr_as_fun
from jax.extend.random import threefry2x32_p, threefry_prng_impl
from jax.interpreters import ad, batching, mlir

from crazysim.errors import ConfigError, UnsupportedError

try:
    from jaxlib.xla_client import batched_device_put
except ImportError:
    batched_device_put = None  # type: ignore[assignment]

__all__ = [
    "DIGAMMA_AT_ZERO",
    "FALLBACKS",
    "ClosedJaxpr",
    "Equation",
    "Hosts",
    "Jaxpr",
    "JaxprEqn",
    "Literal",
    "Parameters",
    "add_vmap_rule",
    "as_function",
    "barrier",
    "batched_primitive",
    "bind",
    "bits_generator",
    "broadcast_from_first",
    "cache_folder",
    "close_jaxpr",
    "compilation_cache",
    "compute_capability",
    "connected_hosts",
    "constants_to_inputs",
    "custom_vmap",
    "equations",
    "expand_primitive",
    "ffi_include_folder",
    "fori_loop",
    "gather_from_hosts",
    "is_key",
    "is_stop_requested",
    "is_symbolic_zero",
    "jaxpr_as_fun",
    "jit_donating",
    "make_vmap_rule",
    "n_compilations",
    "primitive_by_platform",
    "put_host_array",
    "read_equation",
    "register_target",
    "require_unforked_process",
    "select_inputs",
    "set_xla_log_level",
    "threefry2x32_p",
    "threefry_prng_impl",
    "use_cache",
    "versions",
]

FALLBACKS = os.environ.get("CRAZYSIM_JAX_FALLBACKS") == "1"
"""Whether to use the replacements that are listed above, where they are implemented."""


# Jaxprs ---------------------------------------------------------------------------------------------------------


def close_jaxpr(jaxpr: Any) -> ClosedJaxpr:
    """Return a jaxpr in closed form; parameters of primitives hold either form."""
    return jaxpr if isinstance(jaxpr, ClosedJaxpr) else ClosedJaxpr(jaxpr, ())


def select_inputs(jaxpr: ClosedJaxpr, inputs: Sequence[int]) -> ClosedJaxpr:
    """Return a jaxpr that takes only some of its inputs; the other inputs must be unused.

    Args:
        inputs: Positions of the inputs to keep.
    """
    inner = jaxpr.jaxpr
    if FALLBACKS:
        zero_inputs = [_zeros(v.aval) for v in inner.invars]

        def fn(*args: Any) -> list[Any]:
            arg_by_index = dict(zip(inputs, args, strict=True))
            return jaxpr_as_fun(jaxpr)(*(arg_by_index.get(i, zeros) for i, zeros in enumerate(zero_inputs)))

        return _trace_function(fn, [inner.invars[i] for i in inputs])
    invars = [inner.invars[i] for i in inputs]
    return ClosedJaxpr(
        Jaxpr(inner.constvars, invars, inner.outvars, inner.eqns, inner.effects, inner.debug_info), jaxpr.consts
    )


def _trace_function(fn: Callable[..., Any], variables: Sequence[Any]) -> ClosedJaxpr:
    avals = [(v.aval, getattr(v.aval, "weak_type", False)) for v in variables]
    return jax.make_jaxpr(fn)(*(jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=is_weak) for x, is_weak in avals))


def _zeros(aval: Any) -> Any:
    if not is_key(aval):
        return np.zeros(aval.shape, aval.dtype)
    with jax.ensure_compile_time_eval():
        return jax.random.split(jax.random.key(0, impl=bits_generator(aval.dtype)), aval.shape)


def equations(jaxpr: ClosedJaxpr) -> Iterator[Any]:
    """Iterate over the equations of a jaxpr, including jaxprs among their parameters."""
    for eqn in jaxpr.jaxpr.eqns:
        yield eqn
        for value in eqn.params.values():
            for inner in value if isinstance(value, list | tuple) else [value]:
                if isinstance(inner, ClosedJaxpr | Jaxpr):
                    yield from equations(close_jaxpr(inner))


class Parameters(dict):
    """Parameters of a primitive; reading one that this JAX does not have raises ``UnsupportedError``."""

    def __init__(self, primitive: str, params: dict[str, Any]):
        super().__init__(params)
        self._primitive = primitive

    def __missing__(self, name: str) -> Any:
        raise UnsupportedError(
            f"it has no parameter {name!r} in JAX {jax.__version__}, only {', '.join(self) or 'none'}", self._primitive
        )


@dataclasses.dataclass(frozen=True)
class Equation:
    """Equation of a jaxpr; its parameters are checked when they are read."""

    primitive: Any
    """Primitive, with its ``name``."""
    invars: Sequence[Any]
    """Operands, variables or literals, with their ``aval``."""
    outvars: Sequence[Any]
    """Results."""
    params: Parameters
    """Parameters by name."""


@contextlib.contextmanager
def read_equation(eqn: Any) -> Iterator[Equation]:
    """Yield an equation for a rule, and report a parameter that JAX has renamed as unsupported.

    Any other error of the rule is passed on.

    Raises:
        UnsupportedError: If the rule reads a parameter, or an attribute of one, that this JAX does not have.
    """
    name = eqn.primitive.name
    try:
        yield Equation(eqn.primitive, eqn.invars, eqn.outvars, Parameters(name, eqn.params))
    except AttributeError as error:
        owner = next((k for k, v in eqn.params.items() if v is not None and v is error.obj), None)
        if owner is None:
            raise
        raise UnsupportedError(
            f"its parameter {owner!r} has no {error.name!r} in JAX {jax.__version__}", name
        ) from error


def batched_primitive(
    name: str, result_types: Callable[..., list[Any]], batching_rule: Callable[..., Any], refuse: Callable[..., Any]
) -> Primitive:
    """Return a primitive that ``vmap`` replaces by other operations.

    Args:
        result_types: Function from operands and parameters to the shapes and types of the results.
        batching_rule: Function of the axis of ``vmap`` (with ``name`` and ``size``), the operands, their batched
            dimensions, and the parameters. It returns the results and their batched dimensions.
        refuse: Function that raises an error; called if no ``vmap`` has replaced the primitive.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(refuse)
    primitive.def_abstract_eval(result_types)
    batching.fancy_primitive_batchers[primitive] = batching_rule
    mlir.register_lowering(primitive, refuse)
    return primitive


def simple_primitive(name: str, fn: Callable[..., list[Any]], batching_rule: Callable[..., Any]) -> Primitive:
    """Return a primitive for a function without a derivative, with a custom rule for ``vmap``.

    Args:
        fn: The function, from operands to a list of results.
        batching_rule: Function from operands and their batched dimensions to results and their batched dimensions.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(fn)
    primitive.def_abstract_eval(lambda *args: [jax.typeof(x) for x in jax.eval_shape(fn, *args)])
    batching.primitive_batchers[primitive] = batching_rule
    mlir.register_lowering(primitive, mlir.lower_fun(fn, multiple_results=True))
    return primitive


def primitive_by_platform(
    name: str,
    result_types: Callable[..., Sequence[Any]],
    functions: Mapping[str, Callable[..., Any]],
    *,
    differentiable_fn: Callable[..., Sequence[Any]] | None = None,
    transpose_rule: Callable[..., Sequence[Any]] | None = None,
    batching_rule: Callable[..., Sequence[Any]] | None = None,
) -> Primitive:
    """Return a primitive that is replaced, only when it is lowered, by the function of the target platform.

    All functions take operands as positional arguments, and parameters, which are hashable, as keywords.

    Args:
        result_types: Function that returns the shapes and types of the results.
        functions: Functions that return a list of results, by platform: ``"cpu"``, ``"cuda"``, ...; ``""`` for all
            other platforms.
        differentiable_fn: The same function, written so that JAX can differentiate it.
        transpose_rule: Rule for a primitive that is linear in all operands except for the first ``n_nonlinear``, a
            parameter: function of the nonlinear operands and the cotangents of all results, which returns the
            cotangents of the linear operands.
        batching_rule: Rule for ``vmap``: function of the primitive, the size of the mapped axis, the operands, and a
            list that is True for mapped operands. The first axis of mapped operands, and of all results, is the mapped
            one.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(lambda *args, **params: _compiled_primitive(primitive, **params)(*args))
    primitive.def_abstract_eval(lambda *args, **params: list(map(jax.typeof, result_types(*args, **params))))
    for platform, fn in functions.items():
        mlir.register_lowering(primitive, mlir.lower_fun(fn, multiple_results=True), platform=platform or None)
    if differentiable_fn is not None:
        ad.primitive_jvps[primitive] = functools.partial(_apply_derivative, differentiable_fn)
    if transpose_rule is not None:
        ad.primitive_transposes[primitive] = functools.partial(_apply_transpose, transpose_rule)
    if batching_rule is not None:
        batching.primitive_batchers[primitive] = functools.partial(_apply_batching, batching_rule, primitive)
    return primitive


def _apply_derivative(fn: Callable[..., Any], primals: Sequence[Any], tangents: Sequence[Any], **params: Any) -> Any:
    perturbed_indices = [i for i, t in enumerate(tangents) if not isinstance(t, ad.Zero)]

    def apply(*values: Any) -> Any:
        args = list(primals)
        for i, x in zip(perturbed_indices, values, strict=True):
            args[i] = x
        return list(fn(*args, **params))

    return jax.jvp(
        apply, tuple([primals[i] for i in perturbed_indices]), tuple([tangents[i] for i in perturbed_indices])
    )


def _apply_transpose(
    fn: Callable[..., Any], cotangents: Sequence[Any], *args: Any, n_nonlinear: int, **params: Any
) -> list[Any]:
    nonlinear, linear_args = args[:n_nonlinear], args[n_nonlinear:]
    results = fn(nonlinear, [ad.instantiate_zeros(x) for x in cotangents], n_nonlinear=n_nonlinear, **params)
    linear_cotangents = [
        x if ad.is_undefined_primal(arg) else None for x, arg in zip(results, linear_args, strict=True)
    ]
    return [*(None for _ in nonlinear), *linear_cotangents]


def _apply_batching(fn: Callable[..., Any], primitive: Primitive, args: Any, dims: Any, **params: Any) -> Any:
    is_batched = [d is not None for d in dims]
    moved_args = [jax.numpy.moveaxis(x, d, 0) if b else x for x, d, b in zip(args, dims, is_batched, strict=True)]
    n = next(x.shape[0] for x, b in zip(moved_args, is_batched, strict=True) if b)
    results = list(fn(primitive, n, moved_args, is_batched, **params))
    return results, [0] * len(results)


def make_vmap_rule(fn: Callable[..., Any]) -> Callable[..., Any]:
    """Return a rule for ``vmap`` that replaces a primitive by a function, mapped over the operands."""

    def rule(primitive: Primitive, n: int, args: Sequence[Any], is_batched: Sequence[bool], **params: Any) -> Any:
        del primitive, n
        return jax.vmap(functools.partial(fn, **params), tuple([0 if b else None for b in is_batched]))(*args)

    return rule


def barrier(values: Sequence[Any]) -> list[jax.Array]:
    """Compute values only once: ``jax.lax.optimization_barrier``, with derivatives that all versions of JAX reverse.

    JAX 0.12 cannot reverse its own barrier if only some of the tangents depend on what is differentiated.
    """
    return _barrier_p.bind(*values)


def _barrier_jvp(primals: Sequence[Any], tangents: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    moved = iter(barrier([t for t in tangents if not isinstance(t, ad.Zero)]))
    return barrier(primals), [t if isinstance(t, ad.Zero) else next(moved) for t in tangents]


def _barrier_transpose(cotangents: Sequence[Any], *args: Any) -> list[Any]:
    moved = iter(barrier([ct for ct in cotangents if not isinstance(ct, ad.Zero)]))
    results = [ct if isinstance(ct, ad.Zero) else next(moved) for ct in cotangents]
    return [ct if ad.is_undefined_primal(x) else None for ct, x in zip(results, args, strict=True)]


_barrier_p = Primitive("crazysim_barrier")
_barrier_p.multiple_results = True
_barrier_p.def_impl(lambda *args: jax.lax.optimization_barrier(list(args)))
_barrier_p.def_abstract_eval(lambda *avals: list(avals))
mlir.register_lowering(
    _barrier_p, mlir.lower_fun(lambda *args: jax.lax.optimization_barrier(list(args)), multiple_results=True)
)
ad.primitive_jvps[_barrier_p] = _barrier_jvp
ad.primitive_transposes[_barrier_p] = _barrier_transpose
batching.primitive_batchers[_barrier_p] = lambda args, dims: (barrier(args), dims)


@functools.lru_cache(maxsize=64)
def _compiled_primitive(primitive: Primitive, **params: Any) -> Callable[..., Any]:
    return jax.jit(functools.partial(primitive.bind, **params))


def constants_to_inputs(closed_jaxpr: ClosedJaxpr) -> ClosedJaxpr:
    """Return a jaxpr that takes its constants as its first inputs."""
    jaxpr = closed_jaxpr.jaxpr
    if FALLBACKS:
        n = len(closed_jaxpr.consts)
        fn = lambda *args: jaxpr_as_fun(ClosedJaxpr(jaxpr, args[:n]))(*args[n:])  # noqa: E731
        return _trace_function(fn, [*jaxpr.constvars, *jaxpr.invars])
    return ClosedJaxpr(
        Jaxpr((), [*jaxpr.constvars, *jaxpr.invars], jaxpr.outvars, jaxpr.eqns, jaxpr.effects, jaxpr.debug_info), ()
    )


def bind(eqn: Any, *args: Any, **params: Any) -> list[Any]:
    """Return the results of an equation's primitive for other operands, as a list.

    Args:
        args: The operands.
        params: Parameters that replace parameters of the equation.
    """
    results = eqn.primitive.bind(*args, **(dict(eqn.params) | params))
    return list(results) if eqn.primitive.multiple_results else [results]


def as_function(eqn: Any) -> Callable[..., Any]:
    """Return an equation as a function of arrays, which keeps the custom derivative of the equation."""
    return lambda *args: eqn.primitive.bind(*args, **eqn.primitive.get_bind_params(dict(eqn.params)))


def expand_primitive(eqn: Any) -> Callable[..., list[Any]]:
    """Return a ``call_hi_primitive`` of JAX 0.12 as a function of arrays, written in terms of other primitives."""
    primitive = eqn.params["_prim"]
    return lambda *args: jax.tree.leaves(primitive.expand(*jax.tree.unflatten(primitive.in_tree, args)))


def fori_loop(n: int, fn: Callable[[Any, Any], Any], start: Any) -> Any:
    """Return ``jax.lax.fori_loop(0, n, fn, start)``, with an index of 32 bits.

    JAX's index has 64 bits where float64 is enabled; kernels have no such numbers.
    """

    def iterate(carry: tuple[jax.Array, Any], _: None) -> tuple[tuple[jax.Array, Any], None]:
        k, value = carry
        return (k + 1, fn(k, value)), None

    return jax.lax.scan(iterate, (jax.numpy.int32(0), start), length=n)[0][1]


# Arrays ---------------------------------------------------------------------------------------------------------


def put_host_array(x: np.ndarray, sharding: jax.sharding.Sharding) -> jax.Array:
    """Return a host array on a device, committed to it: ``jax.device_put`` in a tenth of the time.

    The result shares the argument's memory where possible, so the argument must not be written to afterwards.

    Args:
        x: The array, of a type that JAX has.
        sharding: Its device, or devices.
    """
    devices = sharding.device_set
    if len(devices) > 1 or FALLBACKS or batched_device_put is None:
        return jax.device_put(x, sharding)
    return batched_device_put(_aval(x.shape, x.dtype), sharding, [x], list(devices), True)


@functools.cache
def _aval(shape: tuple[int, ...], dtype: Any) -> Any:
    return jax.core.ShapedArray(shape, dtype)


def jit_donating(fn: Callable[..., Any]) -> Any:
    """Return ``jax.jit(fn)`` that may reuse the memory of its first argument, which must not be used any more."""
    return jax.jit(fn) if FALLBACKS else jax.jit(fn, donate_argnums=0)


# Random numbers -------------------------------------------------------------------------------------------------


def is_key(x: Any) -> bool:
    """Whether an array, or its shape and type, holds random keys."""
    return jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)


def bits_generator(dtype: Any) -> str:
    """Return the name of the random number generator of keys of a dtype."""
    impl = getattr(dtype, "_impl", dtype)
    return getattr(impl, "name", str(impl))


# Transformations ------------------------------------------------------------------------------------------------


def add_vmap_rule(fn: Callable[..., Any], rule: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function with a custom rule for ``vmap``.

    Args:
        rule: ``rule(axis_size, in_batched, *args) -> (results, out_batched)``.
    """
    batched_fn = custom_vmap(fn)
    batched_fn.def_vmap(rule)
    return batched_fn


def is_symbolic_zero(tangent: Any) -> bool:
    """Whether the tangent that a rule of ``defjvp(symbolic_zeros=True)`` was given is zero by construction."""
    return tangent is None or isinstance(tangent, SymbolicZero)


# Compilation ----------------------------------------------------------------------------------------------------


def n_compilations(jitted: Callable[..., Any]) -> int:
    """Return the number of programs that have been compiled for a jitted function."""
    return jitted._cache_size()  # type: ignore[attr-defined]


def cache_folder() -> str | None:
    """Return the folder of JAX's persistent compilation cache; None if there is none."""
    return jax.config.jax_compilation_cache_dir or None  # type: ignore[attr-defined]


def set_xla_log_level() -> None:
    """Hide XLA's errors if ``startup`` has chosen that, even where JAX was imported before crazysim."""
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL") != "3":
        return
    with contextlib.suppress(ImportError, AttributeError):
        from jax._src.lib import utils

        utils.absl_set_min_log_level(3)


@contextlib.contextmanager
def compilation_cache(folder: str) -> Iterator[None]:
    """Let JAX keep the programs that this thread compiles in a block, without a change of its configuration.

    JAX opens the cache once per process. The last of overlapping blocks, including blocks of other threads, closes it,
    so that a folder that is configured later is used. If JAX lacks the names used here, nothing is kept.
    """
    try:
        from jax._src import compilation_cache as cache
        from jax._src import config

        settings = (
            config.compilation_cache_dir(folder),
            config.persistent_cache_min_entry_size_bytes(-1),
            config.persistent_cache_min_compile_time_secs(0.0),
        )
        close = cache.reset_cache
    except (ImportError, AttributeError):
        yield
        return
    with contextlib.ExitStack() as stack:
        for setting in settings:
            stack.enter_context(setting)
        stack.enter_context(_close_cache_outside(close))
        yield


@functools.cache
def use_cache(folder: str, make_cache: Callable[[str], Any]) -> None:
    """Let JAX use ``make_cache(folder)``, with the methods ``get`` and ``put``, where it opens its cache in a folder.

    If JAX lacks the name used here, it opens its own.
    """
    with contextlib.suppress(ImportError, AttributeError):
        from jax._src import compilation_cache

        open_cache = compilation_cache.get_file_cache
        compilation_cache.get_file_cache = lambda path: (make_cache(path), path) if path == folder else open_cache(path)


_n_cache_blocks = 0
"""Number of blocks with a compilation cache that are open now, of all threads."""
_CACHE_LOCK = threading.Lock()
"""Guards ``_n_cache_blocks`` and the closing of JAX's cache."""


@contextlib.contextmanager
def _close_cache_outside(close: Callable[[], None]) -> Iterator[None]:
    global _n_cache_blocks
    with _CACHE_LOCK:
        if not _n_cache_blocks:
            close()
        _n_cache_blocks += 1
    try:
        yield
    finally:
        with _CACHE_LOCK:
            _n_cache_blocks -= 1
            if not _n_cache_blocks:
                close()


def ffi_include_folder() -> str:
    """Return the folder of the headers of XLA's foreign function interface."""
    return jax.ffi.include_dir()


def register_target(name: str, function: Any, platform: str) -> None:
    """Register a C function, from ``ctypes``, as the target of XLA's custom calls on ``"cpu"`` or ``"CUDA"``."""
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(function), platform=platform)


def compute_capability(device: Any) -> int:
    """Return the compute capability of an NVIDIA GPU as a number: 90 for 9.0."""
    return int(str(device.compute_capability).replace(".", ""))


DIGAMMA_AT_ZERO = -math.inf if jax.__version_info__ >= (0, 11) else math.nan
"""Value of ``jax.lax.digamma`` at zero: a pole, which JAX gives a sign from 0.11 on."""


def versions() -> str:
    """Return the versions of JAX and jaxlib, which compiled code depends on."""
    return f"jax {jax.__version__} jaxlib {jaxlib.__version__}"


# Several hosts --------------------------------------------------------------------------------------------------


class Hosts(NamedTuple):
    """The hosts of ``jax.distributed.initialize``: processes that run the same program."""

    client: Any
    """Client of the coordinator: its store of texts and its barriers."""
    host_id: int
    """Number of this host, from 0."""
    n_hosts: int
    """Number of hosts."""


def connected_hosts() -> Hosts | None:
    """Return the hosts that this process is connected with, without starting a backend; None if there are none."""
    from jax._src.distributed import global_state

    client = global_state.client
    return None if client is None else Hosts(client, global_state.process_id, global_state.num_processes)


def gather_from_hosts(arrays: Sequence[jax.Array]) -> list[np.ndarray]:
    """Return arrays that are distributed over several hosts as host arrays on each of them; all hosts must call it."""
    return multihost_utils.process_allgather(list(arrays), tiled=True)


def broadcast_from_first(flag: bool) -> bool:
    """Return the flag of host 0 on all hosts, which must all call it."""
    return bool(multihost_utils.broadcast_one_to_all(np.bool_(flag)))


def is_stop_requested(step: int) -> bool:
    """Return True on all hosts at the same step, after one of them has received SIGTERM.

    All hosts must call it at every step.
    """
    return multihost_utils.reached_preemption_sync_point(step)


# Processes ------------------------------------------------------------------------------------------------------


def require_unforked_process() -> None:
    """Check that this process was not forked from one that had used JAX, whose threads are missing in the copy."""
    if _forked_after_use:
        raise ConfigError(
            "expected a process in which JAX can run, got one that was forked after JAX had been used: its calls would "
            "hang. Start processes by 'spawn', such as multiprocessing.get_context('spawn') or "
            "SubprocVecEnv(..., start_method='spawn'), or put all worlds into one environment, such as "
            "gymnasium.make_vec(id, num_envs=64)."
        )


def _note_fork() -> None:
    from jax._src import xla_bridge

    if xla_bridge.backends_are_initialized():
        _forked_after_use.append(os.getpid())


_forked_after_use: list[int] = []
"""This process's id if it was forked from one that had used JAX."""
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)
