"""Fly to a point with your own position controller, which sends attitude and thrust.

Everything below the command (attitude controller, allocation, rotors) is simulated. The position controller is a spring
and a damper; roll and pitch follow from the desired acceleration.
"""

import numpy as np

from crazysim import Sim

TARGET = np.array([1.0, -0.5, 1.0])
STIFFNESS, DAMPING = 4.0, 3.0  # 1/s^2, 1/s
SECONDS = 4


def command(pos: np.ndarray, vel: np.ndarray, mass: float) -> np.ndarray:
    """Return roll, pitch and zero yaw, rad, and collective thrust, N. (..., 4)"""
    acc = STIFFNESS * (TARGET - pos) - DAMPING * vel + [0.0, 0.0, 9.81]
    roll = np.arctan2(-acc[..., 1], acc[..., 2])
    pitch = np.arctan2(acc[..., 0], np.hypot(acc[..., 1], acc[..., 2]))
    thrust = mass * np.linalg.norm(acc, axis=-1)
    return np.stack([roll, pitch, np.zeros_like(roll), thrust], axis=-1)


def main() -> None:
    sim = Sim(drone="cf2x_L250", control="attitude", attitude_freq=250)
    mass = float(sim.data.params.mass[0])

    for step in range(SECONDS * sim.control_freq):
        pos, vel = np.asarray(sim.data.states.pos), np.asarray(sim.data.states.vel)
        if step % sim.control_freq == 0:
            distance = np.linalg.norm(pos[0, 0] - TARGET)
            print(f"t = {step / sim.control_freq:.0f} s: {distance:.3f} m from the target")
        sim.attitude_control(command(pos, vel, mass))
        sim.step(sim.freq // sim.control_freq)

    print(f"at the end: {np.linalg.norm(sim.data.states.pos[0, 0] - TARGET):.3f} m from the target")


if __name__ == "__main__":
    main()
