"""Sequences of states and commands that drive the firmware's controllers into their limits, and our laws on them."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from crazysim.control import Control, Setpoint
from crazysim.drones import load_airframe
from crazysim.dynamics.rotor import curve

RATE, POSITION_EVERY = 500, 5


def flights(mode, n, n_ticks, seed):
    """Return states (n_ticks, n, 13) and commands (n_ticks, n, k): from gentle to wild, across yaw +-180 degrees.

    A state is pos, vel, quat, ang_vel. Thrust is in PWM, and zero for a while in some flights. State commands change
    at the ticks of the position loop.
    """
    rng = np.random.default_rng(seed)
    size = np.geomspace(0.02, 1.0, n)[:, None]  # the last flights turn upside down

    def smooth(k, scale, period):
        phase, slow = rng.uniform(0, 2 * np.pi, (3, n, k)), rng.uniform(0.3, 1.7, (3, n, k))
        t = np.arange(n_ticks)[:, None, None, None] / RATE
        return scale * np.sum(np.sin(2 * np.pi * t * slow / period + phase), axis=1) / 1.7

    pos, vel = smooth(3, 2 * size, 1.0), smooth(3, 3 * size, 0.7)
    # Rolls go upside down; pitch keeps away from 90 degrees, where rounding of the Euler angles is amplified.
    tilt, yaw = smooth(2, 1.2 * size, 0.5) * [1.0, 0.5], 3.0 + smooth(1, 2.0, 0.9)
    quat = np.array([[of_rpy(*tilt[i, j], yaw[i, j, 0]) for j in range(n)] for i in range(n_ticks)])
    ang_vel = smooth(3, 10 * size, 0.3)
    states = np.concatenate([pos, vel, quat, ang_vel], axis=-1)
    if mode == "state":
        held = POSITION_EVERY * (np.arange(n_ticks) // POSITION_EVERY)
        desired_yaw = (yaw + smooth(1, size, 0.4))[held, :, 0]
        quat_des = np.stack([0 * desired_yaw, 0 * desired_yaw, np.sin(desired_yaw / 2), np.cos(desired_yaw / 2)], -1)
        parts = [pos + smooth(3, 1.5 * size, 0.6), vel + smooth(3, size, 0.4), smooth(3, 4 * size, 0.5)]
        rates = smooth(3, 3 * size, 0.3)
        commands = np.concatenate([*(part[held] for part in parts), quat_des, rates[held]], axis=-1)
    else:
        thrust = np.clip(38000 + 40000 * size * smooth(1, 1.0, 0.5), 1000, 65535)
        thrust[n_ticks // 3 : n_ticks // 3 + 20, ::3] = 0
        angles = np.concatenate([tilt, yaw], axis=-1) + smooth(3, size, 0.4)
        commands = np.concatenate([angles if mode == "attitude" else smooth(3, 8 * size, 0.3), thrust], axis=-1)
    return states, commands


def of_rpy(roll, pitch, yaw):
    """Return the quaternion of Rz(yaw) Ry(pitch) Rx(roll), xyzw."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.array([roll, pitch, yaw]) / 2), np.sin(np.array([roll, pitch, yaw]) / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def law(controller, mode, states, commands, drone="cf2x_L250"):
    """Return the PWM of the motors by a controller of crazysim, in the precision of JAX. (n_ticks, n, 4)"""
    return np.asarray(_compiled(controller, mode)(numbers_of(controller, drone), states, commands))


@functools.cache
def _compiled(controller, mode):
    return jax.jit(functools.partial(_flown, controller, mode))


def numbers_of(controller, drone):
    """Return parameters and memory of a controller for an airframe, N of full PWM, and the curve of the thrust."""
    airframe = load_airframe(drone)
    newton = 4 * float(airframe.value("rotors.thrust_max")) / 65535
    return controller.params(airframe), controller.memory(airframe), newton, airframe.value("rotors.thrust_curve")[None]


def law_of(controller, mode, states, commands, drone="cf2x_L250"):
    """Return the same as ``law``, traceable."""
    return _flown(controller, mode, numbers_of(controller, drone), states, commands)


def _flown(controller, mode, numbers, states, commands):
    params, rest, newton, thrust_curve = numbers
    rest = jax.tree.map(jnp.asarray, rest)
    if mode != "state":
        commands = commands * jnp.asarray([1, 1, 1, newton], commands.dtype)

    def tick(memory, row):
        k, s, c = row
        controls = SimpleNamespace(mode=Control(mode), state=SimpleNamespace(cmd=c))
        states = SimpleNamespace(pos=s[:3], vel=s[3:6], quat=s[6:10], ang_vel=s[10:13])
        data = SimpleNamespace(states=states, controls=controls)
        command = Setpoint.of_command(c) if mode == "state" else c
        if mode == "state" and controller.has_outer:
            after = controller.outer(data, command, memory, params)
            memory = jax.tree.map(lambda new, old: jnp.where(k % POSITION_EVERY == 0, new, old), after, memory)
        rotor_vel, memory = controller.update(data, command, memory, params)
        thrust = jnp.where(rotor_vel > 0, curve(rotor_vel, thrust_curve), 0.0)
        return memory, 4 * thrust / newton

    def fly(states, commands):
        ticks = jnp.arange(len(states))
        return jax.lax.scan(tick, rest, (ticks, states, commands))[1]

    return jax.vmap(fly, 1, 1)(states, commands)
