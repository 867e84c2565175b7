"""Gradients on an accelerator, compared with gradients of the plain engine on the CPU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import centre, gap, repulsion, trees_equal
from on_devices import ACCELERATOR, DEVICES, NAMES, require_device
from sweep import assert_agree, make_flying_sim

from crazysim import Battery, Camera, Sim, Wind
from crazysim.core import functional as F
from crazysim.core.pipeline import insert_fn_before
from crazysim.engine import Step
from crazysim.engine.backends import cuda

ROUNDING = 1e-4
"""Tolerance of gradients of 50 steps in float32, relative to the largest component; see ``sweep.ROUNDING``."""


def value_and_gradient(sim, n_steps=50, of_params=False):
    """Return a function and a point at which to evaluate it.

    The function maps a tuple of states, commands and parameters to a loss and its gradient. The parameters are None
    unless ``of_params``.
    """
    start, step = sim.data, sim.build_step_fn()
    # The terms of parameters that are zero in ``start`` are kept where the parameters vary.
    step = step.with_zeros_of(None if of_params else start)
    level = sim.control.value
    send = getattr(F, f"{level}_control")

    def loss(x):
        states, commands, params = x
        data = start.replace(states=states, params=start.params if params is None else params)
        for cmd in commands:  # a different command each time
            data = step(send(data, cmd), n_steps // len(commands))
        after = data.states
        return jnp.sum(after.pos**2) + jnp.sum(after.vel * jnp.array([1.0, -2.0, 3.0])) + jnp.sum(after.ang_vel**2)

    data = getattr(start.controls, level)
    cmd = getattr(data, "staged_cmd", data)
    point = start.states, [cmd, cmd * 1.01], start.params if of_params else None
    return jax.value_and_grad(loss, allow_int=True), point


def floating_leaves(tree):
    return [x for x in jax.tree.leaves(tree) if x.dtype != jax.dtypes.float0]


def compare_gradients(build, tolerance=ROUNDING, **options):
    def run(device):
        sim = build(device, "plain" if device == "cpu" else "auto")
        fn, point = value_and_gradient(sim, **options)
        out = jax.jit(fn)(point)
        if device == ACCELERATOR:
            assert "gradient: one kernel" in sim.explain()
        return floating_leaves(out)

    expected, result = (require_device(name, run(name)) for name in NAMES)
    for x, y in zip(result, expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=tolerance * max(np.abs(y).max(), 1e-3))


@pytest.mark.parametrize("control", ["state", "attitude", "rotor_vel"])
def test_gradients_equal_those_of_the_reference_on_the_cpu(control):
    compare_gradients(lambda device, engine: make_flying_sim(device, control=control, engine=engine))


def test_gradients_of_shared_parameters_are_sums():
    compare_gradients(lambda device, engine: make_flying_sim(device, control="attitude", engine=engine), of_params=True)


def test_gradients_in_float64_equal_those_of_the_reference(x64):
    compare_gradients(lambda device, engine: make_flying_sim(device, control="state", engine=engine), 1e-9)


def test_gradients_go_through_the_states_of_plugins():
    def build(device, engine):
        plugins = [Battery(0.25, 0.1), Wind((2.0, 1.0, 0.0), speed_20ft=7.7, roughness=0.05)]
        return make_flying_sim(device, plugins=plugins, control="attitude", engine=engine)

    compare_gradients(build)


@pytest.mark.parametrize(
    ("n_drones", "stage"),
    [(3, repulsion), (12, repulsion), (33, repulsion), (3, centre), (12, gap)],
    ids=lambda x: str(x),
)
def test_drones_that_act_on_each_other_are_differentiated(n_drones, stage):
    """Drones of a world are in one warp, or in a block in which some threads have no drone."""

    def build(device, engine):
        sim = make_flying_sim(device, 4, n_drones, control="attitude", engine=engine)
        insert_fn_before(sim.step_pipeline, "integration", stage)
        return sim

    compare_gradients(build, n_steps=20)


@pytest.mark.parametrize("n_drones", [1, 12, 33])
def test_tangents_equal_those_of_the_reference_on_the_cpu(n_drones):
    """A world has one drone, or drones that act on each other within a warp or within a block."""

    def run(name):
        sim = make_flying_sim(name, 4, n_drones, control="attitude", engine="plain" if name == "cpu" else "auto")
        if n_drones > 1:
            insert_fn_before(sim.step_pipeline, "integration", repulsion)
        start, step = sim.data.states, sim.build_step_fn()

        def end(x):
            after = step(sim.data.replace(states=start.replace(pos=x[0], vel=x[1])), 20).states
            return after.pos, after.vel, after.quat

        point = start.pos, start.vel
        out = jax.jit(lambda x: jax.jvp(end, (x,), (jax.tree.map(jnp.cos, x),))[1])(point)
        assert name == "cpu" or "jvp: one kernel" in sim.explain()
        return out

    expected, result = (require_device(name, run(name)) for name in NAMES)
    for x, y in zip(result, expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=ROUNDING * max(np.abs(y).max(), 1e-3))


def test_gradients_are_equal_to_the_bit_in_any_run_and_with_little_memory(monkeypatch):
    """With little memory, gradients are computed in intervals of steps, and in fewer blocks with more lanes."""
    result = []
    for memory in (cuda.MAX_GRADIENT_MEMORY_BYTES, cuda.MAX_GRADIENT_MEMORY_BYTES, 2**18):
        monkeypatch.setattr(cuda, "MAX_GRADIENT_MEMORY_BYTES", memory)
        fn, point = value_and_gradient(
            make_flying_sim(ACCELERATOR, 100, control="attitude"), n_steps=100, of_params=True
        )
        result.append(floating_leaves(jax.jit(fn)(point)))
    assert trees_equal(result[0], result[1])
    assert trees_equal(result[0], result[2])


def test_a_vmapped_gradient_equals_gradients_one_by_one():
    fn, point = value_and_gradient(make_flying_sim(ACCELERATOR, 5, control="attitude"), n_steps=10)
    many = jax.tree.map(lambda x: jnp.stack([x, 1.01 * x, 0.99 * x]), point)
    result = floating_leaves(jax.jit(jax.vmap(fn))(many))
    for k in range(3):
        assert_agree(
            [x[k] for x in result], floating_leaves(jax.jit(fn)(jax.tree.map(lambda x, k=k: x[k], many))), 1e-6
        )


@pytest.mark.parametrize("n_drones", [1, 12])
def test_the_gradient_runs_where_the_state_is(n_drones):
    """The step may have been planned for another platform than that of the state.

    Kernels on the CPU support up to 8 drones that interact: 12 drones run without one.
    """
    sims = {name: make_flying_sim(name, 2, n_drones, control="attitude") for name in NAMES}
    for sim in sims.values():
        insert_fn_before(sim.step_pipeline, "integration", repulsion)
    result = {}
    for planned, sim in sims.items():
        for name in NAMES:
            step = Step(sim.step_pipeline, "fused", "cpu" if planned == "cpu" else "gpu")
            data = jax.device_put(sim.data, DEVICES[name])

            def loss(vel, step=step, data=data):
                return jnp.sum(step(data.replace(states=data.states.replace(vel=vel)), 10).states.pos ** 2)

            result[planned, name] = require_device(name, jax.jit(jax.grad(loss))(data.states.vel))
    expected = result["cpu", "cpu"]
    assert np.any(np.asarray(expected))
    for x in result.values():
        assert_agree(x, expected, 1e-5)


def test_gradients_of_images_agree_with_the_cpu():
    """Of pixels weighted at random, in 64 worlds. Rounding may move a pixel over an edge, in few worlds."""

    def run(device):
        sim = Sim(64, control="attitude", device=device)
        ball = sim.scene.add("sphere", pos=(1.5, 0.0, 1.0), radius=0.3, rgba=(0.8, 0.4, 0.1, 1))
        sim.scene.add("pole", count=2, pos=[(2.0, -0.7, 0), (2.5, 0.8, 0)], mocap=False)
        rng = np.random.default_rng(0)
        pos, ball_pos = (np.float32(x + rng.uniform(-0.2, 0.2, (64, 1, 3))) for x in ([0, 0, 1], [1.5, 0, 1]))
        depth, color = (np.float32(rng.uniform(size=(64, 1, 12, 16, *n))) for n in ((), (3,)))
        take = Camera(16, 12, outputs=("depth", "rgb"), max_depth=5.0, color_gradients=True).image_fn(sim)

        def weighted_sum(point):
            data = sim.data.replace(states=sim.data.states.replace(pos=point[0]))
            images = take(ball.set_pose(data, pos=point[1]))
            return jnp.sum(depth * images["depth"]) + jnp.sum(color * images["rgb"])

        point = jax.device_put((pos, ball_pos), DEVICES[device])
        return require_device(device, jax.jit(jax.grad(weighted_sum))(point))

    expected, result = (jax.device_get(run(name)) for name in NAMES)
    for x, y in zip(result, expected, strict=True):
        assert np.abs(y).max(axis=(1, 2)).min() > 0.1
        agrees = np.abs(x - y).max(axis=(1, 2)) < 1e-3 * np.abs(y).max(axis=(1, 2))
        assert agrees.mean() > 0.9
