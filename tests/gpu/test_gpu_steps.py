"""Steps and queries of the scene on an accelerator, compared with the CPU, and laws of CONTRIBUTING.md there."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sweep
from cases import send, trees_equal
from on_devices import ACCELERATOR, NAMES, require_device
from sweep import ROUNDING, assert_agree, make_flying_sim

from crazysim import Downwash, Kalman, Sim, Wind

N_STEPS = 100
FALLBACK_TESTS = "law_01 or law_10 or on_each_other_are_differentiated or tangents or shared_parameters"
"""Expression of pytest that selects tests with all kinds of kernels."""


def run_on_both(run):
    expected, result = (require_device(name, run(name)) for name in NAMES)
    return result, expected


@pytest.mark.parametrize("name", sweep.CASES)
def test_simulations_agree_with_the_cpu(name):
    def run(device):
        sim = sweep.CASES[name](device=device)
        lines = sim.explain().splitlines()
        assert lines[0] == "engine: fused"
        assert lines[-1].startswith("kernel: ") or name in sweep.SPLIT_CASES
        sim.step(40 if name == "impact" else N_STEPS)
        return sim.data

    assert_agree(*run_on_both(run), sweep.TOLERANCES.get(name, ROUNDING))


@pytest.mark.parametrize("n_drones", [3, 33, 256])
def test_drones_that_act_on_each_other_fly_as_on_the_cpu(n_drones):
    """3 drones exchange numbers within a warp, 33 within a block with unused threads, and 256 within a full block."""

    def run(device):
        sim = make_flying_sim(device, 4, n_drones, [Downwash()], control="attitude")
        sim.step(20)
        return sim.data

    assert_agree(*run_on_both(run), ROUNDING)


def test_steps_in_float64_agree_with_the_cpu(x64):
    def run(device):
        sim = make_flying_sim(device, control="state")
        sim.step(N_STEPS)
        return sim.data

    assert_agree(*run_on_both(run), 1e-12)


def test_law_01_many_worlds_on_wide_blocks_fly_as_few():
    """A kernel longer than the instruction cache has blocks of 256 threads from 65,536 drones on."""
    few, many = (
        Sim(n, control="state", device=ACCELERATOR, estimator=Kalman.default(), rng_key=4) for n in (40, 2**16 + 7)
    )
    assert "64 threads a block, 256 from 65,536 drones on" in many.explain()
    few.step(N_STEPS)
    many.step(N_STEPS)
    assert trees_equal(few.data.states, jax.tree.map(lambda x: x[:40], many.data.states))
    assert float(jnp.abs(many.data.states.pos - many.default_data.states.pos).max()) < 0.5


def test_law_01_one_world_flies_as_among_many():
    many = make_flying_sim(ACCELERATOR, 100, control="state")
    start = many.data.states, many.data.controls.state.staged_cmd
    many.step(N_STEPS)
    single_sim = make_flying_sim(ACCELERATOR, 1, control="state")
    single_start = single_sim.data
    for world in (0, 37, 99):
        states, command = jax.tree.map(lambda x, w=world: x[w : w + 1], start)
        single_sim.data = send(single_start.replace(states=states), command)
        single_sim.step(N_STEPS)
        assert trees_equal(single_sim.data.states, jax.tree.map(lambda x, w=world: x[w : w + 1], many.data.states))


def test_law_07_a_world_that_is_not_finite_does_not_change_others():
    sim = make_flying_sim(ACCELERATOR, 100, plugins=[Downwash(), Wind(speed_20ft=7.7)], control="attitude")
    start = sim.data
    sim.step(N_STEPS)
    healthy = sim.data.states
    pos = start.states.pos.at[41, 1].set(jnp.nan)
    sim.data = start.replace(states=start.states.replace(pos=pos))
    sim.step(N_STEPS)
    assert np.flatnonzero(sim.data.core.nonfinite).tolist() == [41]
    others = np.arange(100) != 41
    assert trees_equal(*(jax.tree.map(lambda x: x[others], states) for states in (sim.data.states, healthy)))


def test_law_10_the_same_seed_gives_the_same_numbers():
    sims = [make_flying_sim(ACCELERATOR, n, plugins=[Wind(speed_20ft=7.7)], control="attitude") for n in (100, 100, 7)]
    for sim in sims:
        sim.step(N_STEPS)
    first, second, few = (sim.data.plugins for sim in sims)
    assert trees_equal(first, second)
    assert_agree(jax.tree.map(lambda x: x[:7], first["wind"].gust), few["wind"].gust, 0)


def test_queries_of_the_scene_agree_with_the_cpu():
    def run(device):
        sim = make_flying_sim(device, control="attitude")
        ball = sim.scene.add("sphere", pos=(0.0, 0.0, 1.5), radius=0.2)
        sim.scene.add("wall", pos=(3, 0, 0), length=20, height=20, mocap=False)
        sim.step(1)
        report, depth = sim.contact_report(), sim.depth(width=16, height=12)
        assert np.asarray(report.objects).any()
        sim.data = ball.set_pose(sim.data, pos=(0.0, 0.5, 1.5))
        moved = sim.contact_report(ball, floor=False)
        return report, depth, moved, sim.contacts()

    result, expected = run_on_both(run)
    has_depth = [np.isfinite(x[1]) for x in (result, expected)]
    assert_agree(*has_depth, 0)
    assert_agree(*(jax.tree.map(lambda x: jnp.where(jnp.isinf(x), 0, x), x) for x in (result, expected)), 1e-5)


def test_kernels_are_launched_without_the_custom_call_of_xla():
    """With CRAZYSIM_JAX_FALLBACKS=1 a handler in Python launches all kernels."""
    tests = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, "-m", "pytest", str(tests), "-p", "no:cacheprovider", "-n", "0", "-k", FALLBACK_TESTS],
        env={k: v for k, v in os.environ.items() if "PYTEST" not in k} | {"CRAZYSIM_JAX_FALLBACKS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
