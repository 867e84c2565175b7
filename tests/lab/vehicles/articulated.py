"""A car with four wheels, steering hinges and contacts in C MuJoCo, with the parameters of a vehicle model."""

import mujoco
import numpy as np

from crazysim.plugins.vehicles import VehicleModel, ackermann

TIMESTEP = 0.001
WHEELS = {"fl": (1, 1), "fr": (1, -1), "rl": (-1, 1), "rr": (-1, -1)}
"""Whether each wheel is in front (1) or at the rear (-1), and on the left (1) or on the right (-1)."""


def create_mjcf(vehicle: VehicleModel, trailer: bool = False) -> str:
    number = vehicle.number
    radius = number("wheels.radius")
    spin = f'armature="{number("wheels.armature")}" damping="{number("wheels.damping")}"'
    spin += f' frictionloss="{number("wheels.friction_loss")}"'
    wheels, motors = "", ""
    for name, (ahead, left) in WHEELS.items():
        x = number("axles.front") if ahead > 0 else -number("axles.rear")
        y = left * number("axles.track") / 2
        # The kingpins are in the middle of the wheels, not at `axles.kingpin_track`: wheels that roll about a kingpin
        # while they are steered turn the car by the inertia of their motors, which vehicle models do not describe.
        hinge = f'<joint name="steer_{name}" axis="0 0 1" damping="4" armature="0.001"/>'
        wheels += f"""<body pos="{x} {y} 0">{hinge if ahead > 0 else ""}
            <joint name="{name}" axis="0 1 0" {spin}/>
            <geom type="sphere" size="{radius}" mass="{number("wheels.mass")}" condim="3"
             friction="{number("tyres.friction")}" priority="1"/></body>"""
        motors += f'<motor name="{name}" joint="{name}"/>'
        if ahead > 0:
            motors += f'<position name="steer_{name}" joint="steer_{name}" kp="300"/>'
    inertia = number("rigid_body.yaw_inertia")
    return f"""<mujoco><option timestep="{TIMESTEP}" integrator="implicitfast" cone="elliptic" impratio="1000"/>
      <worldbody><geom type="plane" size="100 100 1"/>
        <body name="car" pos="0 0 {radius}"><freejoint/>
          <inertial pos="0 0 0" mass="{number("rigid_body.mass")}" diaginertia="0.05 0.05 {inertia}"/>
          {wheels}{_trailer(vehicle) if trailer else ""}</body></worldbody>
      <actuator>{motors}</actuator></mujoco>"""


def _trailer(vehicle: VehicleModel) -> str:
    """Return MJCF of a light trailer: only its kinematics are compared."""
    number = vehicle.number
    radius, track = number("trailer.wheel_radius"), number("trailer.track")
    drop = number("wheels.radius") - radius

    def axle(x: float) -> str:
        return "".join(
            f"""<body pos="{x} {side * track / 2} {-drop}"><joint axis="0 1 0" armature="5e-5"/>
            <geom type="sphere" size="{radius}" mass="0.1" condim="3" priority="1"
             friction="{number("tyres.friction")}"/></body>"""
            for side in (1, -1)
        )

    return f"""<body name="bar" pos="{-number("trailer.hitch")} 0 0"><joint type="ball" damping="1e-4"/>
        <geom type="capsule" size="0.003" fromto="0 0 0 {-number("trailer.drawbar")} 0 0" mass="0.05" contype="0"
         conaffinity="0"/>
        <body pos="{-number("trailer.drawbar")} 0 0">{axle(0.0)}
          <body name="deck"><joint axis="0 0 1" damping="1e-4"/>
            <geom type="box" size="0.1 0.05 0.005" pos="-0.11 0 0" mass="0.3" contype="0" conaffinity="0"/>
            {axle(-number("trailer.axle_distance"))}</body></body></body>"""


class ArticulatedCar:
    def __init__(self, vehicle: VehicleModel, trailer: bool = False):
        self.vehicle = vehicle
        self.model = mujoco.MjModel.from_xml_string(create_mjcf(vehicle, trailer))
        self.data = mujoco.MjData(self.model)
        for _ in range(500):
            mujoco.mj_step(self.model, self.data)
        self.start = self.data.time

    def drive(self, reference: float) -> None:
        """Set the torques of the vehicle model's law for a motor reference."""
        gain, damping, friction = self.vehicle.value("drive.torque")
        speed, limit = self.body_vel[0], self.vehicle.number("drive.torque_max")
        self.torque(np.clip(gain * reference - damping * speed - friction * np.tanh(speed / 0.1), -limit, limit))

    def torque(self, torque: float) -> None:
        """Set the torque of every wheel, N m."""
        for name in WHEELS:
            self.data.actuator(name).ctrl[0] = torque

    def steer(self, angle: float) -> None:
        """Set the steering angles of the front wheels from the angle of a wheel in the middle of their axle, rad."""
        number = self.vehicle.number
        left, right = np.asarray(ackermann(np.array([angle]), self.vehicle.wheelbase, number("axles.track")))
        self.data.actuator("steer_fl").ctrl[0] = left
        self.data.actuator("steer_fr").ctrl[0] = right

    def step(self) -> None:
        mujoco.mj_step(self.model, self.data)

    @property
    def time(self) -> float:
        return self.data.time - self.start

    @property
    def pos(self) -> np.ndarray:
        return self.data.qpos[:2].copy()

    @property
    def yaw(self) -> float:
        return self.yaw_of("car")

    def yaw_of(self, body: str) -> float:
        matrix = self.data.body(body).xmat.reshape(3, 3)
        return float(np.arctan2(matrix[1, 0], matrix[0, 0]))

    @property
    def body_vel(self) -> np.ndarray:
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        x, y = self.data.qvel[:2]
        return np.array([cos * x + sin * y, cos * y - sin * x])

    @property
    def yaw_rate(self) -> float:
        return float(self.data.qvel[5])
