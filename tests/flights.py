"""Flights of a control law on arrays, in closed loop with the full dynamics."""

import jax
import jax.numpy as jnp
import numpy as np

from crazysim import Sim
from crazysim.control import Setpoint
from crazysim.core import functional as F


def path_setpoint(path, t):
    values = []
    for _ in range(5):
        values.append(path)
        path = (lambda f: lambda t: jax.jvp(f, (t,), (jnp.ones_like(t),))[1])(path)
    pos, vel, acc, jerk, snap = (f(t) for f in values)
    return Setpoint(pos[:3], vel[:3], acc[:3], jerk[:3], snap[:3], pos[3:], vel[3:], acc[3:])


def figure_eight(t, width=2.0, speed=2.0, height=1.0):
    """Return (x, y, z, yaw) of a figure eight at a time: ``width`` m in x, half of it in y, at most ``speed`` m/s."""
    rate = speed / (width / np.sqrt(2))
    x, y = width / 2 * jnp.sin(rate * t), width / 4 * jnp.sin(2 * rate * t)
    return jnp.stack([x, y, height + 0 * t, 0 * t])


def hover(t):
    """Return (x, y, z, yaw) of a point 1 m above the floor."""
    return jnp.stack([0 * t, 0 * t, 1 + 0 * t, 0 * t])


def start_on_path(sim, path):
    from crazysim.dynamics import first_principles

    sp = path_setpoint(path, jnp.float32(0))
    states, data = sim.data.states, sim.data
    rotor_vel = jnp.broadcast_to(first_principles.hover_rotor_vel(data.params), states.rotor_vel.shape)
    broadcast = lambda x, template: jnp.broadcast_to(jnp.asarray(x, template.dtype), template.shape)  # noqa: E731
    states = states.replace(pos=broadcast(sp.pos, states.pos), vel=broadcast(sp.vel, states.vel), rotor_vel=rotor_vel)
    sim.data = data.replace(states=states)


def fly(sim, law, path, seconds, memory=None, change=None):
    """Return states, setpoints and outputs over time under ``law(data, setpoint, memory)``, and the last data.

    The law runs at every tick of the commands of ``sim``; its outputs are such commands. ``change(data, t)``
    changes the data before each tick.
    """
    step, n_substeps = sim.build_step_fn().with_zeros_of(sim.data), sim.freq // sim.control_freq
    command = getattr(F, f"{sim.control.value}_control")

    @jax.jit
    def run(data, memory):
        def tick(carry, k):
            data, memory = carry
            t = k * (n_substeps / sim.freq)
            data = data if change is None else change(data, t)
            setpoint = path_setpoint(path, t)
            outputs, memory = law(data, setpoint, memory)
            data = step(command(data, outputs.reshape(1, 1, -1)), n_substeps)
            return (data, memory), (data.states, path_setpoint(path, t + n_substeps / sim.freq), outputs)

        times = jnp.arange(round(seconds * sim.control_freq), dtype=jnp.float32)
        return jax.lax.scan(tick, (data, memory), times)

    (data, memory), (states, setpoints, outputs) = run(sim.data, memory)
    return jax.tree.map(lambda x: np.asarray(x)[:, 0, 0], states), setpoints, np.asarray(outputs), data


def rms_error(states, setpoints, start=0.0, total=1.0):
    """Return the RMS position error of a flight after its fraction ``start / total``, m."""
    error = np.linalg.norm(states.pos - np.asarray(setpoints.pos), axis=-1)
    return float(np.sqrt(np.mean(error[int(len(error) * start / total) :] ** 2)))


def make_sim(drone="cf21B_500", control="force_torque", **settings):
    return Sim(drone=drone, control=control, **settings)
