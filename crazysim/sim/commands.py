"""The commands of a simulation: one method for each level, their rate, and when they take effect."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jax import Array

from crazysim.core import functional as F

if TYPE_CHECKING:
    from crazysim.core.data import SimData
    from crazysim.engine import Stepper
    from crazysim.sim.configuration import Configuration


class Commands:
    """The part of ``Sim`` that stages commands. A command moves nothing, so the scene stays as fresh as it was.

    Arguments and errors of all methods are those of ``crazysim.core.functional.state_control``.
    """

    data: SimData
    """Everything that changes."""
    configuration: Configuration
    """Validated settings."""
    _stepper: Stepper

    @property
    def control_freq(self) -> int:
        """Rate at which staged commands take effect, Hz; with rotor commands that is every step."""
        return self.configuration.control_freqs.get(self.configuration.control, self.configuration.freq)

    @property
    def controllable(self) -> Array:
        """True in worlds where a staged command takes effect at the next step. (n_worlds, 1)"""
        return F.controllable(self.data)

    def state_control(self, controls: Any, check_finite: bool = False, *, feedforward: Any = None) -> None:
        """Stage a full-state setpoint. (n_worlds, n_drones, 16)"""
        self._stepper.data = F.state_control(self.data, controls, check_finite, feedforward=feedforward)

    def attitude_control(self, controls: Any, check_finite: bool = False) -> None:
        """Stage roll, pitch, yaw, rad, and collective thrust, N. (n_worlds, n_drones, 4)"""
        self._stepper.data = F.attitude_control(self.data, controls, check_finite)

    def body_rate_control(self, controls: Any, check_finite: bool = False) -> None:
        """Stage body rates, rad/s, and collective thrust, N. (n_worlds, n_drones, 4)"""
        self._stepper.data = F.body_rate_control(self.data, controls, check_finite)

    def force_torque_control(self, controls: Any, check_finite: bool = False) -> None:
        """Stage collective thrust, N, and body torque, N m. (n_worlds, n_drones, 4)"""
        self._stepper.data = F.force_torque_control(self.data, controls, check_finite)

    def rotor_vel_control(self, controls: Any, check_finite: bool = False) -> None:
        """Command rotor speeds, rpm. (n_worlds, n_drones, n_rotors)"""
        self._stepper.data = F.rotor_vel_control(self.data, controls, check_finite)
