"""Sampling model-predictive control (MPPI) with rollouts in a second simulation, with the full dynamics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.control import Control, Setpoint
from crazysim.core.data import SimData, SimState, as_key
from crazysim.core.functional import stage_command
from crazysim.core.settings import largest_divisor, positive_integer
from crazysim.dynamics.models import GRAVITY
from crazysim.dynamics.parameters import rotor_vel_limits
from crazysim.eager import is_traced
from crazysim.engine import Step
from crazysim.engine.pytree import PyTree, float_dtype, leaf, n_batch_axes, scopes
from crazysim.engine.stage import Stage
from crazysim.errors import ConfigError, expect, require
from crazysim.sim.sim import Sim
from crazysim.tables import read_floats

CostFn = Callable[[SimState, Setpoint, Array], Array]
"""Function ``(states, setpoint, command)`` of one drone, at one time, that returns the cost of a control step. ()"""

RECORD_NAME = "mppi"
"""Key in ``data.plugins`` of a rollout's record."""
MAX_KNOTS = 64
"""Largest number of knots; engines select among at most that many entries at run time."""
COMMAND_LEVELS = (Control.attitude, Control.body_rate, Control.force_torque, Control.rotor_vel)
"""Command levels that can be sampled."""


class MPPIMemory(PyTree):
    """The planned commands of every drone, which one call of ``MPPI`` passes to the next."""

    plan: Array = leaf("drone", 2)
    """Commands at the knots of the horizon. (n_worlds, n_drones, n_knots, k)"""
    count: Array = leaf("shared", 0)
    """Number of commands so far. The random numbers depend on it. ()"""


class RolloutRecord(PyTree):
    """Plan, setpoint and cost of one rollout."""

    knots: Array = leaf("drone", 2)
    """Commands at the knots of the horizon. (n_worlds, n_drones, n_knots, k)"""
    setpoint: Setpoint
    """Setpoint at the start."""
    cost: Array = leaf("drone", 1)
    """Sum of the costs of the control steps so far. (n_worlds, n_drones, 1)"""


def tracking_cost(states: SimState, setpoint: Setpoint, command: Array) -> Array:
    """Return the cost of a control step: squares of position and velocity errors, yaw error, body rates. ()

    An error of 1 m costs as much as 2 m/s, 90 degrees of yaw, or a body rate of 10 rad/s. A height below 5 cm costs 10
    more.
    """
    del command
    pos_error, vel_error = states.pos - setpoint.pos, states.vel - setpoint.vel
    yaw_error = rotation.yaw(states.quat) - setpoint.yaw[0]
    rate_cost = 0.01 * jnp.sum(states.ang_vel * states.ang_vel)
    crash_cost = jnp.where(states.pos[2] < 0.05, 10.0, 0.0)
    error_cost = jnp.sum(pos_error * pos_error) + 0.25 * jnp.sum(vel_error * vel_error) + (1 - jnp.cos(yaw_error))
    return error_cost + rate_cost + crash_cost


def setpoint_after(setpoint: Setpoint, t: Array) -> Setpoint:
    """Return a setpoint some time later, by the Taylor polynomials of its position and yaw.

    Args:
        t: Time, s. ()
    """
    pos, vel, acc, jerk, snap = setpoint.pos, setpoint.vel, setpoint.acc, setpoint.jerk, setpoint.snap
    return Setpoint(
        pos=pos + t * (vel + t / 2 * (acc + t / 3 * (jerk + t / 4 * snap))),
        vel=vel + t * (acc + t / 2 * (jerk + t / 3 * snap)),
        acc=acc + t * (jerk + t / 2 * snap),
        jerk=jerk + t * snap,
        snap=snap,
        yaw=setpoint.yaw + t * (setpoint.yaw_rate + t / 2 * setpoint.yaw_acc),
        yaw_rate=setpoint.yaw_rate + t * setpoint.yaw_acc,
        yaw_acc=setpoint.yaw_acc,
    )


class MPPI:
    """Model-predictive path integral control of every drone of a simulation.

    At each call, the engine flies ``samples`` plans around the last one from the present state, each in a separate
    world, with the simulation's dynamics, command level, effects and parameters. The new plan is their mean,
    weighted by ``exp(-cost / temperature)`` (Williams, Aldrich and Theodorou 2017); its first command is returned, and
    the plan is shifted by one control step. A plan is a polyline through ``knots`` commands over the horizon. With the
    same seed, equal calls return equal commands.

    Drones of a world are sampled together but weighted separately, which assumes that drones do not interact.
    Rollouts begin at step 0, also for effects that depend on the time since the reset.
    """

    def __init__(
        self,
        sim: Sim,
        horizon: int = 50,
        samples: int = 1024,
        substeps: int = 2,
        *,
        knots: int = 10,
        freq: int | None = None,
        noise: ArrayLike | None = None,
        temperature: float = 0.05,
        cost: CostFn = tracking_cost,
        seed: int = 0,
    ):
        c = sim.configuration
        if c.control not in COMMAND_LEVELS:
            raise ConfigError(
                f"expected a simulation with control as one of {', '.join(map(repr, map(str, COMMAND_LEVELS)))}, got "
                f"{c.control.value!r}. Use Sim(control='attitude')."
            )
        self.horizon, self.samples = positive_integer("horizon", horizon), positive_integer("samples", samples)
        self.substeps, self.knots = positive_integer("substeps", substeps), positive_integer("knots", knots)
        require(
            2 <= self.knots <= MAX_KNOTS and self.horizon >= 2,
            f"expected 2 to {MAX_KNOTS} knots and a horizon of at least 2, got {knots} and {horizon}",
        )
        is_number = isinstance(temperature, (int, float, np.number)) and not isinstance(temperature, bool)
        require(
            is_number and 0 < temperature < np.inf,
            f"expected a positive, finite temperature, got {temperature!r}. Use 0.05.",
        )
        expect(callable(cost), "cost as a function", cost, "Use tracking_cost.")
        self.temperature, self.cost, self._key = temperature, cost, as_key(seed)
        freq = c.freq if freq is None else positive_integer("freq", freq)
        rates: dict[str, Any] = {
            f"{level.value}_freq": largest_divisor(freq, rate) for level, rate in c.control_freqs.items()
        }
        self._sim = Sim(
            sim.n_worlds * self.samples, sim.n_drones, c.airframes, c.dynamics, c.control, c.integrator, freq,
            device=c.device, engine=c.engine, controller=c.controller or "auto", **rates,
        )  # fmt: skip
        self._sim._use_scene(sim.scene.repeated(self.samples, self._sim.plugins.values))
        for plugin in sim.plugins.values():
            self._sim.add(plugin)
        self.period = self.substeps / freq
        """Time from one command to the next, s."""
        # Commands: in hover, smallest and largest. (k,) each
        self.hover, self.low, self.high, default_noise = _command_range(sim)
        self.noise = default_noise if noise is None else read_floats("noise", noise).astype(float_dtype())
        if self.noise.shape != self.hover.shape or not np.all((self.noise >= 0) & np.isfinite(self.noise)):
            raise ConfigError(f"expected noise as {len(self.hover)} finite numbers of at least zero, got {noise!r}")
        pipeline = {
            "mppi_command": Stage(
                lambda data: stage_command(data, self._command_at(data, data.core.steps)),
                "drone",
                self._starts_control_step,
            ),
            **self._sim.step_pipeline,
            "mppi_cost": Stage(self._cost_stage, "drone", self._starts_control_step),
        }
        self._step = Step(pipeline, c.engine, c.device.platform, device=c.device)
        self._device = c.device
        self._memory = jax.device_put(self.init(sim.n_worlds, sim.n_drones), c.device)
        self._compiled_plan = jax.jit(self._plan)

    def init(self, n_worlds: int, n_drones: int) -> MPPIMemory:
        """Return the memory before the first command: plans that hover."""
        shape = (n_worlds, n_drones, self.knots, len(self.hover))
        return MPPIMemory(jnp.asarray(np.broadcast_to(self.hover, shape), float_dtype()), jnp.int32(0))

    @property
    def engine(self) -> str:
        """Engine of the rollouts; empty before the first command."""
        return ", ".join(self._step.engines)

    def reset(self) -> None:
        """Reset the plans of ``command`` to hovering."""
        self._memory = jax.device_put(self.init(*self._memory.plan.shape[:2]), self._device)

    def command(self, data: SimData, setpoint: Setpoint) -> Array:
        """Plan the command of every drone, and keep the plan for the next call; one compiled call.

        Args:
            data: The data of the simulation, from which rollouts start.
            setpoint: Present setpoint of every drone, (n_worlds, n_drones, ...), or of all drones, (...).

        Returns:
            Command of the simulation's level. (n_worlds, n_drones, k)
        """
        command, self._memory = self._compiled_plan(self._memory, data, setpoint)
        return command

    def plan(self, memory: MPPIMemory, data: SimData, setpoint: Setpoint) -> tuple[Array, MPPIMemory]:
        """Plan the command of every drone, and the memory for the next call; pure, and one compiled call.

        Args:
            memory: Result of ``init``, or of the last call.
            setpoint: As for ``command``.

        Returns:
            Command of the simulation's level (n_worlds, n_drones, k), and the memory for the next call.
        """
        arguments = (memory, data, setpoint)
        return (self._plan if is_traced(arguments) else self._compiled_plan)(*arguments)

    def _plan(self, memory: MPPIMemory, data: SimData, setpoint: Setpoint) -> tuple[Array, MPPIMemory]:
        key, plan = jax.random.fold_in(self._key, memory.count), memory.plan
        n_worlds, n_drones = plan.shape[:2]
        shape = (n_worlds, self.samples, *plan.shape[1:])
        noise = jax.random.normal(key, shape, plan.dtype) * jnp.asarray(self.noise, plan.dtype)
        noise = noise.at[:, 0].set(0.0)  # the plan itself is a sample
        knots = rotation.clip(plan[:, None] + noise, jnp.asarray(self.low), jnp.asarray(self.high))

        setpoints = jax.tree.map(lambda x: jnp.broadcast_to(x, (n_worlds, n_drones, x.shape[-1])), setpoint)
        record = RolloutRecord(
            knots=knots.reshape(n_worlds * self.samples, *plan.shape[1:]),
            setpoint=jax.tree.map(self._repeat_for_samples, setpoints),
            cost=jnp.zeros((n_worlds * self.samples, n_drones, 1), plan.dtype),
        )
        final_data = self._step(self._rollouts(data, record), self.horizon * self.substeps)
        costs = final_data.plugins[RECORD_NAME].cost.reshape(n_worlds, self.samples, n_drones)
        costs = jnp.where(jnp.isfinite(costs), costs, jnp.inf)
        excess_cost = costs - jnp.min(costs, axis=1, keepdims=True)
        is_finite = jnp.isfinite(excess_cost)  # the plan of a drone does not change if all of its rollouts fail
        mean_excess = jnp.sum(jnp.where(is_finite, excess_cost, 0.0), axis=1, keepdims=True) / jnp.maximum(
            jnp.sum(is_finite, axis=1, keepdims=True), 1
        )
        weights = jnp.where(
            is_finite, jnp.exp(-jnp.where(is_finite, excess_cost, 0.0) / (self.temperature * mean_excess + 1e-9)), 0.0
        )
        weights = weights / jnp.maximum(jnp.sum(weights, axis=1, keepdims=True), 1e-9)
        new_plan = plan + jnp.einsum("wsd,wsdkc->wdkc", weights, knots - plan[:, None])
        return new_plan[:, :, 0], MPPIMemory(self._shift_plan(new_plan), memory.count + 1)

    # Rollouts -------------------------------------------------------------------------------------------------------

    def _repeat_for_samples(self, x: Array) -> Array:
        return jnp.repeat(x, self.samples, axis=0)

    def _rollouts(self, data: SimData, record: RolloutRecord) -> SimData:
        template = self._sim.data
        require(
            data.plugins.keys() == template.plugins.keys(),
            f"expected data with the plugins that the simulation had when MPPI was built, "
            f"{list(template.plugins)}, got {list(data.plugins)}. Build MPPI after adding them.",
        )
        names, expected_names = [x.objects.names if x.objects is not None else () for x in (data, template)]
        if names != expected_names:
            raise ConfigError(
                f"expected data with the objects that the scene had when MPPI was built, {list(expected_names)}, got "
                f"{list(names)}. Build MPPI after adding them."
            )

        def repeat_for_rollouts(scope: str, default: Array, x: Array) -> Array:
            return self._repeat_for_samples(x) if n_batch_axes(scope) == 2 else default if scope != "shared" else x

        leaves = [
            repeat_for_rollouts(*leaf_args)
            for leaf_args in zip(
                jax.tree.leaves(scopes(data)), jax.tree.leaves(template), jax.tree.leaves(data), strict=True
            )
        ]
        initial_data = jax.tree.unflatten(jax.tree.structure(template), leaves)
        core = initial_data.core.replace(
            steps=jnp.zeros_like(template.core.steps),
            world_id=template.core.world_id,
            drone_mocap_ids=template.core.drone_mocap_ids,
        )
        return initial_data.replace(core=core, plugins=initial_data.plugins | {RECORD_NAME: record})

    def _starts_control_step(self, data: SimData) -> Array:
        return data.core.steps % self.substeps == 0

    def _cost_stage(self, data: SimData) -> SimData:
        record = data.plugins[RECORD_NAME]
        t = data.core.steps.astype(record.cost.dtype) / data.core.freq
        command = self._command_at(data, data.core.steps - self.substeps)
        cost = self.cost(data.states, setpoint_after(record.setpoint, t), command)
        record = record.replace(cost=record.cost + jnp.reshape(cost, (1,)))
        return data.replace(plugins=data.plugins | {RECORD_NAME: record})

    def _command_at(self, data: SimData, step: Array) -> Array:
        knots = data.plugins[RECORD_NAME].knots
        knot_position = step.astype(knots.dtype) * ((self.knots - 1) / ((self.horizon - 1) * self.substeps))
        index = jnp.clip(jnp.floor(knot_position).astype(jnp.int32), 0, self.knots - 2)
        return knots[index] + (knot_position - index) * (knots[index + 1] - knots[index])

    def _shift_plan(self, plan: Array) -> Array:
        knot_position = np.arange(self.knots) + (self.knots - 1) / (self.horizon - 1)
        index = np.minimum(np.floor(knot_position).astype(int), self.knots - 2)
        fraction = np.minimum(knot_position - index, 1.0).astype(np.asarray(self.noise).dtype)[:, None]
        return plan[:, :, index] + fraction * (plan[:, :, index + 1] - plan[:, :, index])


def _command_range(sim: Sim) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    airframe, level = sim.airframe, sim.control
    mass = float(airframe.value("rigid_body.mass", ()))
    min_thrust = airframe.n_rotors * float(airframe.value("rotors.thrust_min", ()))
    max_thrust = airframe.n_rotors * float(airframe.value("rotors.thrust_max", ()))
    weight = -GRAVITY[2] * mass
    thrust_deviation = 0.2 * (max_thrust - min_thrust)
    if level == Control.rotor_vel:
        min_rotor_vel, max_rotor_vel = rotor_vel_limits(sim.dynamics, airframe)
        hover = min_rotor_vel + (max_rotor_vel - min_rotor_vel) * np.sqrt(
            max(weight - min_thrust, 0.0) / (max_thrust - min_thrust)
        )
        n = airframe.n_rotors
        rows = [[hover] * n, [min_rotor_vel] * n, [max_rotor_vel] * n, [0.05 * max_rotor_vel] * n]
    elif level == Control.force_torque:
        max_torque = 0.5 * airframe.arm * (max_thrust - min_thrust)
        torque = np.array([max_torque, max_torque, 0.1 * max_torque])
        rows = [[weight, 0, 0, 0], [min_thrust, *-torque], [max_thrust, *torque], [thrust_deviation, *(0.05 * torque)]]
    else:
        limits, deviations = (
            ((0.7, 0.7, np.pi), (0.1, 0.1, 0.05)) if level == Control.attitude else ((8, 8, 3), (2, 2, 1))
        )
        rows = [
            [0, 0, 0, weight],
            [*(-x for x in limits), min_thrust],
            [*limits, max_thrust],
            [*deviations, thrust_deviation],
        ]
    return tuple(np.asarray(row, float_dtype()) for row in rows)  # type: ignore[return-value]
