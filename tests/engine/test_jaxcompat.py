"""JAX beyond its public interface: each name that the engine relies on, on every version that is supported."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.engine import jaxcompat
from crazysim.engine.errors import UnsupportedError


def equation(fn, *args, name=None):
    """Return the only equation of a function, or the first of a primitive's name."""
    eqns = jax.make_jaxpr(fn)(*args).jaxpr.eqns
    return next(e for e in eqns if name is None or e.primitive.name == name)


# Jaxprs --------------------------------------------------------------------------------------------------------------


def test_an_attribute_of_a_parameter_that_is_gone_is_unsupported():
    eqn = equation(lambda x, i: x.at[i].add(1.0), jnp.ones(6), jnp.int32(1), name="scatter-add")
    with jaxcompat.read_equation(eqn) as read:
        assert read.params["dimension_numbers"].scatter_dims_to_operand_dims == (0,)
    expected = f"its parameter 'dimension_numbers' has no 'old' in JAX {jax.__version__}"
    with pytest.raises(UnsupportedError, match=expected) as error, jaxcompat.read_equation(eqn) as read:
        _ = read.params["dimension_numbers"].old
    assert error.value.primitive == "scatter-add"


@pytest.mark.parametrize("mistake, kind", [
    (lambda read: {}["mine"], KeyError), (lambda read: np.zeros(3).nothing, AttributeError),
    (lambda read: read.nothing, AttributeError), (lambda read: 1 / 0, ZeroDivisionError),
])  # fmt: skip
def test_other_errors_of_a_rule_do_not_become_unsupported_errors(mistake, kind):
    eqn = equation(lambda x: x.reshape(3, 2), jnp.ones(6), name="reshape")
    with pytest.raises(kind), jaxcompat.read_equation(eqn) as read:
        mistake(read)


# Arrays --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.int32, bool])
def test_an_array_of_the_host_is_put_on_a_device(dtype):
    """Arrays are committed and not weakly typed, as from ``jax.device_put``, so they need no other program."""
    x = np.arange(6).reshape(2, 3).astype(dtype)
    for device in jax.devices()[:2]:
        sharding = jax.sharding.SingleDeviceSharding(device)
        array, expected = jaxcompat.put_host_array(x.copy(), sharding), jax.device_put(x, sharding)
        assert (array.aval, array.committed, array.devices()) == (expected.aval, True, {device})
        np.testing.assert_array_equal(array, x)
        doubled = jax.jit(lambda x: x * 2)
        np.testing.assert_array_equal(doubled(array), doubled(expected))
        assert jaxcompat.n_compilations(doubled) == 1


def test_an_array_of_the_host_is_split_over_devices():
    mesh = jax.make_mesh((2,), ("worlds",), axis_types=(jax.sharding.AxisType.Auto,), devices=jax.devices()[:2])
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("worlds"))
    placed = jaxcompat.put_host_array(np.arange(4.0, dtype=np.float32), sharding)
    assert placed.sharding == sharding
    np.testing.assert_array_equal(placed, np.arange(4.0))


def test_memory_that_numpy_views_outlives_donation():
    """Steps without XLA rely on it, see ``engine/host_call.py``."""
    x = jnp.arange(3.0)
    view = np.asarray(x)
    np.testing.assert_array_equal(jaxcompat.jit_donating(lambda x: x + 7.0)(x), [7.0, 8.0, 9.0])
    np.testing.assert_array_equal(view, [0.0, 1.0, 2.0])


def test_an_argument_is_donated():
    """The fallback of ``jit_donating``, for a JAX without donation on the host, donates nothing."""
    x = jnp.arange(3.0)
    np.testing.assert_array_equal(jaxcompat.jit_donating(lambda x, y: x + y)(x, 1.0), [1.0, 2.0, 3.0])
    assert x.is_deleted() != jaxcompat.FALLBACKS


# Random numbers ------------------------------------------------------------------------------------------------------


def test_the_cipher_is_that_of_random_numbers():
    """Threefry of key and counter (Salmon et al. 2011): the bits that JAX draws, and its published test vector."""
    zero = np.uint32(0)
    words = [int(x[0]) for x in jaxcompat.threefry2x32_p.bind(*(jnp.asarray([zero]) for _ in range(4)))]
    assert words == [0x6B200159, 0x99BA4EFE]
    key = jax.random.key(7)
    bits = jaxcompat.threefry_prng_impl.random_bits(jax.random.key_data(key), 32, (5,))
    np.testing.assert_array_equal(bits, jax.random.bits(key, (5,), np.uint32))


# Transformations -----------------------------------------------------------------------------------------------------


def test_a_function_has_a_rule_of_its_own_for_vmap():
    seen = []

    def rule(size, in_batched, x, y):
        seen.append((size, in_batched))
        return x + y + 100, True

    call = jaxcompat.add_vmap_rule(lambda x, y: x + y, rule)
    assert call(1.0, 2.0) == 3.0
    np.testing.assert_array_equal(jax.vmap(call, (0, None))(jnp.arange(3.0), 1.0), [101, 102, 103])
    assert seen == [(3, [True, False])]


def test_tangents_that_are_zero_by_construction_are_recognised():
    seen = []

    @jax.custom_jvp
    def f(x, y):
        return x * y

    def rule(primals, tangents):
        seen.extend(jaxcompat.is_symbolic_zero(t) for t in tangents)
        return f(*primals), tangents[0] * primals[1]

    f.defjvp(rule, symbolic_zeros=True)
    assert jax.grad(f)(2.0, 3.0) == 3.0
    assert seen == [False, True]
    assert jaxcompat.is_symbolic_zero(None)


# Compilation ---------------------------------------------------------------------------------------------------------


def test_tracing_ahead_is_not_tracing_twice():
    traces = []
    fn = jax.jit(lambda x: traces.append(1) or x + 1)
    x = jnp.ones(3)
    fn.trace(x)
    fn(x)
    jax.jit(lambda x: fn(x))(x)
    assert (len(traces), jaxcompat.n_compilations(fn)) == (1, 1)


def test_only_one_module_goes_beyond_the_public_interface():
    """A new JAX can then break this module only."""
    import crazysim

    private = ("jax.extend", "jax._src", "jax.interpreters", "jax.experimental", "jax.custom_batching", "SymbolicZero",
               "get_bind_params", "pycapsule", "_cache_size", ".primitive.bind", "jax.core.Jaxpr")  # fmt: skip
    root = Path(crazysim.__file__).parent
    result = {
        f"{path.relative_to(root)}: {word}"
        for path in root.rglob("*.py")
        for word in private
        if path.name != "jaxcompat.py" and word in path.read_text()
    }
    # Methods of ours by that name, for the tests of law 6 of CONTRIBUTING.md, no silent retrace.
    assert result == {"engine/step.py: _cache_size", "sim/reset.py: _cache_size"}


@pytest.mark.long("runs tests in another process")
def test_the_engine_runs_without_functions_that_jax_may_remove():
    """Chosen tests pass with the fallbacks of ``jaxcompat``: tests of each fallback, and tests of the step.

    The step runs in one kernel, split by an unfused stage, with each engine, and with commands.
    """
    tests = ["tests/engine/test_jaxcompat.py", "tests/engine/test_step.py", "tests/sim/test_stepper.py"]
    chosen = ("inputs or dropped or closes_over or on_a_device or donat or parameter_of_each_drone or splits_a_large"
            " or commands_to_flattened")  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *tests, "-k", chosen, "-n", "0"],
        cwd=Path(__file__).parents[2],
        env={k: v for k, v in os.environ.items() if "PYTEST" not in k} | {"CRAZYSIM_JAX_FALLBACKS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_digamma_at_zero_is_that_of_this_version():
    np.testing.assert_array_equal(jax.lax.digamma(np.float32(0)), np.float32(jaxcompat.DIGAMMA_AT_ZERO))


def test_a_single_process_is_its_only_host():
    """``tests/train/test_hosts.py`` tests several hosts."""
    assert jaxcompat.connected_hosts() is None
    assert not jaxcompat.is_stop_requested(step=1)
    assert [jaxcompat.broadcast_from_first(flag) for flag in (True, False)] == [True, False]
    np.testing.assert_array_equal(jaxcompat.gather_from_hosts([jax.numpy.arange(3)])[0], np.arange(3))
