"""Law 8: physics keeps its invariants, and integrators show their order."""

import jax
import numpy as np
import pytest
from cases import with_states
from scipy.spatial.transform import Rotation

from crazysim.lab.validate.closed_forms import free_body, free_fall_error
from crazysim.lab.validate.peers import mujoco_differences

INTEGRATORS = ("euler", "symplectic_euler", "rk4")


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_free_fall_equals_the_integrators_closed_form(integrator, x64):
    """Under constant acceleration each scheme has a sum in closed form: v0 t + g t^2/2, minus or plus g t dt/2."""
    # 500 additions of numbers near 100, each rounded to 1.4e-14
    assert free_fall_error(integrator) < 500 * 1.5e-14


def precession_errors(integrator, freq):
    """Return relative errors of angular momentum (world frame) and energy after 0.5 s of torque-free tumbling."""
    ang_vel = np.array([4.0, 1.0, 7.0])
    inertia = np.diag([2e-5, 3e-5, 5e-5])
    sim = free_body(integrator, freq, ang_vel, inertia)
    sim.step(freq // 2)
    s = jax.tree.map(lambda x: np.asarray(x)[0, 0], sim.data.states)
    momentum = Rotation.from_quat(s.quat).apply(inertia @ s.ang_vel)
    before = inertia @ ang_vel
    energy = s.ang_vel @ inertia @ s.ang_vel / (ang_vel @ before) - 1
    return np.linalg.norm(momentum - before) / np.linalg.norm(before), abs(energy)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_torque_free_precession_keeps_momentum_and_energy_to_order(integrator, x64):
    """The drift is the integration error, which shrinks by 2^order when the step is halved."""
    order = {"euler": 1, "rk4": 4}[integrator]
    coarse, fine = precession_errors(integrator, 250), precession_errors(integrator, 500)
    for drift_coarse, drift_fine in zip(coarse, fine, strict=True):
        assert drift_fine < 1e-1
        assert np.log2(drift_coarse / drift_fine) > order - 0.4


SPINS = (  # free rotations at 60 rad/s: about each axis with a wobble of 0.5 rad/s, and tumbling about none
    (60.0, 0.5, 0.0), (0.5, 60.0, 0.0), (0.5, 0.0, 60.0), (0.3, -0.4, -60.0), (30.0, 20.0, 47.96), (-40.0, 40.0, 20.0)
)  # fmt: skip


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_torque_free_spins_gain_no_energy(integrator):
    """In ten seconds at 60 rad/s, energy never rises by 1%, and a wobble about z or x does not grow.

    Plain explicit Euler would multiply the wobble about z by 175 in two seconds. Half of the worlds have a full inertia
    matrix.
    """
    axes = np.array(Rotation.from_rotvec([0.4, -0.7, 0.5]).as_matrix())
    inertias = [np.diag([25e-6, 28e-6, 49e-6]), axes @ np.diag([25e-6, 28e-6, 49e-6]) @ axes.T]
    bodies = [(J, frame @ spin) for J, frame in zip(inertias, (np.eye(3), axes), strict=True) for spin in SPINS]
    sim = free_body(integrator, n_worlds=len(bodies), gravity=False)
    J = np.array([body[0] for body in bodies])
    params = sim.data.params.replace(J=np.float32(J[:, None]), J_inv=np.float32(np.linalg.inv(J)[:, None]))
    start = np.array([body[1] for body in bodies])
    sim.data = with_states(sim.data.replace(params=params), ang_vel=start[:, None])
    before, max_energy_ratio = np.einsum("ni,nij,nj->n", start, J, start), 0.0
    for _ in range(20):
        sim.step(sim.freq // 2)
        ang_vel = np.asarray(sim.data.states.ang_vel, np.float64)[:, 0]
        max_energy_ratio = np.maximum(max_energy_ratio, np.einsum("ni,nij,nj->n", ang_vel, J, ang_vel) / before)
    assert np.all(max_energy_ratio < 1.01), max_energy_ratio
    in_axes = np.concatenate([ang_vel[: len(SPINS)], ang_vel[len(SPINS) :] @ axes])
    for world, spin_axis in ((0, 0), (2, 2), (3, 2), (6, 0), (8, 2), (9, 2)):
        assert np.linalg.norm(np.delete(in_axes[world], spin_axis)) < 0.55, world


def test_a_free_body_under_a_wrench_agrees_with_mujoco():
    """MuJoCo and crazysim, both with Runge-Kutta of order 4, move a free body under a wrench in the world frame.

    With steps of 1 ms, position and attitude agree to 1e-8 after 0.5 s.
    """
    difference = mujoco_differences()
    assert max(difference["pos"], difference["vel"], difference["quat"]) < 1e-8
    assert difference["ang_vel"] < 1e-7
