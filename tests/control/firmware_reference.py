"""The firmware's PID and Mellinger controllers in plain NumPy, float64: a second implementation, from the C sources.

Written from controller_pid.c, position_controller_pid.c, attitude_pid_controller.c, pid.c, filter.c,
controller_mellinger.c and power_distribution_quadrotor.c of bitcraze/crazyflie-firmware at commit 2a18fc29, statement
by statement, in the firmware's units and signs (degrees; pitch positive nose up), without rounding to integers.
"""

import math

import numpy as np

RATE, POSITION_EVERY = 500, 5


def constrain(x, low, high):
    return min(max(x, low), high)


def cap_angle(angle):
    while angle > 180:
        angle -= 360
    while angle < -180:
        angle += 360
    return angle


class Pid:
    def __init__(self, kp, ki, kd, dt, limit=5000.0, cutoff=None):
        self.kp, self.ki, self.kd, self.dt, self.limit = kp, ki, kd, dt, limit
        self.prev = self.integ = 0.0
        self.output_limit = 0.0
        self.cutoff = cutoff
        self.reset_filter()

    def reset_filter(self):
        self.d1 = self.d2 = 0.0

    def reset(self, actual):
        self.prev, self.integ = actual, 0.0

    def low_pass(self, sample):
        ohm = math.tan(math.pi / (1 / self.dt / self.cutoff))
        c = 1 + 2 * math.cos(math.pi / 4) * ohm + ohm * ohm
        b0, a1 = ohm * ohm / c, 2 * (ohm * ohm - 1) / c
        a2 = (1 - 2 * math.cos(math.pi / 4) * ohm + ohm * ohm) / c
        d0 = sample - self.d1 * a1 - self.d2 * a2
        out = d0 * b0 + self.d1 * 2 * b0 + self.d2 * b0
        self.d2, self.d1 = self.d1, d0
        return out

    def update(self, desired, measured, is_yaw=False):
        error = desired - measured
        if is_yaw and error > 180:
            error -= 360
        elif is_yaw and error < -180:
            error += 360
        delta = -(measured - self.prev)
        if is_yaw and delta > 180:
            delta -= 360
        elif is_yaw and delta < -180:
            delta += 360
        deriv = delta / self.dt
        if self.cutoff:
            deriv = self.low_pass(deriv)
        self.integ = constrain(self.integ + error * self.dt, -self.limit, self.limit)
        out = self.kp * error + self.kd * deriv + self.ki * self.integ
        if self.output_limit:
            out = constrain(out, -self.output_limit, self.output_limit)
        self.prev = measured
        return out


def attitude_degrees(quat):
    """Roll, pitch (positive nose up) and yaw, degrees."""
    x, y, z, w = quat
    roll = math.atan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    pitch = math.asin(constrain(2 * (w * y - x * z), -1, 1))
    yaw = math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    return math.degrees(roll), -math.degrees(pitch), math.degrees(yaw)


def motors_of(thrust, roll, pitch, yaw):
    """PWM of the four motors; yaw is positive clockwise, as in control_t."""
    r, p = roll / 2, pitch / 2
    m = [thrust - r + p + yaw, thrust - r - p - yaw, thrust + r - p + yaw, thrust + r + p - yaw]
    reduction = max(max(m) - 65535, 0)
    return [max(x - reduction, 0) for x in m]


class ReferencePid:
    """Platforms "cf2" and "cf21bl"; modes "state", "attitude", "body_rate" (where the yaw rate moves a yaw angle)."""

    def __init__(self, mode, platform="cf2", kd_pos=0.0, kd_vel=0.0):
        self.mode, self.first, self.k = mode, True, 0
        self.base = {"cf2": 36000.0, "cf21bl": 30000.0}[platform]
        kp, ki = {"cf2": (250.0, 500.0), "cf21bl": (200.0, 400.0)}[platform]
        dt, slow = 1 / RATE, POSITION_EVERY / RATE
        self.x, self.y = (Pid(2.0, 0.0, kd_pos, slow, cutoff=20.0) for _ in range(2))
        self.z = Pid(2.0, 0.5, kd_pos, slow, cutoff=20.0)
        self.vx, self.vy = (Pid(25.0, 1.0, kd_vel, slow, cutoff=20.0) for _ in range(2))
        self.vz = Pid(25.0, 15.0, kd_vel, slow, cutoff=20.0)
        self.roll, self.pitch = (Pid(6.0, 3.0, 0.0, dt, 20.0) for _ in range(2))
        self.yaw = Pid(6.0, 1.0, 0.35, dt, 360.0)
        self.rate_x, self.rate_y = (Pid(kp, ki, 2.5, dt, 33.3) for _ in range(2))
        self.rate_z = Pid(120.0, 16.7, 0.0, dt, 166.7)
        self.att = [0.0, 0.0, 0.0]
        self.thrust = 0.0

    def reinitialize(self, pos, att):
        for pid, value in zip((self.x, self.y, self.z), pos, strict=True):
            pid.reset(value)
        for pid in (self.vx, self.vy, self.vz):
            pid.reset(0.0)
        for pid in (self.x, self.y, self.z, self.vx, self.vy, self.vz):
            pid.reset_filter()
        for pid, value in zip((self.roll, self.pitch, self.yaw), att, strict=True):
            pid.reset(value)
        for pid in (self.rate_x, self.rate_y, self.rate_z):
            pid.reset(0.0)
        self.att[0], self.att[1] = att[0], att[1]

    def tick(self, pos, vel, quat, ang_vel, command):
        """PWM of the motors after one tick at 500 Hz, from the state and a command in crazysim's units (PWM thrust)."""
        att = attitude_degrees(quat)
        gyro = np.degrees(ang_vel)
        if self.first:
            self.reinitialize(pos, att)
            self.att[2], self.first = att[2], False
        if self.mode == "state":
            x, y, z, w = command[9:13]
            self.att[2] = math.degrees(math.atan2(2 * (x * y + w * z), x * x + w * w - y * y - z * z))
        elif self.mode == "attitude":
            self.att[2] = math.degrees(command[2])
        else:
            self.att[2] += math.degrees(command[2]) / RATE
        self.att[2] = cap_angle(self.att[2])
        if self.mode == "state" and self.k % POSITION_EVERY == 0:
            self.position(pos, vel, att[2], command)
        if self.mode != "state":
            self.thrust = command[3]
        if self.mode == "attitude":
            self.att[0], self.att[1] = math.degrees(command[0]), -math.degrees(command[1])
        rates = [
            self.roll.update(self.att[0], att[0]),
            self.pitch.update(self.att[1], att[1]),
            self.yaw.update(self.att[2], att[2], is_yaw=True),
        ]
        if self.mode == "body_rate":
            rates[:2] = math.degrees(command[0]), -math.degrees(command[1])
        limit = 32767
        roll = constrain(self.rate_x.update(rates[0], gyro[0]), -limit, limit)
        pitch = constrain(self.rate_y.update(rates[1], -gyro[1]), -limit, limit)
        yaw = -constrain(self.rate_z.update(rates[2], gyro[2]), -limit, limit)
        thrust = self.thrust
        if thrust == 0:
            roll = pitch = yaw = 0.0
            self.reinitialize(pos, att)
            self.att[2] = att[2]
        self.k += 1
        return motors_of(thrust, roll, pitch, yaw)

    def position(self, pos, vel, yaw, command):
        for pid in (self.x, self.y, self.z):
            pid.output_limit = 1.1
        self.vx.output_limit = self.vy.output_limit = 22.0
        self.vz.output_limit = 32.767
        c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))

        def body(v):
            return v[0] * c + v[1] * s, -v[0] * s + v[1] * c

        (set_x, set_y), (at_x, at_y) = body(command[0:2]), body(pos[0:2])
        wanted = [self.x.update(set_x, at_x), self.y.update(set_y, at_y), self.z.update(command[2], pos[2])]
        vx, vy = body(vel[0:2])
        self.att[1] = constrain(-self.vx.update(wanted[0], vx), -20, 20)
        self.att[0] = constrain(-self.vy.update(wanted[1], vy), -20, 20)
        thrust = self.vz.update(wanted[2], vel[2]) * 1000 + self.base
        self.thrust = constrain(max(thrust, 20000), 0, 65535)


def rotation_matrix(quat):
    x, y, z, w = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_of_rpy(roll, pitch, yaw):
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return rz @ ry @ rx


class ReferenceMellinger:
    """Modes "state" and "attitude"."""

    def __init__(self, mode, mass=0.029):
        self.mode, self.mass = mode, mass
        self.i_pos, self.i_m = np.zeros(3), np.zeros(3)
        self.prev_omega, self.prev_set = np.zeros(3), np.zeros(3)

    def tick(self, pos, vel, quat, ang_vel, command):
        """PWM of the motors after one tick at 500 Hz, from the state and a command in crazysim's units (PWM thrust)."""
        dt = 1 / RATE
        R = rotation_matrix(quat)
        rates = np.zeros(3)
        if self.mode == "state":
            r_error, v_error = command[0:3] - pos, command[3:6] - vel
            self.i_pos = np.clip(self.i_pos + r_error * dt, [-2, -2, -0.4], [2, 2, 0.4])
            force = (
                self.mass * (command[6:9] + [0, 0, 9.81])
                + np.array([0.4, 0.4, 1.25]) * r_error
                + np.array([0.2, 0.2, 0.4]) * v_error
                + 0.05 * self.i_pos
            )
            z_des = force / np.linalg.norm(force)
            x, y, z, w = command[9:13]
            yaw = math.atan2(2 * (x * y + w * z), x * x + w * w - y * y - z * z)
            y_des = np.cross(z_des, [math.cos(yaw), math.sin(yaw), 0])
            y_des = y_des / np.linalg.norm(y_des)
            Rd = np.stack([np.cross(y_des, z_des), y_des, z_des], axis=1)
            rates = np.asarray(command[13:16])
            thrust = 132000 * force @ R[:, 2]
        else:
            Rd = matrix_of_rpy(*command[:3])
            thrust = command[3]
        eRM = Rd.T @ R - R.T @ Rd
        eR = np.array([eRM[2, 1], eRM[0, 2], eRM[1, 0]])
        derivative = ((rates - self.prev_set) - (ang_vel - self.prev_omega)) / dt
        self.prev_omega, self.prev_set = np.array(ang_vel), rates
        self.i_m = np.clip(self.i_m - eR * dt, [-1, -1, -1500], [1, 1, 1500])
        kR, kw = np.array([70000, 70000, 60000]), np.array([20000, 20000, 12000])
        M = -kR * eR + kw * (rates - ang_vel) + np.array([0, 0, 500]) * self.i_m
        M = np.clip(M + np.array([200, 200, 0]) * derivative, -32000, 32000)
        if thrust <= 0:
            M, self.i_pos, self.i_m = np.zeros(3), np.zeros(3), np.zeros(3)
        return motors_of(thrust, M[0], -M[1], -M[2])
