"""The commands of a simulation, one method for each level."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from crazysim.core import functional as F

if TYPE_CHECKING:
    from crazysim.engine import Stepper


class Commands:
    """The part of ``Sim`` that stages commands. A command moves nothing, so the scene stays as fresh as it was.

    Arguments and errors of all methods are those of ``crazysim.core.functional.state_control``.
    """

    _stepper: Stepper

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
