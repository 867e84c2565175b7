"""Reductions over the drones of a world, compared with explicit loops over all pairs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_states

from crazysim import ConfigError, Plugin, Sim, reduce_over_others, stage
from crazysim.core import insert_fn_before
from crazysim.engine import Step
from crazysim.engine.ir.program import UnfusedStage


@stage("drone")
def crowd(data):
    pos = data.states.pos

    def pair(other, is_self):
        offset = pos - other["pos"]
        return jnp.where(is_self, 0.0, other["gain"] * offset / (jnp.dot(offset, offset) + 0.1))

    push = reduce_over_others(pair, {"pos": pos, "gain": 1e-3 * jnp.exp(-jnp.abs(pos[2]))})
    square = reduce_over_others(
        lambda other, is_self: jnp.where(is_self, jnp.inf, jnp.sum((pos - other) ** 2)), pos, "min"
    )
    higher = reduce_over_others(lambda other, is_self: other > pos[2], pos[2], "max")
    count = reduce_over_others(lambda other, is_self: jnp.int32(other > pos[2]), pos[2])
    force = push + jnp.where(higher, 1e-4, 0.0) * jnp.minimum(square, 2.0) + 1e-5 * count
    return data.replace(states=data.states.replace(force=force))


def crowd_forces(pos):
    """Return the forces of ``crowd`` in one world, pair by pair in float64. (n_drones, 3)"""
    force = np.zeros_like(pos)
    for i, p in enumerate(pos):
        others = [j for j in range(len(pos)) if j != i]
        for j in others:
            offset = p - pos[j]
            force[i] += 1e-3 * np.exp(-abs(pos[j, 2])) * offset / (offset @ offset + 0.1)
        higher = sum(pos[j, 2] > p[2] for j in others)
        nearest = min([np.sum((p - pos[j]) ** 2) for j in others], default=np.inf)
        force[i] += (1e-4 if higher else 0.0) * min(nearest, 2.0) + 1e-5 * higher
    return force


def random_positions(n_worlds, n_drones, seed=0):
    """Return positions in a cube of 2 m above the floor. (n_worlds, n_drones, 3)"""
    return np.random.default_rng(seed).uniform(-1, 1, (n_worlds, n_drones, 3)) + [0, 0, 2]


@stage("drone")
def move_by_force(data):
    """Move a drone of 40 g by the force on it: rotors and attitude do not matter here."""
    states = data.states
    vel = states.vel + 0.05 * states.force
    return data.replace(states=states.replace(vel=vel, pos=states.pos + 0.002 * vel))


def make_crowd_sim(n_worlds, n_drones, *plugins):
    """Return a simulation whose only stages are ``crowd``, ``move_by_force`` and the stages of plugins."""
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, control="rotor_vel")
    sim.data = with_states(sim.data, pos=random_positions(n_worlds, n_drones), rotor_vel=15000.0)
    physics = set(sim.step_pipeline) - {"increment_steps"}
    for plugin in plugins:
        sim.add(plugin)
    other_stages = {name: fn for name, fn in sim.step_pipeline.items() if name not in physics}
    sim.step_pipeline = {"crowd": crowd, "move": move_by_force, **other_stages}
    return sim


@pytest.mark.parametrize("n_drones", [1, 3, 17])
def test_all_pairs_are_computed(n_drones):
    """Test numbers of drones below, at and above the lanes of a vector; results differ by float32 rounding only."""
    sim = make_crowd_sim(3, n_drones)
    expected = np.stack([crowd_forces(pos) for pos in np.asarray(sim.data.states.pos, np.float64)])
    assert np.abs(expected).max() > 1e-4 or n_drones == 1
    step = Step(sim.step_pipeline, strict=True)
    result = step(sim.data, jnp.int32(1))
    np.testing.assert_allclose(result.states.force, expected, rtol=2e-5, atol=1e-9)
    assert not step.plan(sim.data).program.unfused_stages


class Push(Plugin):
    name: str = "push"

    def influence(self, data):
        pos, gains = data.states.pos, jnp.asarray([1e-3, 2e-3])
        forces = jax.vmap(lambda k: reduce_over_others(lambda other, is_self: k * (pos - other), pos))(gains)
        return data.replace(states=data.states.replace(force=data.states.force + forces.sum(0)))


def test_an_inner_vmap_and_an_influence_may_reduce():
    """RK4 evaluates an influence four times per step, each time at the positions of its stage."""
    for n_drones in (3, 9):
        sim = Sim(n_worlds=2, n_drones=n_drones, control="rotor_vel", integrator="rk4")
        sim.data = with_states(
            sim.data, pos=random_positions(2, n_drones), vel=random_positions(2, n_drones, 1) - [0, 0, 2]
        )
        sim.add(Push())
        result = Step(sim.step_pipeline)(sim.data, jnp.int32(3)).states
        pos = np.asarray(sim.data.states.pos, np.float64)
        still = Sim(n_worlds=2, n_drones=n_drones, control="rotor_vel", integrator="rk4")
        still.data = sim.data.replace(plugins={})
        free = Step(still.step_pipeline)(still.data, jnp.int32(3)).states
        pull = 3e-3 * (n_drones * pos - pos.sum(1, keepdims=True)) / 0.0434
        np.testing.assert_allclose(
            np.asarray(result.vel) - np.asarray(free.vel), 3 * 0.002 * pull, rtol=0.02, atol=2e-5
        )


def test_law_09_wrong_uses_are_errors():
    with pytest.raises(ConfigError, match="expected reduce_over_others in a function of one drone"):
        reduce_over_others(lambda other, is_self: other, jnp.ones(3))
    with pytest.raises(ConfigError, match="'sum', 'min' or 'max', got 'mean'"):
        reduce_over_others(lambda other, is_self: other, jnp.ones(3), "mean")
    with pytest.raises(ConfigError, match="got bools"):
        reduce_over_others(lambda other, is_self: other > 0, jnp.ones(3))


def test_a_reduction_in_a_loop_is_not_fused():
    @stage("drone")
    def reduce_in_loop(data):
        pos = data.states.pos

        def body(_, x):
            return x + reduce_over_others(lambda other, is_self: other, pos)

        force = jax.lax.fori_loop(0, 3, body, jnp.zeros(3)) * 1e-4
        return data.replace(states=data.states.replace(force=force))

    sim = Sim(n_worlds=2, n_drones=3)
    insert_fn_before(sim.step_pipeline, "integration", reduce_in_loop)
    with pytest.warns(match="is in a loop"):
        (unfused,) = Step(sim.step_pipeline, "lanes").plan(sim.data).program.unfused_stages
    assert isinstance(unfused, UnfusedStage)
