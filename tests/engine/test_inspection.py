"""Tools to inspect the engine: listings, dumps, source, and the first difference between two engines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from blocks import make_program
from cases import shared_sim, with_states
from differences import first_difference

from crazysim.engine.backends import source
from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir import listing, ops
from crazysim.engine.ir.blocks import Builder
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.optimise import optimise
from crazysim.engine.stage import stage

F = np.float32


@stage("drone")
def sway(data):
    force = data.states.force
    x = data.params.mass[0] * jnp.sin(data.states.pos[2])
    return data.replace(states=data.states.replace(force=jnp.stack([x, force[1], force[2]])))


@stage("world")
def follow(data):
    force = data.states.force
    return data.replace(states=data.states.replace(force=jnp.stack([force[0], force[0]])))


def undeclared_stage(data):
    return data.replace(states=data.states.replace(torque=2 * data.states.torque))


@pytest.fixture(scope="module")
def data():
    return shared_sim(n_worlds=3, n_drones=2, control="rotor_vel").data


def test_a_program_is_listed_with_the_names_of_fields_and_stages(data):
    text = listing.list_program(lower_stages([sway], data))
    assert text == (
        "segment of one drone, at each step: sway\n"
        "  %0: float32 = states.pos[2]\n"
        "  %1: float32 = params.mass[0]\n"
        "  # sway\n"
        "  %2: float32 = sin(%0)\n"
        "  %3: float32 = mul(%1, %2)\n"
        "  states.force[0] = %3\n"
    )


def test_segments_of_worlds_name_the_drone_and_unfused_stages_their_reason(data):
    from crazysim.engine.stage import as_stages

    text = listing.list_program(optimise(lower_stages(as_stages({"follow": follow, "mine": undeclared_stage}), data)))
    assert "states.force[0] of drone 1 = " in text
    assert "each stage mine of all worlds, unfused: it is not declared for one drone or one world\n" in text
    assert "  writes states.torque\n" in text


# Dumps ---------------------------------------------------------------------------------------------------------------


def test_a_dump_has_the_jaxprs_and_the_program_after_each_pass(data, tmp_path, monkeypatch):
    monkeypatch.setenv("CRAZYSIM_DUMP", str(tmp_path / "out"))
    optimise(lower_stages([sway], data))
    names = [
        file.name.split("-", 2)[2] for file in sorted((tmp_path / "out").iterdir(), key=lambda f: f.name.split("-")[1])
    ]
    passes = ["lowered", "fuse", "join_ticks", "hoist", "pack_shared"]
    assert names == ["sway.jaxpr", *(f"program.{name}" for name in passes)]
    jaxpr = next((tmp_path / "out").glob("*sway.jaxpr")).read_text()
    assert "sin" in jaxpr


# Source --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("x, text", [
    (F(0.1), "f32(0x1.99999a0000000p-4)"), (F(np.nan), "f32_nan()"), (np.float64(-np.inf), "-f64_infinity()"),
    (np.int32(-(2**31)), "i32(-2147483647 - 1)"), (np.uint32(2**32 - 1), "u32(4294967295u)"), (np.bool_(True), "b1(1)"),
])  # fmt: skip
def test_constants_are_written_exactly(x, text):
    assert source.literal(x) == text


def test_an_operation_without_source_is_refused_when_the_step_is_planned(data, monkeypatch):
    import dataclasses

    from crazysim.engine.backends import kernel

    monkeypatch.setitem(ops.TABLE, "sin", dataclasses.replace(ops.TABLE["sin"], source=""))
    program = optimise(lower_stages([sway], data))
    with pytest.raises(UnsupportedError, match=r"primitive 'sin'.*stage 'sway', jax") as error:
        kernel.write_kernel(program, "host")
    assert (error.value.stage, error.value.primitive) == ("sway", "sin")


def test_a_leaf_of_a_type_that_kernels_do_not_have_is_named(x64):
    from crazysim.engine.backends import kernel

    builder = Builder(stage="all")
    x = builder.input(np.int64)
    program, _ = make_program(builder.finish([x]), [np.zeros(3, np.int64)], 3)
    with pytest.raises(UnsupportedError, match=r"type int64, which .* has"):
        kernel.write_kernel(program, "cuda")


# Differences ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def moving_data(data):
    return with_states(data, pos=[0.1, 0.2, 0.7], vel=[0.3, -0.2, 0.1])


def test_the_first_difference_has_stage_field_element_and_operation(moving_data, monkeypatch):
    """The sine that ``lanes`` uses is made wrong."""
    import dataclasses

    wrong = dataclasses.replace(ops.TABLE["sin"], xla=lambda x: jax.lax.sin(x) + 0.01)
    monkeypatch.setitem(ops.TABLE, "sin", wrong)
    result = first_difference({"mine": undeclared_stage, "sway": sway}, moving_data, engines=("plain", "lanes"))
    assert result is not None
    assert (result.stage, result.leaf, result.index[2:]) == ("sway", "states.force", (0,))
    assert abs(result.values[1] - result.values[0]) > 1e-4
    assert "%2: float32 = sin(%0) of stage 'sway'" in result.operation
    assert str(result).startswith("stage 'sway': states.force")
