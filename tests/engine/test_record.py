"""The engine steps any record that says which leaves are its clock, its flags and its watched leaves."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.engine import Step, explain
from crazysim.engine.pytree import Members, leaf, leaf_indices
from crazysim.engine.record import Record, Roles, nonfinite_worlds
from crazysim.engine.stage import stage
from crazysim.errors import ConfigError

DT, GRAVITY = 0.01, 9.81
ENGINES = ("plain", "lanes", "fused", "interpret")
ROUNDING = 1e-6
"""Some roundings in float32 of angles and rates of order 1."""


class Pendulums(Members):
    angle: jax.Array = leaf("member")
    rate: jax.Array = leaf("member")
    length: jax.Array = leaf("parameter", 0)
    drag: jax.Array = leaf("parameter", 2, sparse=True)


class Sparks(Members):
    heat: jax.Array = leaf("member")


class Workshop(Record):
    pendulums: Pendulums
    sparks: Sparks
    ticks: jax.Array = leaf("world")
    is_broken: jax.Array = leaf("world")

    def roles(self):
        indices = leaf_indices(self)
        watched = {indices.pendulums.angle: True, indices.pendulums.rate: True, indices.sparks.heat: False}
        return Roles("pendulums", indices.ticks, indices.is_broken, watched)


def make_workshop(n_worlds=3, n_pendulums=2, n_sparks=3):
    def ids(n):
        return jnp.broadcast_to(jnp.arange(n), (n_worlds, n))

    shape = n_worlds, n_pendulums
    angle = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, shape), np.float32)
    return Workshop(
        Pendulums(
            "pendulums", n_pendulums, ids(n_pendulums), angle, jnp.zeros(shape), jnp.float32(0.5),
            jnp.array([[0.1, 0.0], [0.0, 0.0]]),
        ),
        Sparks("sparks", n_sparks, ids(n_sparks), jnp.ones((n_worlds, n_sparks))),
        jnp.zeros((n_worlds, 1), jnp.int32), jnp.zeros((n_worlds, 1), bool),
    )  # fmt: skip


@stage("pendulums")
def swing(data):
    p = data.pendulums
    slowing = (p.drag @ jnp.stack([p.rate, p.angle]))[0]
    rate = p.rate - DT * (GRAVITY / p.length * jnp.sin(p.angle) + slowing)
    return data.replace(pendulums=p.replace(angle=p.angle + DT * rate, rate=rate))


@stage("sparks")
def cool(data):
    return data.replace(sparks=data.sparks.replace(heat=0.9 * data.sparks.heat))


@stage("world")
def tick(data):
    return data.replace(ticks=data.ticks + 1)


PIPELINE = {"swing": swing, "cool": cool, "tick": tick}


def swing_alone(angle, n_steps):
    rate = np.zeros_like(angle)
    for _ in range(n_steps):
        rate = rate - DT * (GRAVITY / 0.5 * np.sin(angle) + 0.1 * rate)
        angle = angle + DT * rate
    return angle


@pytest.mark.parametrize("engine", ENGINES)
def test_every_engine_steps_a_record_without_drones(engine):
    data = make_workshop()
    step = Step(PIPELINE, engine, strict=True)
    after = step(data, jnp.int32(20))
    assert step.engines == [engine]
    expected = swing_alone(np.asarray(data.pendulums.angle, np.float64), 20)
    np.testing.assert_allclose(after.pendulums.angle, expected, atol=20 * ROUNDING)
    np.testing.assert_allclose(after.sparks.heat, 0.9**20, rtol=20 * ROUNDING)
    assert after.ticks.tolist() == [[20]] * 3
    assert not after.is_broken.any()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("value", "flags"), [(np.nan, [1, 0, 1]), (np.inf, [1, 0, 0])])
def test_watched_leaves_and_the_clock_flag_their_world(engine, value, flags):
    data = make_workshop()
    data = data.replace(
        pendulums=data.pendulums.replace(angle=data.pendulums.angle.at[0, 1].set(value)),
        sparks=data.sparks.replace(heat=data.sparks.heat.at[2, 0].set(value)),
    )
    after = Step(PIPELINE, engine)(data, jnp.int32(1))
    assert after.is_broken[:, 0].tolist() == [bool(x) for x in flags]
    assert nonfinite_worlds(after).tolist() == after.is_broken.tolist()
    late = make_workshop().replace(ticks=jnp.array([[0], [2**31 - 1], [0]], jnp.int32))
    assert Step(PIPELINE, engine)(late, jnp.int32(1)).is_broken.tolist() == [[False], [True], [False]]


def test_a_step_can_be_told_of_zeros_that_a_trace_hides():
    data, step = make_workshop(), Step(PIPELINE, "lanes")
    told = step.with_zeros_of(data)
    assert told == step.with_zeros_of(data) != step.with_zeros_of(None)
    programs = [s.plan(data).program for s in (told, step.with_zeros_of(None))]
    few, many = (sum(segment.n_operations for segment in program.segments) for program in programs)
    assert few < many
    assert explain(step, data) == explain(told, jax.eval_shape(lambda: data))
    results = [jax.jit(lambda data, s=s: s(data, 5))(data) for s in (told, step)]
    np.testing.assert_allclose(results[0].pendulums.angle, results[1].pendulums.angle, atol=5 * ROUNDING)


def test_only_records_are_stepped():
    not_a_record: Any = (jnp.zeros(3),)
    with pytest.raises(ConfigError, match=r"Use sim\.data"):
        Step(PIPELINE)(not_a_record)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("angle", jnp.zeros((3, 1)), r"pendulums.angle has shape \(3, 1\)"),
        ("angle", jnp.zeros((2, 2)), r"pendulums.angle has shape \(2, 2\)"),
        ("length", jnp.ones((3, 1)), r"pendulums.length has shape \(3, 1\)"),
        ("length", jnp.ones(2), r"pendulums.length has shape \(2,\)"),
    ],
)
def test_law_02_shapes_that_kernels_would_misread_are_refused(name, value, message):
    data = make_workshop()
    with pytest.raises(ConfigError, match=message):
        Step(PIPELINE)(data.replace(pendulums=data.pendulums.replace(**{name: value})), 1)


def test_law_09_records_stages_and_scopes_that_are_incomplete_are_named():
    class Bare(Record):
        x: jax.Array = leaf("world")

    with pytest.raises(ConfigError, match=r"expected the roles of leaves of Bare.*Define roles"):
        Step({"tick": tick})(Bare(jnp.zeros((3, 1))), 1)

    class Lost(Workshop):
        height: jax.Array = leaf("drone")

    with pytest.raises(ConfigError, match=r"expected data.height in a record of a population.*leaf\(.member.\)"):
        Lost(**vars(make_workshop()), height=jnp.zeros((3, 2))).check()
    with pytest.raises(ConfigError, match="expected stages as a dict by name"):
        Step([swing])
    with pytest.raises(ConfigError, match=r"expected a scope, one of drone, member.*got 'membr'"):
        leaf("membr")
