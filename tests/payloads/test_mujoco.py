"""The same drone, hinge and load in C MuJoCo: five seconds of swinging, and of a hover under feedback."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from crazysim import Sim
from crazysim.payloads import Hook

FREQ, SECONDS, LENGTH, LOAD, HOOK = 500, 5, 0.4, 0.2, 0.0203
MASS, INERTIA = 0.605, (1.5e-3, 1.45e-3, 2.66e-3)
START = np.array([0.3, -0.2, 2.0])


def model(dof, attach, damping):
    joints = ['<joint name="pitch" type="hinge" axis="0 1 0"/>', '<joint name="roll" type="hinge" axis="1 0 0"/>'][:dof]
    joints = "".join(joints).replace("type", f'damping="{damping}" type')
    return mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="{1 / FREQ}" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody><body name="drone"><freejoint/>
    <inertial pos="0 0 0" mass="{MASS}" diaginertia="{" ".join(map(str, INERTIA))}"/>
    <body name="rod" pos="{" ".join(map(str, attach))}">{joints}
      <inertial pos="0 0 {-LENGTH}" mass="{LOAD + HOOK}" diaginertia="1e-9 1e-9 1e-9"/>
      <site name="tip" pos="0 0 {-LENGTH}"/>
    </body></body></worldbody></mujoco>""")


def constant(pos, vel, quat, ang_vel):
    """Return a thrust along the body's z axis that carries drone, hook and load, and no torque."""
    return np.array([0, 0, (MASS + LOAD + HOOK) * 9.81]), np.zeros(3)


def feedback(pos, vel, quat, ang_vel):
    """Return thrust and body torque that hold position and attitude."""
    x, y, z, w = quat
    up = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    wanted = (MASS + LOAD + HOOK) * np.array([0, 0, 9.81]) - 4 * (pos - START) - 2.5 * vel
    tilt = np.cross(up, wanted / np.linalg.norm(wanted))
    rot = np.zeros(9)
    mujoco.mju_quat2Mat(rot, np.array([w, x, y, z]))
    return np.array([0, 0, wanted @ up]), 1.2 * rot.reshape(3, 3).T @ tilt - 0.15 * ang_vel


def of_mujoco(dof, attach, damping, angles, ang_vel, law):
    """Return positions of drone and tip after every tenth step, m. (n, 2, 3)"""
    m = model(dof, attach, damping)
    d = mujoco.MjData(m)
    d.qpos[:3], d.qpos[7 : 7 + dof], d.qvel[3:6] = START, angles[:dof], ang_vel
    mujoco.mj_forward(m, d)
    tip_vel = np.zeros(6)
    mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_SITE, 0, tip_vel, 0)
    start, found = (d.site_xpos[0].copy(), tip_vel[3:].copy()), []
    for k in range(FREQ * SECONDS):
        force, torque = law(d.qpos[:3], d.qvel[:3], np.roll(d.qpos[3:7], -1), d.qvel[3:6])
        rot = d.xmat[1].reshape(3, 3)
        d.xfrc_applied[1] = np.concatenate([rot @ force, rot @ torque])
        mujoco.mj_step(m, d)
        if k % 10 == 9:
            mujoco.mj_kinematics(m, d)
            found.append([d.qpos[:3].copy(), d.site_xpos[0].copy()])
    return np.array(found), start


def of_crazysim(dof, attach, damping, start, ang_vel, law, integrator):
    sim = Sim(drone="bumblebee", control="rotor_vel", integrator=integrator, freq=FREQ, engine="fused", strict=True)
    s = sim.data.states
    sim.data = sim.data.replace(
        states=s.replace(pos=s.pos * 0 + START, ang_vel=s.ang_vel + np.asarray(ang_vel)),
        params=sim.data.params.replace(rpm2torque=0 * sim.data.params.rpm2torque),
    )
    hook = sim.add(Hook(LOAD, dof, attach=attach, damping=damping, hook_mass=HOOK, length=LENGTH, in_scene=False))
    record = hook.read(sim.data)
    tip = {"tip_pos": start[0], "tip_vel": start[1], "pos": start[0], "vel": start[1]}
    sim.data = hook.write(sim.data, record.replace(**{k: jnp.asarray(v)[None, None] for k, v in tip.items()}))
    found = []
    for k in range(FREQ * SECONDS):
        s = sim.data.states
        pos, vel, quat, w = (np.asarray(x)[0, 0] for x in (s.pos, s.vel, s.quat, s.ang_vel))
        force, torque = law(pos, vel, quat, w)
        rot = np.zeros(9)
        mujoco.mju_quat2Mat(rot, np.roll(quat, 1))
        force, torque = rot.reshape(3, 3) @ force, rot.reshape(3, 3) @ torque
        sim.data = sim.data.replace(states=s.replace(force=force[None, None], torque=torque[None, None]))
        sim.step()
        if k % 10 == 9:
            found.append([np.asarray(sim.data.states.pos)[0, 0], np.asarray(hook.read(sim.data).tip_pos)[0, 0]])
    return np.array(found)


CASES = {
    # degrees of freedom, joint, damping, initial angles, initial body rates, forces
    "swing": (2, (0, 0, 0), 0.0, (0.6, 0.3), (0, 0, 0), constant),
    "swing, hinge": (1, (0, 0, 0), 0.001, (0.8, 0.0), (0.3, 0, 0.5), feedback),
    "hover": (2, (0.01, 0, -0.02), 0.001, (0.3, 0.2), (0, 0, 0.5), feedback),
    "hover, hinge": (1, (0.01, 0, -0.02), 0.001, (0.3, 0.0), (0, 0, 0.5), feedback),
}
WITHIN = {"swing": 1e-5, "swing, hinge": 1e-4, "hover": 3e-5, "hover, hinge": 1e-5}
"""Largest distance of drone or tip in MuJoCo, m. In ``hover`` MuJoCo damps two hinge angles in turn, crazysim the
angular velocity of the rod, which differ in the second order of the angle."""


@pytest.mark.parametrize("case", CASES)
def test_five_seconds_as_in_mujoco(case, x64):
    dof, attach, damping, angles, ang_vel, law = CASES[case]
    want, start = of_mujoco(dof, attach, damping, angles, ang_vel, law)
    got = of_crazysim(dof, attach, damping, start, ang_vel, law, "rk4")
    error = np.linalg.norm(got - want, axis=-1).max(axis=0)
    swings = np.ptp(want[:, 1] - want[:, 0], axis=0).max()
    print(f"{case}: drone {error[0]:.1e} m, tip {error[1]:.1e} m; the tip swings over {swings:.2f} m")
    assert swings > 0.15
    assert error.max() < WITHIN[case]
