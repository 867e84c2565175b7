"""Parity: flights recorded from Crazyflow 0.4.0 in float64, flown again here as the worlds of one batch."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import PAIRS, with_airframes

from crazysim import Sim, load_airframe
from crazysim.core.integration import apply_derivative
from crazysim.core.pipeline import replace_fn
from crazysim.core.stage import stage

FOLDER = Path(__file__).parent
FILES = sorted(path.stem for path in FOLDER.glob("*.npz"))
SLOW = {  # the recorded rates of the flights whose controllers are slower than the step
    "state": {"state_freq": 50, "attitude_freq": 250, "force_torque_freq": 250},
    "attitude": {"attitude_freq": 100, "force_torque_freq": 500},
}


def flights(stem):
    """Return the recordings of a file as {variant: {airframe: {what: array}}}."""
    tree = {}
    with np.load(FOLDER / f"{stem}.npz") as file:
        for key in file.files:
            variant, airframe, what = key.split("/")
            tree.setdefault(variant, {}).setdefault(airframe, {})[what] = file[key]
    return tree


CASES = [(stem, variant) for stem in FILES for variant in flights(stem)]


def test_every_command_level_and_dynamics_is_recorded():
    """Without recordings the tests below would have no cases."""
    recorded = {tuple(stem.split("-")) for stem in FILES}
    assert recorded == set(PAIRS)
    assert {variant.removesuffix("-slow") for _, variant in CASES} == {"euler", "symplectic_euler", "rk4"}
    assert len(CASES) == 25


def peers_rk4(data, deriv_fn):
    """Average body rates as the peer does, which leaves the attitude at order 2; everything else as ours."""
    dt = 1 / data.core.freq
    k1 = deriv_fn(data)
    k2 = deriv_fn(apply_derivative(data, k1, dt / 2))
    k3 = deriv_fn(apply_derivative(data, k2, dt / 2))
    k4 = deriv_fn(apply_derivative(data, k3, dt))
    mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
    return apply_derivative(data, mean, dt)


def fly(stem, variant, as_the_peer=True):
    """Fly every airframe and start of a recording as a world of its own; return samples and the recording."""
    dynamics, control = stem.split("-")
    integrator = variant.removesuffix("-slow")
    recorded = flights(stem)[variant]
    n_starts = next(iter(recorded.values()))["start_pos"].shape[0]
    airframes = [load_airframe(name) for name in recorded for _ in range(n_starts)]
    rates = SLOW[control] if variant.endswith("-slow") else {}
    sim = Sim(
        n_worlds=len(airframes),
        drone=airframes[0],
        dynamics=dynamics,
        control=control,
        integrator=integrator,
        controller="crazyflow",
        **rates,
    )
    if integrator == "rk4" and as_the_peer:
        deriv_fn = sim.step_pipeline["integration"].fn.deriv_fn
        replace_fn(sim.step_pipeline, stage("drone")(partial(peers_rk4, deriv_fn=deriv_fn)), "integration")
    step = sim.build_step_fn()

    def start(what):
        return jnp.asarray(np.concatenate([flight[what] for flight in recorded.values()]), dtype=float)

    data = with_airframes(sim, airframes)
    states = data.states.replace(
        **{f: start(f"start_{f}") for f in ("pos", "quat", "vel", "ang_vel", "rotor_vel")},
        force=start("force"),
        torque=start("torque"),
    )
    sim.data = data.replace(states=states)
    getattr(sim, f"{control}_control")(start("command"))
    data, samples, at = sim.data, [], 0
    for step_count in next(iter(recorded.values()))["steps"]:
        data = step(data, jnp.int32(int(step_count) - at))
        at = int(step_count)
        samples.append(jax.tree.map(np.asarray, data.states))
    mine = {f: np.stack([getattr(s, f) for s in samples]) for f in ("pos", "quat", "vel", "ang_vel", "rotor_vel")}
    theirs = {f: np.concatenate([flight[f] for flight in recorded.values()], axis=1) for f in mine}
    noise = {f: np.max([flight[f"float32_error_{f}"] for flight in recorded.values()]) for f in mine}
    return mine, theirs, noise


def aligned(quat, like):
    """Return the quaternions with the sign that lies nearer to others: q and -q are one attitude."""
    return np.where(np.sum(quat * like, axis=-1, keepdims=True) < 0, -quat, quat)


@pytest.mark.parametrize(("stem", "variant"), CASES)
def test_float64_agrees_with_the_peer(stem, variant, x64):
    """In float64 the two programs evaluate the same equations: position and attitude agree to 1e-6."""
    mine, theirs, _ = fly(stem, variant)
    assert np.max(np.abs(mine["pos"][-1] - mine["pos"][0])) > 0.01, "nothing moved: the flight shows nothing"
    np.testing.assert_allclose(mine["pos"], theirs["pos"], atol=1e-6, rtol=0)
    np.testing.assert_allclose(aligned(mine["quat"], theirs["quat"]), theirs["quat"], atol=1e-6, rtol=0)
    np.testing.assert_allclose(mine["vel"], theirs["vel"], atol=1e-5, rtol=0)
    np.testing.assert_allclose(mine["ang_vel"], theirs["ang_vel"], atol=1e-4, rtol=0)


@pytest.mark.parametrize(("stem", "variant"), [case for case in CASES if case[1] == "euler"])
def test_float32_is_as_near_to_float64_as_the_peers_own(stem, variant):
    """Rounding in another order gives other digits, not larger ones: at most thrice the peer's own distance.

    The recorded distance is the largest over a second, airframes and starts; one unit in the last place of
    a position of 2 m (2.4e-7) a step is granted where the peer happened to round luckily.
    """
    mine, theirs, noise = fly(stem, variant)
    assert mine["pos"].dtype == np.float32
    mine["quat"] = aligned(mine["quat"], theirs["quat"])
    for field in ("pos", "quat"):
        assert np.max(np.abs(mine[field] - theirs[field])) <= 3 * noise[field] + 500 * 2.4e-7, field


def test_our_rk4_differs_from_the_peers_by_its_order_in_attitude_only(x64):
    """The commutators of our Runge-Kutta are a correction of second order in the step, and not nothing."""
    mine, theirs, _ = fly("first_principles-attitude", "rk4", as_the_peer=False)
    apart = np.max(np.abs(aligned(mine["quat"], theirs["quat"]) - theirs["quat"]))
    assert 1e-9 < apart < 1e-3
