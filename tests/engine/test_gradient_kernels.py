"""Gradients of steps in a kernel equal gradients of the unfused stages, also in vmap and in higher derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import PAIRS, centre, gap, needs_compiler, repulsion, shared_sim

from crazysim import Sim, stage
from crazysim.core import functional as F
from crazysim.core.pipeline import insert_fn_before
from crazysim.engine import Step, explain
from crazysim.engine.backends import cuda, interpret, kernel, native, reverse
from crazysim.engine.backends.frame import Kernel
from crazysim.engine.ir.verify import verify, verify_block
from crazysim.engine.lowering.jaxprs import lower_function
from crazysim.engine.lowering.tangents import add_block_tangents, add_tangents
from crazysim.engine.lowering.transpose import transpose_block
from crazysim.errors import EngineWarning

COMMAND = np.array([0.05, -0.08, 0.1, 1.02 * 0.0434 * 9.81])


def make_losses(n_worlds=3, n_drones=1, stages=(), n_steps=7):
    """Return (losses, step, data) for kernels and for the plain stages, and the point to evaluate the losses at.

    The losses are a function of commands and velocities, (n_worlds,). The dynamics are those that compile fastest;
    ``tests/laws/test_gradients.py`` has the others.
    """
    result = []
    for engine in ("fused", "plain"):
        sim = Sim(n_worlds, n_drones, dynamics="so_rpy", engine=engine)
        for stage_fn in stages:
            insert_fn_before(sim.step_pipeline, "integration", stage_fn)
        phases = jnp.arange(n_worlds * n_drones * 3.0).reshape(n_worlds, n_drones, 3)
        start = sim.data.replace(states=sim.data.states.replace(pos=sim.data.states.pos + jnp.sin(phases)))
        step = Step(sim.step_pipeline, engine)

        def losses(x, step=step, start=start, mass=sim.data.params.mass):
            cmd, vel = x
            params = start.params.replace(mass=mass)
            data = start.replace(states=start.states.replace(vel=vel), params=params)
            s = step(F.attitude_control(data, cmd), n_steps).states
            return jnp.sum(s.pos * jnp.array([1.0, -2.0, 3.0]) + 0.5 * s.vel**2 + s.quat[..., :3], (1, 2))

        result.append((losses, step, sim.data))
    rng = np.random.default_rng(0)
    point = np.tile(COMMAND, (n_worlds, n_drones, 1)), rng.normal(size=(n_worlds, n_drones, 3))
    return result, jax.tree.map(jnp.asarray, point)


def assert_close(computed, expected):
    for a, b in zip(jax.tree.leaves(computed), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * max(np.max(np.abs(b)), 1e-3))


def jit_gradient(losses):
    return jax.jit(jax.grad(lambda x: jnp.sum(losses(x))))


OPERATIONS = {
    "products": lambda x, y: x * y / (1.0 + y * y) - x,
    "functions": lambda x, y: jnp.sin(x) * jnp.exp(-y) + jnp.sqrt(x * x + 1.0) + jnp.arctan2(x, y),
    "selections": lambda x, y: jnp.where(x > y, x * y, jnp.maximum(x, 2.0 * y)) + jnp.clip(x, -0.5, 0.5) + jnp.abs(y),
    "loop": lambda x, y: jax.lax.fori_loop(0, 50, lambda _, z: jnp.cos(z) * y, x),  # in several parts
    "custom derivative": lambda x, y: jax.nn.relu(x) * jax.nn.softplus(y) + jax.nn.silu(x * y),
    "zero derivative": lambda x, y: jnp.floor(x) + jax.lax.stop_gradient(y) * x,
}


LOOPS = {
    "loop": OPERATIONS["loop"],
    "several numbers": lambda x, y: sum(
        jax.lax.fori_loop(0, 6, lambda i, c: (jnp.sin(c[1]) * y, c[0] + x * i, c[2]), (x, y, x * y))
    ),
    "branches": lambda x, y: jax.lax.fori_loop(
        0, 5, lambda i, z: jax.lax.cond(z > y, lambda z: jnp.cos(z) * x, lambda z: z + y * z, z), x * y
    ),
    "nested": lambda x, y: jax.lax.fori_loop(
        0, 4, lambda i, z: jax.lax.fori_loop(0, 3, lambda j, w: jnp.sin(w) * x + y, z * y), x
    ),
    "one that no input enters": lambda x, y: x * y * jax.lax.fori_loop(0, 5, lambda i, z: jnp.cos(z), 1.0),
}


def branching(x, y):
    """Use what only forward mode supports: a loop with a computed number of iterations, and a loop over an integer."""
    z = jax.lax.while_loop(lambda c: c[0] < 3.0, lambda c: (c[0] + 1.0 + y * y, jnp.sin(c[1]) * y), (jnp.abs(x), x))[1]
    return z + jax.lax.fori_loop(0, 5, lambda i, n: n + i, jnp.int32(0)) * x


@pytest.mark.parametrize("fn", [*OPERATIONS.values(), branching], ids=[*OPERATIONS, "branching"])
def test_tangents_of_a_block_equal_those_of_jax(fn, x64):
    """The tangents are with respect to both operands, or to the second operand only."""
    block = lower_function(fn, *[jax.ShapeDtypeStruct((), jnp.float64)] * 2)
    push_forward = jax.jit(functools.partial(jax.jvp, jax.vmap(fn)))
    x, y, dx, dy = np.random.default_rng(1).normal(size=(4, 16))
    for indices, direction in (((0, 1), (dx, dy)), ((1,), (np.zeros(16), dy))):
        extended_block = add_block_tangents(block, [block.inputs[k] for k in indices])
        verify_block(extended_block)
        result = interpret.run_block(extended_block, [x, y, *(direction[k] for k in indices)], (16,))
        for a, b in zip(result, push_forward((x, y), direction), strict=True):
            np.testing.assert_allclose(np.broadcast_to(a, 16), b, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("name", LOOPS)
def test_a_loop_is_reversed_as_a_loop_like_by_jax(name, x64, monkeypatch):
    monkeypatch.setattr("crazysim.engine.lowering.transpose.MAX_UNROLLED_OPERATIONS", 0)
    check_transposed_block(LOOPS[name])


@pytest.mark.parametrize("fn", OPERATIONS.values(), ids=OPERATIONS)
def test_a_transposed_block_equals_the_vjp_of_jax(fn, x64):
    check_transposed_block(fn)


def check_transposed_block(fn):
    block = lower_function(fn, *[jax.ShapeDtypeStruct((), jnp.float64)] * 2)
    x, y, ct = np.random.default_rng(1).normal(size=(3, 16))
    transposed = transpose_block(block, block.inputs)
    verify_block(transposed)
    result = interpret.run_block(transposed, [x, y, ct], (16,))
    for a, b in zip(result, jax.jit(lambda x, y, ct: jax.vjp(jax.vmap(fn), x, y)[1](ct))(x, y, ct), strict=True):
        np.testing.assert_allclose(np.broadcast_to(a, 16), b, rtol=1e-13, atol=1e-14)


@pytest.mark.long("compiles gradients as kernels, and by XLA to compare")
@needs_compiler
def test_a_kernel_computes_the_gradient(x64, monkeypatch):
    """Gradients are repeatable to the bit, also in intervals, and for batches of worlds."""
    ((fast, step, data), (plain, *_)), point = make_losses(n_steps=10, n_drones=2)
    kernel_gradient, plain_gradient = jit_gradient(fast), jit_gradient(plain)
    result, expected = kernel_gradient(point), plain_gradient(point)
    assert "gradient: one kernel" in explain(step, data)
    assert_close(result, expected)
    for a, b in zip(result, kernel_gradient(point), strict=True):
        np.testing.assert_array_equal(a, b)

    monkeypatch.setattr(native, "GRADIENT_MEMORY_BYTES", 0)
    ((in_intervals, step, data), _), _ = make_losses(n_steps=10, n_drones=2)
    assert_close(jit_gradient(in_intervals)(point), expected)
    assert "gradient: one kernel" in explain(step, data)

    points = jax.tree.map(lambda x: jnp.stack([x, 1.1 * x]), point)
    other = plain_gradient(jax.tree.map(lambda x: 1.1 * x, point))
    expected = jax.tree.map(lambda *x: jnp.stack(x), expected, other)
    assert_close(jax.vmap(jit_gradient(in_intervals))(points), expected)
    assert_close(jit_gradient(jax.vmap(in_intervals))(points), expected)
    assert "lanes" not in explain(step, data)


@pytest.mark.long("compiles kernels with many tangents")
@needs_compiler
def test_a_kernel_computes_tangents(x64):
    ((fast, step, data), (plain, *_)), point = make_losses(n_steps=3, n_drones=2)
    jacobian = lambda losses: jax.jit(jax.jacfwd(lambda x, mass: losses(x, mass=mass), (0, 1)))  # noqa: E731
    mass = data.params.mass
    expected = jacobian(plain)(point, mass)
    assert_close(jacobian(fast)(point, mass), expected)
    slope = jax.jit(lambda mass, direction: jax.jvp(lambda mass: fast(point, mass=mass), (mass,), (direction,))[1])
    assert_close(slope(mass, 3.0 * mass), 3.0 * expected[1] @ mass)
    descriptions = [line for line in explain(step, data).splitlines() if "jvp" in line]
    assert descriptions
    assert all(line.startswith("jvp: one kernel") for line in descriptions)
    _, tangent = jax.linearize(lambda vel: fast((point[0], vel)), point[1])
    assert_close(jax.jit(tangent)(point[1]), jnp.einsum("wvdi,vdi->w", expected[0][1], point[1]))


@pytest.mark.long("compiles second derivatives")
@needs_compiler
def test_second_derivatives_are_those_of_lanes(x64):
    pairs, (cmd, vel) = make_losses(n_worlds=1, n_steps=1)

    def second_derivatives(losses):
        loss = lambda x: jnp.sum(losses((cmd, x)))  # noqa: E731
        forward = lambda x: jax.jvp(loss, (x,), (vel,))[1]  # noqa: E731
        return jax.jit(lambda x: [jax.jvp(fn, (x,), (vel,))[1] for fn in (forward, jax.grad(loss))])(vel)

    assert_close(*(second_derivatives(losses) for losses, *_ in pairs))


@needs_compiler
@pytest.mark.long("compiles derivatives in both directions, as a kernel and by XLA")
def test_drones_that_act_on_each_other_are_differentiated_in_the_kernel(x64):
    ((fast, step, data), (plain, *_)), point = make_losses(n_drones=3, stages=[repulsion, centre, gap], n_steps=4)
    gradient = jit_gradient(plain)(point)
    assert_close(jit_gradient(fast)(point), gradient)
    direction = jax.tree.map(jnp.sin, point)
    slope = jax.jit(lambda x: jax.jvp(fast, (x,), (direction,))[1])(point)
    assert_close(slope, sum(jnp.sum(a * b, (1, 2)) for a, b in zip(gradient, direction, strict=True)))
    assert [line.split(",")[0] for line in explain(step, data).splitlines()[-2:]] == [
        "gradient: one kernel",
        "jvp: one kernel",
    ]


@stage("drone")
def long_loop(data):
    x, _ = jax.lax.scan(lambda x, _: (jnp.sin(x) + 1e-3 * x, None), data.states.pos[0], length=3000)
    return data.replace(states=data.states.replace(force=jnp.zeros(3).at[1].set(1e-2 * x)))


@pytest.mark.long("compiles a gradient in two engines")
@needs_compiler
def test_programs_without_a_kernel_are_differentiated_on_lanes(x64):
    ((fast, step, data), (plain, *_)), point = make_losses(stages=[long_loop], n_steps=1)
    with pytest.warns(EngineWarning, match="the gradient of the step runs on 'lanes'"):
        result = jit_gradient(fast)(point)
    assert_close(result, jit_gradient(plain)(point))
    assert "a loop of 3000 iterations is too long to be reversed" in explain(step, data)


@pytest.mark.parametrize(("dynamics", "control"), [PAIRS[0], PAIRS[-1]])
def test_the_derivatives_of_every_pipeline_compile_for_a_gpu(dynamics, control):
    if cuda.nvrtc() is None:
        pytest.skip("no NVRTC here; CI has it")
    sim = shared_sim(n_worlds=2, n_drones=3, dynamics=dynamics, control=control)
    program = Step(sim.step_pipeline, "fused", "gpu").plan(sim.data).program
    reverse_program = reverse.reverse_program(
        program, [i for i, leaf in enumerate(program.leaves) if leaf.scope == "drone"]
    )
    text = cuda.ptx(reverse.write_kernel(reverse_program, "cuda"), cuda.DEFAULT_ARCHITECTURE)
    stored = sum(program.leaves[i].size for i in reverse_program.perturbed) + len(reverse_program.carry)
    assert text.count("st.global") >= stored
    tangent_program = add_tangents(program, reverse_program.perturbed)
    verify(tangent_program)
    assert all(tangent_program.leaves[i].name.startswith("tangent of ") for i in tangent_program.written_leaves)
    assert "st.global" in cuda.ptx(kernel.write_kernel(tangent_program, "cuda"), cuda.DEFAULT_ARCHITECTURE)


def mix(data):
    """Push all drones by their mean velocity, as an undeclared stage of all worlds."""
    force = -0.1 * jnp.mean(data.states.vel, axis=(0, 1))
    return data.replace(states=data.states.replace(force=jnp.broadcast_to(force, data.states.force.shape)))


@pytest.mark.long("compiles both derivatives of two parts as kernels, and of plain stages to compare")
@needs_compiler
def test_an_unfused_stage_splits_the_gradient_into_kernels_too(x64):
    ((fast, step, data), (plain, *_)), point = make_losses(stages=(mix,), n_steps=3)
    points = jax.tree.map(lambda x: jnp.stack([x, 1.1 * x]), point)
    results = [
        jax.jit(lambda losses=losses: (
            jit_gradient(losses)(point), jax.jvp(losses, (point,), (point,)), jax.vmap(jit_gradient(losses))(points)
        ))()
        for losses in (fast, plain)
    ]  # fmt: skip
    assert_close(*results)
    lines = explain(step, data).splitlines()
    assert "splits the step: 'mix' is not fused: it is not declared for one drone or one world" in lines
    assert not [line for line in lines if line.startswith(("gradient: on lanes", "jvp: on lanes"))]
    assert [line for line in lines if line.startswith("gradient: one kernel")]


def test_the_gradient_is_that_of_the_platform_that_jax_compiles_for():
    """The gradient is a kernel or runs on lanes; a kernel of the CPU supports up to 8 drones that act on each other."""
    if cuda.nvrtc() is None:
        pytest.skip("no NVRTC here; CI has it")
    for n_drones, planned_for in ((1, "cpu"), (1, "gpu"), (9, "gpu")):
        sim = Sim(2, n_drones, control="rotor_vel")
        insert_fn_before(sim.step_pipeline, "integration", repulsion)
        step = Step(sim.step_pipeline, "fused", planned_for)

        def loss(vel, step=step, data=sim.data):
            return jnp.sum(step(data.replace(states=data.states.replace(vel=vel)), 2).states.pos ** 2)

        traced = jax.jit(jax.grad(loss)).trace(sim.data.states.vel)
        counts = []
        for platform in ("cuda", "cpu"):
            text = traced.lower(lowering_platforms=(platform,)).as_text()
            counts.append([text.count(name) for name in (cuda.PTX_TARGET, "crazysim_advance")])
        forward_and_back, kernels_of_cpu = 2, 2 if n_drones == 1 else 1
        assert counts == [[forward_and_back, 0], [0, kernels_of_cpu]]
        descriptions = [line for line in explain(step, sim.data).splitlines() if line.startswith("gradient: ")]
        assert descriptions[0].startswith("gradient: one kernel, compiled for compute_90")
        assert descriptions[1].startswith(
            "gradient: one kernel, compiled by" if n_drones == 1 else "gradient: on lanes ("
        )


@pytest.mark.parametrize(
    ("n_lanes", "n_steps", "n_blocks", "interval"),
    [(100, 10, 2, 10), (2**20, 100, 2**14 // 2, 100), (2**20, 1000, 2**14 // 2, 32), (100, 0, 2, 1)],
)
def test_a_gradient_on_a_gpu_has_limited_memory(n_lanes, n_steps, n_blocks, interval):
    """If 2**20 lanes ran at once, 24 numbers of 100 states would take 10 GB, and of 32 + 32 states 6 GB."""
    kernel = Kernel("", (), (), state_bytes=24 * 4)
    blocks, count, (memory,) = cuda._plan_memory(kernel, n_lanes, n_steps)
    assert blocks * kernel.lanes * -(-n_lanes // (blocks * kernel.lanes)) >= n_lanes
    assert count.tolist() == [n_steps, interval]
    n_states = interval + max(-(-n_steps // interval), 1)
    assert memory.shape == (blocks, n_states * 24 * kernel.threads)
    assert memory.size * 4 <= cuda.MAX_GRADIENT_MEMORY_BYTES


@pytest.mark.long("compiles tangents in two engines")
@needs_compiler
def test_forward_mode_takes_a_number_of_steps_that_is_an_array(x64):
    ((fast, *_), (plain, *_)), point = make_losses(n_steps=jnp.int32(3))
    assert_close(jax.jvp(fast, (point,), (point,)), jax.jvp(plain, (point,), (point,)))
