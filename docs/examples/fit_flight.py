"""Identify mass, inertia and thrust curve of a drone from flight logs, by Gauss-Newton through the simulator.

The log is synthetic: a drone that is heavier and weaker than its data sheet, with the noise of motion capture and a
gyroscope. Every flight is a world. Scaling mass, inertia and thrust by a common factor changes the flight only through
the drag of air and rotors, which is assumed to be known, so a common factor has a larger error than the ratios.
"""

import jax
import jax.numpy as jnp
import numpy as np

from crazysim import Sim, dynamics
from crazysim import functional as F

N_FLIGHTS, SECONDS, RATE = 8, 3.0, 100  # samples and commands per second
NOISE = {"pos": 1e-3, "quat": 2e-3, "ang_vel": 2e-2}  # m, 1, rad/s
SPEEDS = np.array([12e3, 16e3, 20e3])  # rpm; the values at these speeds define a parabola
ROUNDS = 6
NAMES = ["mass [g]", "Jxx [1e-6 kg m^2]", "Jyy [1e-6 kg m^2]", "Jzz [1e-6 kg m^2]"]
NAMES += [f"thrust at {speed / 1e3:.0f} krpm [mN]" for speed in SPEEDS]
UNITS = np.array([1e-3, 1e-6, 1e-6, 1e-6, 1e-3, 1e-3, 1e-3])
TRUE_OVER_DATA_SHEET = np.array([1.08, 1.15, 0.9, 1.1, 0.96, 0.95, 0.94])


def physical(params) -> jax.Array:
    """Return the unknowns: mass, three moments of inertia, thrust of a rotor at three speeds."""
    thrust = jnp.polyval(params.rpm2thrust[0, ::-1], SPEEDS)
    return jnp.concatenate([params.mass, jnp.diag(params.J), thrust])


def with_physical(params, x: jax.Array):
    """Return parameters with the values of ``physical``."""
    powers = (SPEEDS[:, None] / SPEEDS[1]) ** jnp.arange(3)
    curve = jnp.linalg.solve(powers, x[4:]) / SPEEDS[1] ** jnp.arange(3)
    return params.replace(mass=x[:1], J=jnp.diag(x[1:4]), J_inv=jnp.diag(1 / x[1:4]), rpm2thrust=curve[None])


def commands(weight: float, rng: np.random.Generator) -> jax.Array:
    """Return commands of roll, pitch, yaw and thrust, sums of sines. (n_samples, N_FLIGHTS, 1, 4)"""
    t = np.arange(int(SECONDS * RATE)) / RATE
    freq, phase = rng.uniform(0.3, 3.0, (4, N_FLIGHTS, 1, 4)), rng.uniform(0, 2 * np.pi, (4, N_FLIGHTS, 1, 4))
    waves = np.sin(2 * np.pi * freq * t[:, None, None, None, None] + phase).mean(axis=1)
    return jnp.asarray(waves * [0.9, 0.9, 1.5, weight] + [0, 0, 0, weight])


def main() -> dict[str, tuple[float, float, float]]:
    """Return estimate, true value and standard deviation by name."""
    rng = np.random.default_rng(0)
    sim = Sim(n_worlds=N_FLIGHTS, control="attitude", engine="plain")  # compiles its derivatives soonest
    step = sim.build_step_fn()
    data_sheet = physical(sim.data.params)
    cmds = commands(9.81 * float(data_sheet[0]), rng)
    states = sim.data.states
    rotor_vel = jnp.broadcast_to(dynamics.hover_rotor_vel(sim.data.params), states.rotor_vel.shape)
    initial_data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(20.0), rotor_vel=rotor_vel))

    def fly(ratio: jax.Array) -> dict[str, jax.Array]:
        """Return the measurements of flights with these parameters, which are relative to the data sheet."""

        def sample(data, cmd):
            data = step(F.attitude_control(data, cmd), sim.freq // RATE)
            return data, {name: getattr(data.states, name) for name in NOISE}

        drone = initial_data.replace(params=with_physical(initial_data.params, ratio * data_sheet))
        return jax.lax.scan(sample, drone, cmds)[1]

    flight = jax.jit(fly)(np.float32(TRUE_OVER_DATA_SHEET))
    log = {name: np.float32(x + NOISE[name] * rng.normal(size=x.shape)) for name, x in jax.device_get(flight).items()}

    def misfit(ratio: jax.Array) -> jax.Array:
        """Return the residuals of simulation and log, in units of the noise."""
        return jnp.concatenate([((x - log[name]) / NOISE[name]).ravel() for name, x in fly(ratio).items()])

    jacobian = jax.jit(jax.jacfwd(lambda ratio: (misfit(ratio),) * 2, has_aux=True))
    ratio = np.ones(len(NAMES), np.float32)
    for i in range(ROUNDS):
        slope, r = jax.device_get(jacobian(ratio))
        print(f"iteration {i}: the misfit is {np.sqrt(np.mean(r**2)):8.3f} times the noise")
        ratio = ratio - np.linalg.lstsq(slope, r, rcond=None)[0]

    sigma = np.linalg.norm(np.linalg.inv(np.linalg.qr(slope, mode="r")), axis=1)  # standard deviations due to the noise
    sheet = np.asarray(data_sheet) / UNITS
    estimate, true_value, sigma = (x * sheet for x in (ratio, TRUE_OVER_DATA_SHEET, sigma))
    print(f"\n{'':22} data sheet     found  +- sigma      true     error")
    for name, a, b, s, c in zip(NAMES, sheet, estimate, sigma, true_value, strict=True):
        print(f"{name:22} {a:10.3f} {b:9.3f} +- {s:5.3f} {c:9.3f} {100 * (b / c - 1):+8.2f} %")
    return {
        name: (float(b), float(c), float(s)) for name, b, c, s in zip(NAMES, estimate, true_value, sigma, strict=True)
    }


if __name__ == "__main__":
    main()
