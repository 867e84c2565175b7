"""Base class of estimators: sensors to fuse, and controllers that use the estimate."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Plugin, Simulation, StagePlacement, with_measured_states
from crazysim.engine.stage import Stage, as_stages
from crazysim.errors import ConfigError, expect
from crazysim.plugins.sensors.imu import IMU
from crazysim.plugins.sensors.sensor import Sensor

CONTROLLER_STAGES = ("state_controller", "attitude_controller", "body_rate_controller")
"""Names of the stages that read the state of a drone to control it."""


class Estimator(Plugin):
    """Base class of filters that estimate the state of every drone from an ``IMU`` and other sensors.

    A subclass defines ``kinds``, ``reset_episode``, ``filter_stages`` and ``estimated_states``. With
    ``control``, controllers use the estimate in place of the state. Environments that observe measured states observe
    the estimate, also without ``control``.
    """

    sensors: Sequence[Sensor]
    """An ``IMU`` and other sensors. Add them to the simulation before the estimator, except with
    ``Sim(estimator=...)``, which adds them itself. In ``data.plugins``, their names."""
    control: bool = True
    """Whether the controllers of the simulation use the estimate."""
    reset_before: ClassVar[str | None] = "increment_steps"
    """Name of the stage before which ``reset_episode`` is called in the first step of an episode. The reset uses the
    state after that step."""
    _: dataclasses.KW_ONLY
    name: str = "estimator"

    def __post_init__(self) -> None:
        super().__post_init__()
        is_list = isinstance(self.sensors, (list, tuple)) and all(isinstance(x, Sensor) for x in self.sensors)
        example = f"{type(self).__name__}([IMU(), MotionCapture()])"
        expect(self.is_bound or is_list, "sensors as a list", self.sensors, f"Use {example}, say.")

    @classmethod
    def default(cls) -> Estimator:
        """Return the filter with its default sensors, for users who only pass its name."""
        raise NotImplementedError

    @property
    def replaced_terms(self) -> tuple[str, ...]:
        return ("the state that controllers read",) if self.control else ()

    @property
    def kinds(self) -> tuple[type[Sensor], ...]:
        """Classes of the sensors that the filter can use in addition to the ``IMU``."""
        raise NotImplementedError

    def can_fuse(self, sensor: Sensor) -> bool:
        """Whether the filter can use a sensor, beside its ``IMU``."""
        return type(sensor) in self.kinds

    def filter_stages(self, data: SimData) -> Sequence[tuple[str, Stage]]:
        """Return the names and stages of the filter, in their order, for the data of a simulation.

        The last name is empty: that stage has the name of the plugin.
        """
        raise NotImplementedError

    def estimated_states(self, data: SimData) -> dict[str, Array]:
        """Return the estimated fields of ``data.states`` of one drone; the ``IMU`` measures the others."""
        raise NotImplementedError

    @property
    def companions(self) -> Mapping[str, type]:
        return {} if self.is_bound else {sensor.name: type(sensor) for sensor in self.sensors}

    def with_companions(self, plugins: Mapping[str, Plugin]) -> Self:
        sensors = [plugins.get(sensor.name, sensor) for sensor in self.sensors]
        return self if sensors == [*self.sensors] else self.replace(sensors=sensors)

    def bound_sensors(self, data: SimData) -> list[Sensor]:
        """Return all sensors as they are in ``data.plugins``."""
        names: list[Any] = [getattr(sensor, "name", sensor) for sensor in self.sensors]
        return [data.plugins[name] for name in names]  # type: ignore[misc]

    def imu(self, data: SimData) -> IMU:
        """Return the inertial measurement unit in ``data.plugins``."""
        return next(sensor for sensor in self.bound_sensors(data) if isinstance(sensor, IMU))

    def aiding_sensors(self, data: SimData) -> list[Sensor]:
        """Return all sensors in ``data.plugins`` except for the inertial measurement unit."""
        return [sensor for sensor in self.bound_sensors(data) if not isinstance(sensor, IMU)]

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        placements = [
            StagePlacement(stage, before="increment_steps", name=f"{self.name}_{name}" if name else self.name)
            for name, stage in self.filter_stages(sim.data)
        ]
        if self.control:
            stages = as_stages({name: s for name, s in sim.step_pipeline.items() if name in CONTROLLER_STAGES})
            placements += [
                StagePlacement(self._estimate_controller(s), replaces=s.__name__, name=s.__name__) for s in stages
            ]
        return placements

    def known_data(self, data: SimData) -> SimData:
        # A filter knows only the nominal numbers of drone and sensors.
        drawn = super().known_data(data)
        return data if drawn is data else data.replace(plugins=data.plugins | {self.name: drawn.plugins[self.name]})

    def measured_states(self, data: SimData) -> dict[str, Array]:
        s, estimate = data.states, self.estimated_states(data)
        is_first_step = data.core.steps[..., None] == 0 if s.pos.ndim > 1 else data.core.steps == 0
        states = {name: jnp.where(is_first_step, getattr(s, name), value) for name, value in estimate.items()}
        return self.imu(data).measured_states(data) | states

    def observations(self, data: SimData) -> dict[str, Array]:
        return self.measured_states(data)

    def inertial(self, data: SimData) -> tuple[Array, Array]:
        """Return measured angular velocity, rad/s, and specific force, m/s^2, of one drone, body frame. (3,) each"""
        imu = self.imu(data)
        gyro, accel = jnp.split(imu.latest(data), 2)
        return rotation.rotate(imu.quat, gyro), rotation.rotate(imu.quat, accel)

    def with_arrays(self, sim: Simulation, **values: Any) -> Self:
        return super().with_arrays(sim, sensors=tuple([sensor.name for sensor in self.sensors]), **values)

    def check_simulation(self, sim: Simulation) -> None:
        names = ", ".join(kind.__name__ for kind in self.kinds)
        if sum(isinstance(sensor, IMU) for sensor in self.sensors) != 1:
            classes = [type(sensor).__name__ for sensor in self.sensors]
            raise ConfigError(f"expected one IMU among the sensors of {self.name!r}, and any of {names}, got {classes}")
        for sensor in self.sensors:
            present: Any = sim.plugins.get(sensor.name)
            sensor = present if isinstance(present, type(sensor)) else sensor
            if not isinstance(sensor, IMU) and not self.can_fuse(sensor):
                raise ConfigError(
                    f"expected sensors of the kinds {names} and an IMU, got {type(sensor).__name__}. Leave it out, or "
                    f"use ESKF with chains of errors that have a variance, such as {{'pos': (White('noise'),)}}."
                )
        super().check_simulation(sim)

    def _estimate_controller(self, controller: Stage) -> Stage:
        def run_on_estimate(data: SimData) -> SimData:
            return controller.fn(with_measured_states([self], data)).replace(states=data.states)

        return Stage(run_on_estimate, controller.scope, controller.when, controller.batched, controller.__name__)
