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


def reach(shape, n):
    """Return how far a shape reaches along directions in its own frame. (..., 3) -> (...)"""
    x, y, z = np.moveaxis(np.abs(n), -1, 0)
    if shape.kind == "mesh":
        return np.max(n @ shape.vertices.T, axis=-1)
    size = shape.size
    return {
        "sphere": lambda r: r + 0 * x,
        "capsule": lambda r, h: r + h * z,
        "box": lambda a, b, c: a * x + b * y + c * z,
        "cylinder": lambda r, h: r * np.hypot(x, y) + h * z,
        "ellipsoid": lambda a, b, c: np.sqrt((a * x) ** 2 + (b * y) ** 2 + (c * z) ** 2),
    }[shape.kind](*size)


def overlaps(a, b, pos, rot, rng, n_directions=1500, n_best=6, n_rounds=40):
    """Return how deep shapes overlap by searching for the shortest way out among directions, then around the best. (n,)

    An upper bound, close to the least: MuJoCo has a depth of its own for some pairs, and an estimate for others.
    """
    k = np.arange(n_directions) + 0.5
    z, angle = 1 - 2 * k / n_directions, np.pi * (1 + 5**0.5) * k
    n = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=-1)

    def depth(n):
        return reach(a, -n @ rot) + reach(b, n) - np.sum(n * pos[:, None], axis=-1)

    everywhere = depth(np.broadcast_to(n, (len(pos), *n.shape)))
    best = n[np.argsort(everywhere, axis=1)[:, :n_best]]
    value, width = depth(best), 3 / np.sqrt(n_directions)
    for _ in range(n_rounds):
        tried = unit(best[:, :, None] + width * rng.normal(size=(*best.shape[:2], 12, 3)))
        values = depth(tried.reshape(len(pos), -1, 3)).reshape(*best.shape[:2], 12)
        first = np.argmin(values, axis=2)[..., None]
        new = np.take_along_axis(values, first, axis=2)[..., 0]
        better = new < value
        best = np.where(better[..., None], np.take_along_axis(tried, first[..., None], axis=2)[:, :, 0], best)
        value, width = np.where(better, new, value), width * 0.8
    return value.min(axis=1)


DRONES = {
    "sphere": Shape("sphere", (0.1,)),
    "capsule": Shape("capsule", (0.06, 0.15)),
    "box": Shape("box", (0.15, 0.1, 0.05)),
}
"""Shapes that a drone may have."""


def poses(rng, n):
    """Return positions and attitudes, wxyz; some with axes that are parallel, or at 45 and 90 degrees."""
    quat = rng.normal(size=(n, 4))
    quat[: n // 10] = [1, 0, 0, 0]
    quat[n // 10 : n // 5] = rng.choice([-1.0, 0, 1], (n // 5 - n // 10, 4)) + [1e-9, 0, 0, 0]
    return places(rng, n), unit(quat)


def check_pair(a, b, distance, rng, n, tolerance):
    """Check distances of shapes apart against MuJoCo's, depths against a search of directions, and all signs."""
    pos, quat = poses(rng, n)
    rot = rotations(quat)
    found, expected = np.asarray(distance(a, b, pos, rot)), distances(a, b, pos, quat)
    apart = expected > 0
    counts = np.sum(apart), np.sum(~apart), np.sum(np.abs(expected) < 0.02)
    assert min(counts) > 0.01 * n, counts
    np.testing.assert_array_equal(found > 0, apart)
    np.testing.assert_allclose(found[apart], expected[apart], atol=tolerance)
    inside = np.flatnonzero(~apart)[:200]
    if b.kind == "plane":
        depth = -expected[inside]
    else:
        depth = overlaps(a, b, pos[inside], rot[inside], rng)
    # The search misses the least depth by up to a millimetre; no depth may be below it.
    slack = 1e-9 if tolerance < 1e-4 else tolerance
    assert np.max(-found[inside] - depth) < slack
    assert np.max(depth + found[inside]) < 1e-3


def check_slopes(a, b, distance, rng, n):
    """Check that gradients equal central differences where these are those of a distance, and are finite."""
    import jax
    import jax.numpy as jnp

    pos, quat = poses(rng, n)
    rot, h = rotations(quat), 1e-6
    spin = unit(rng.normal(size=(n, 3)))
    cross = np.zeros((n, 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]], cross[:, [1, 2, 0], [2, 0, 1]] = spin, -spin
    total = lambda p, r: jnp.sum(distance(a, b, p, r))  # noqa: E731
    by_pos, by_rot = map(np.asarray, jax.jit(jax.grad(total, (0, 1)))(pos, rot))
    assert np.isfinite(by_pos).all()
    assert np.isfinite(by_rot).all()
    np.testing.assert_array_less(np.linalg.norm(by_pos, axis=1), 1 + 1e-6)
    steps = h * np.eye(3)[:, None]
    there, back = (np.asarray(distance(a, b, pos + s * steps, rot)) for s in (1, -1))
    differences = np.moveaxis(there - back, 0, -1) / (2 * h)
    smooth = np.abs(np.linalg.norm(differences, axis=1) - 1) < 1e-3
    there, back = (np.asarray(distance(a, b, pos, rot + s * h * cross @ rot)) for s in (1, -1))
    turning = (there - back) / (2 * h)
    assert np.mean(smooth) > 0.8
    turned = smooth & (np.arange(n) >= n // 5)  # where axes are parallel the distance has a crease
    by_turn = np.sum(by_rot * (cross @ rot), axis=(1, 2))
    return by_pos[smooth] - differences[smooth], by_turn[turned] - turning[turned]
