"""Every rule of lowering: a function of one drone has the same results in the interpreter as in JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from blocks import make_program
from cases import COMPILED_ENGINES
from rule_cases import (
    CASES,
    N_LANES,
    RANDOM_CASES,
    assert_agree,
    case_function,
    drone_shapes,
    make_inputs,
    map_over_drones,
)

from crazysim import Sim
from crazysim.engine import Step
from crazysim.engine.backends import interpret
from crazysim.engine.backends.fused import build
from crazysim.engine.ir.verify import verify_block
from crazysim.engine.lowering.jaxprs import lower_function
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.sharding import Location
from crazysim.engine.stage import as_stages, stage
from crazysim.errors import EngineWarning


def lane_numbers(g):
    return [x for name, array in vars(g).items()
            for x in (np.asarray(array) if name == "table" else np.asarray(array).reshape(N_LANES, -1).T)]  # fmt: skip


@pytest.fixture(scope="module")
def expected_by_case():
    names = [*CASES, *RANDOM_CASES]
    return jax.jit(lambda g: {name: map_over_drones(name)(g) for name in names})(make_inputs())


@pytest.mark.parametrize("name", [*CASES, *RANDOM_CASES])
def test_a_case_gives_the_results_of_jax(name, expected_by_case):
    """Integers, bools and random bits are equal, floats equal up to rounding."""
    g = make_inputs()
    block = lower_function(case_function(name), drone_shapes(g))
    verify_block(block)
    assert block.outputs
    result = interpret.run_block(block, lane_numbers(g), (N_LANES,))
    assert_agree(np.stack(result, axis=-1), expected_by_case[name], name)


@pytest.mark.parametrize("engine", COMPILED_ENGINES)
def test_loops_branches_and_random_numbers_run_in_every_engine(engine):
    """Run the cases whose operations run blocks or have several results; test_targets has all other operations."""
    names = [
        "cond",
        "loops",
        "while_loops",
        "batches_of_while_loops",
        "uniform_loop",
        "nested_calls",
        "gradient",
        *RANDOM_CASES,
    ]

    def run_all(g):
        return [case_function(name)(g) for name in names]

    g = make_inputs()
    block = lower_function(run_all, drone_shapes(g))
    program, leaves = make_program(block, lane_numbers(g), N_LANES)
    expected = interpret.run_block(block, lane_numbers(g), (N_LANES,))
    run = (
        build(program, Location("cpu")) if engine == "fused" else lambda x, n: interpret.lanes.run_steps(program, x, n)
    )
    written, _ = jax.jit(lambda leaves: run(leaves, 1))(leaves)
    for x, y in zip(written, expected, strict=True):
        assert_agree(np.asarray(x).reshape(-1), y, engine)


# Refusals ------------------------------------------------------------------------------------------------------------


def write_first_number(data, x):
    return data.replace(states=data.states.replace(pos=jnp.zeros(3).at[0].set(jnp.ravel(x)[0])))


REFUSED_STAGES = {
    "eigh": (lambda d: write_first_number(d, jnp.linalg.eigh(d.states.pos * jnp.eye(3))[0]), "primitive 'eigh' has no"),
    "complex": (lambda d: write_first_number(d, jnp.fft.fft(d.states.pos).real), "numbers of type complex64"),
    "half": (lambda d: write_first_number(d, d.states.pos.astype(jnp.bfloat16).astype(jnp.float32)), "numbers of type"),
    "index": (lambda d: write_first_number(d, (jnp.arange(100.0) + d.states.pos[0])[d.core.steps % 100]), "100"),
    "cholesky": (lambda d: write_first_number(d, jnp.linalg.cholesky(jnp.eye(7) + d.states.pos[0])), "size 7"),
    "sort": (lambda d: write_first_number(d, jnp.sort(jnp.zeros(65) + d.states.pos[0])), "65 elements"),
    "generator": (
        lambda d: write_first_number(d, jax.random.uniform(jax.random.key(0, impl="rbg")) + d.states.pos),
        "random",
    ),
    "scan": (
        lambda d: write_first_number(d, jax.lax.scan(lambda c, y: (c + y, y), d.states.pos[0], jnp.ones(65))[0]),
        "65",
    ),
}
"""By operation that the engine refuses: the function of a stage that uses it, and words of the error."""


@pytest.fixture(scope="module")
def data():
    return Sim(n_worlds=2, n_drones=1, control="rotor_vel", engine="lanes").data


@pytest.mark.parametrize("name", REFUSED_STAGES)
def test_a_refused_operation_is_named_with_its_stage(data, name):
    fn, words = REFUSED_STAGES[name]
    (unfused,) = lower_stages(as_stages({"mine": stage("drone")(fn)}), data).unfused_stages
    assert words in str(unfused.error)
    assert f"stage 'mine', jax {jax.__version__}" in str(unfused.error)
    assert unfused.error.primitive


def test_a_refused_stage_runs_without_fusion(data):
    stages = {"mine": stage("drone")(REFUSED_STAGES["eigh"][0])}
    expected = stages["mine"](stages["mine"](data)).states.pos
    with pytest.warns(EngineWarning, match="stage 'mine' is not fused: primitive 'eigh' has no rule"):
        result = Step(stages)(data, jnp.int32(2)).states.pos
    np.testing.assert_allclose(result, expected, rtol=1e-6)


# Special numbers -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fn", [
    lambda x: 0.0 * x, lambda x: x * jnp.zeros(3)[0], lambda x: 0.0 / x, lambda x: x - x, lambda x: x * 1 + 0.0,
    lambda x: jnp.dot(jnp.zeros(2), jnp.stack([x, x])), lambda x: jnp.maximum(x, 0.0), lambda x: jnp.clip(x, -1, 1),
])  # fmt: skip
def test_constants_do_not_hide_numbers_that_are_not_finite(fn):
    """A product with zero is NaN where the other number is infinite, even if the zero is a constant."""
    x = np.float32([np.nan, np.inf, -np.inf, 0.0, -2.5])
    (result,) = interpret.run_block(lower_function(fn, jax.ShapeDtypeStruct((), np.float32)), [x], x.shape)
    np.testing.assert_array_equal(result, np.asarray(jax.jit(jax.vmap(fn))(x)))
