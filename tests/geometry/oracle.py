"""C MuJoCo's answers to the same questions, one sample after the other, and samples to ask."""

import mujoco
import numpy as np

from crazysim.geometry import Shape

SHAPES = {
    "plane": Shape("plane"),
    "sphere": Shape("sphere", (0.35,)),
    "capsule": Shape("capsule", (0.2, 0.4)),
    "box": Shape("box", (0.3, 0.5, 0.2)),
    "cylinder": Shape("cylinder", (0.4, 0.25)),
    "ellipsoid": Shape("ellipsoid", (0.5, 0.3, 0.15)),
}


def geom(shape):
    """Return a shape as MuJoCo's XML."""
    size = "0 0 1" if shape.kind == "plane" else " ".join(map(str, shape.size))
    return f'<geom type="{shape.kind}" size="{size}"/>'


def model(a, b):
    """Return a model of shape ``b``, which is geom 0 and stays, and shape ``a``, which moves."""
    return mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option ccd_iterations="500" ccd_tolerance="1e-10"/>
          <worldbody>
            {geom(b)}
            <body mocap="true">{geom(a)}</body>
          </worldbody>
        </mujoco>""")


def distances(a, b, pos, quat):
    """Return MuJoCo's signed distance of ``a`` at every pose, attitude wxyz, to ``b``. (n,)"""
    m = model(a, b)
    d = mujoco.MjData(m)
    out = np.empty(len(pos))
    for i, (p, q) in enumerate(zip(pos, quat, strict=True)):
        d.mocap_pos[0], d.mocap_quat[0] = p, q
        mujoco.mj_kinematics(m, d)
        out[i] = mujoco.mj_geomDistance(m, d, 1, 0, 100.0, None)
    return out


def rays(shape, origin, direction):
    """Return how far MuJoCo's rays go, infinite where they miss, and the normals there. (n,), (n, 3)"""
    m = model(Shape("sphere", (1e-3,)), shape)
    d = mujoco.MjData(m)
    d.mocap_pos[0] = [0, 0, -1e4]
    mujoco.mj_kinematics(m, d)
    t, normals, which = np.empty(len(origin)), np.zeros((len(origin), 3)), np.zeros(1, np.int32)
    for i in range(len(origin)):
        t[i] = mujoco.mj_ray(m, d, origin[i], direction[i], None, 1, 1, which, normals[i])
    return np.where(t < 0, np.inf, t), normals


def rotations(quat):
    """Return rotation matrices of unit quaternions, wxyz. (n, 3, 3)"""
    out = np.empty((len(quat), 9))
    for i, q in enumerate(quat):
        mujoco.mju_quat2Mat(out[i], q)
    return out.reshape(-1, 3, 3)


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def places(rng, n):
    """Return points near, in and far from shapes of about half a metre. (n, 3)"""
    reach = rng.choice([0.05, 0.5, 1.0, 10.0], (n, 1), p=[0.1, 0.4, 0.4, 0.1])
    return reach * rng.uniform(-1, 1, (n, 3))
