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
from crazysim.engine.stage import stage

FOLDER = Path(__file__).parent
FILES = sorted(path.stem for path in FOLDER.glob("*.npz"))
SLOW_RATES = {  # the recorded rates of the flights whose controllers are slower than the step
    "state": {"state_freq": 50, "attitude_freq": 250, "force_torque_freq": 250},
    "attitude": {"attitude_freq": 100, "force_torque_freq": 500},
}


def load_recordings(stem):
    """Return the recordings of a file as {variant: {airframe: {field: array}}}."""
    tree = {}
    with np.load(FOLDER / f"{stem}.npz") as file:
        for key in file.files:
            variant, airframe, field = key.split("/")
            tree.setdefault(variant, {}).setdefault(airframe, {})[field] = file[key]
    return tree


CASES = [(stem, variant) for stem in FILES for variant in load_recordings(stem)]


def test_every_command_level_and_dynamics_is_recorded():
    """Without recordings the tests below would have no cases."""
    recorded = {tuple(stem.split("-")) for stem in FILES}
    assert recorded == set(PAIRS)
    assert {variant.removesuffix("-slow") for _, variant in CASES} == {"euler", "symplectic_euler", "rk4"}
    assert len(CASES) == 25


def crazyflow_rk4(data, deriv_fn):
    """Integrate as Crazyflow does: it averages body rates, so attitude has order 2. The rest is as in crazysim."""
    dt = 1 / data.core.freq
    k1 = deriv_fn(data)
    k2 = deriv_fn(apply_derivative(data, k1, dt / 2))
    k3 = deriv_fn(apply_derivative(data, k2, dt / 2))
    k4 = deriv_fn(apply_derivative(data, k3, dt))
    mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
    return apply_derivative(data, mean, dt)


def fly(stem, variant, with_crazyflow_rk4=True):
    """Fly every airframe and start of a recording in its own world."""
    dynamics, control = stem.split("-")
    integrator = variant.removesuffix("-slow")
    recorded = load_recordings(stem)[variant]
    n_starts = next(iter(recorded.values()))["start_pos"].shape[0]
    airframes = [load_airframe(name) for name in recorded for _ in range(n_starts)]
    rates = SLOW_RATES[control] if variant.endswith("-slow") else {}
    sim = Sim(
        n_worlds=len(airframes),
        drone=airframes[0],
        dynamics=dynamics,
        control=control,
        integrator=integrator,
        controller="crazyflow",
        **rates,
    )
    if integrator == "rk4" and with_crazyflow_rk4:
        deriv_fn = sim.step_pipeline["integration"].fn.deriv_fn
        replace_fn(sim.step_pipeline, stage("drone")(partial(crazyflow_rk4, deriv_fn=deriv_fn)), "integration")
    step = sim.build_step_fn()

    def start(field):
        return jnp.asarray(np.concatenate([flight[field] for flight in recorded.values()]), dtype=float)

    data = with_airframes(sim, airframes)
    states = data.states.replace(
        **{f: start(f"start_{f}") for f in ("pos", "quat", "vel", "ang_vel", "rotor_vel")},
        force=start("force"),
        torque=start("torque"),
    )
    sim.data = data.replace(states=states)
    getattr(sim, f"{control}_control")(start("command"))
    data, samples, n_done = sim.data, [], 0
    for step_count in next(iter(recorded.values()))["steps"]:
        data = step(data, jnp.int32(int(step_count) - n_done))
        n_done = int(step_count)
        samples.append(jax.tree.map(np.asarray, data.states))
    flown = {f: np.stack([getattr(s, f) for s in samples]) for f in ("pos", "quat", "vel", "ang_vel", "rotor_vel")}
    reference = {f: np.concatenate([flight[f] for flight in recorded.values()], axis=1) for f in flown}
    float32_errors = {f: np.max([flight[f"float32_error_{f}"] for flight in recorded.values()]) for f in flown}
    return flown, reference, float32_errors


def align_signs(quat, reference):
    """Return quaternions with the signs nearest to a reference, since q and -q are the same attitude."""
    return np.where(np.sum(quat * reference, axis=-1, keepdims=True) < 0, -quat, quat)


@pytest.mark.parametrize(("stem", "variant"), CASES)
def test_float64_agrees_with_crazyflow(stem, variant, x64):
    """In float64 the two programs evaluate the same equations: position and attitude agree to 1e-6."""
    flown, reference, _ = fly(stem, variant)
    assert np.max(np.abs(flown["pos"][-1] - flown["pos"][0])) > 0.01, "nothing moved: the flight shows nothing"
    np.testing.assert_allclose(flown["pos"], reference["pos"], atol=1e-6, rtol=0)
    np.testing.assert_allclose(align_signs(flown["quat"], reference["quat"]), reference["quat"], atol=1e-6, rtol=0)
    np.testing.assert_allclose(flown["vel"], reference["vel"], atol=1e-5, rtol=0)
    np.testing.assert_allclose(flown["ang_vel"], reference["ang_vel"], atol=1e-4, rtol=0)


@pytest.mark.parametrize(("stem", "variant"), [case for case in CASES if case[1] == "euler"])
def test_float32_is_as_near_to_float64_as_that_of_crazyflow(stem, variant):
    """Errors from rounding are at most three times those of Crazyflow, whose operations have another order.

    The recorded error is the largest of all airframes and starts in one second. One unit in the last place of a
    position of 2 m (2.4e-7) per step is added, in case the errors of Crazyflow are small by chance.
    """
    flown, reference, float32_errors = fly(stem, variant)
    assert flown["pos"].dtype == np.float32
    flown["quat"] = align_signs(flown["quat"], reference["quat"])
    for field in ("pos", "quat"):
        assert np.max(np.abs(flown[field] - reference[field])) <= 3 * float32_errors[field] + 500 * 2.4e-7, field


def test_rk4_differs_from_that_of_crazyflow_by_its_order_in_attitude_only(x64):
    """The commutators in crazysim's Runge-Kutta are a correction of second order in the step, and not zero."""
    flown, reference, _ = fly("first_principles-attitude", "rk4", with_crazyflow_rk4=False)
    difference = np.max(np.abs(align_signs(flown["quat"], reference["quat"]) - reference["quat"]))
    assert 1e-9 < difference < 1e-3
