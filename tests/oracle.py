"""Reference distances and rays from C MuJoCo, and samples to compare them on."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from crazysim.geometry import Shape, distance, hfield, hull

SHAPES = {
    "plane": Shape("plane"),
    "sphere": Shape("sphere", (0.35,)),
    "capsule": Shape("capsule", (0.2, 0.4)),
    "box": Shape("box", (0.3, 0.5, 0.2)),
    "cylinder": Shape("cylinder", (0.4, 0.25)),
    "ellipsoid": Shape("ellipsoid", (0.5, 0.3, 0.15)),
    "hfield": hfield(np.random.default_rng(6).uniform(0, 0.4, (6, 8)), (0.6, 0.5, 0.4, 0.2)),
    "mesh": hull(0.5 * np.random.default_rng(4).normal(size=(14, 3))),
}


def geom_xml(shape):
    """Return a shape as MuJoCo's XML."""
    if shape.kind == "mesh":
        return '<geom type="mesh" mesh="mesh"/>'
    if shape.kind == "hfield":
        return '<geom type="hfield" hfield="field"/>'
    size = "0 0 1" if shape.kind == "plane" else " ".join(map(str, shape.size))
    return f'<geom type="{shape.kind}" size="{size}"/>'


def make_model(a, b):
    """Return a MuJoCo model with shape ``b`` as geom 0, which is fixed, and shape ``a``, which can move."""
    asset = ""
    if b.kind == "mesh":
        vertices = " ".join(map(str, b.vertices.ravel()))
        asset = f'<asset><mesh name="mesh" vertex="{vertices}"/></asset>'
    if b.kind == "hfield":
        size, (n_rows, n_columns) = " ".join(map(str, b.size)), b.heights.shape
        asset = f'<asset><hfield name="field" nrow="{n_rows}" ncol="{n_columns}" size="{size}"/></asset>'
    m = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option ccd_iterations="500" ccd_tolerance="1e-10"/>
          {asset}
          <worldbody>
            {geom_xml(b)}
            <body mocap="true">{geom_xml(a)}</body>
          </worldbody>
        </mujoco>""")
    if b.kind == "hfield":
        m.hfield_data[:] = b.heights.ravel() / b.size[2]
    return m


def distances(a, b, pos, quat):
    """Return MuJoCo's signed distance of ``a`` at every pose, attitude wxyz, to ``b``. (n,)"""
    m = make_model(a, b)
    d = mujoco.MjData(m)
    out = np.empty(len(pos))
    for i, (p, q) in enumerate(zip(pos, quat, strict=True)):
        d.mocap_pos[0], d.mocap_quat[0] = p, q
        mujoco.mj_kinematics(m, d)
        out[i] = mujoco.mj_geomDistance(m, d, 1, 0, 100.0, None)
    return out


def cast_rays(shape, origin, direction):
    """Return distances of rays by MuJoCo, infinite for misses, and normals at the hits. (n,), (n, 3)"""
    m = make_model(Shape("sphere", (1e-3,)), shape)
    d = mujoco.MjData(m)
    d.mocap_pos[0] = [0, 0, -1e4]
    mujoco.mj_kinematics(m, d)
    t, normals, geom_id = np.empty(len(origin)), np.zeros((len(origin), 3)), np.zeros(1, np.int32)
    for i in range(len(origin)):
        t[i] = mujoco.mj_ray(m, d, origin[i], direction[i], None, 1, 1, geom_id, normals[i])
    return np.where(t < 0, np.inf, t), normals


def rotations(quat):
    """Return rotation matrices of unit quaternions, wxyz. (n, 3, 3)"""
    out = np.empty((len(quat), 9))
    for i, q in enumerate(quat):
        mujoco.mju_quat2Mat(out[i], q)
    return out.reshape(-1, 3, 3)


def normalize(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def random_points(rng, n):
    """Return points near, in and far from shapes of about half a metre. (n, 3)"""
    reach = rng.choice([0.05, 0.5, 1.0, 10.0], (n, 1), p=[0.1, 0.4, 0.4, 0.1])
    return reach * rng.uniform(-1, 1, (n, 3))


def support(shape, n):
    """Return the support function of a shape along directions in its own frame, m. (..., 3) -> (...)"""
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


def overlap_depths(a, b, pos, rot, rng, n_directions=1500, n_best=6, n_rounds=40):
    """Return the depth of overlaps, m, by a search over directions that is refined around the best. (n,)

    It is a tight upper bound; MuJoCo defines the depth differently for some pairs, and estimates it for others.
    """
    k = np.arange(n_directions) + 0.5
    z, angle = 1 - 2 * k / n_directions, np.pi * (1 + 5**0.5) * k
    n = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=-1)

    def depth(n):
        return support(a, -n @ rot) + support(b, n) - np.sum(n * pos[:, None], axis=-1)

    all_depths = depth(np.broadcast_to(n, (len(pos), *n.shape)))
    best = n[np.argsort(all_depths, axis=1)[:, :n_best]]
    value, width = depth(best), 3 / np.sqrt(n_directions)
    for _ in range(n_rounds):
        tried = normalize(best[:, :, None] + width * rng.normal(size=(*best.shape[:2], 12, 3)))
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
"""Shapes of drones."""


def poses(rng, n):
    """Return positions and attitudes, wxyz; some with parallel axes, or with axes at 45 and 90 degrees."""
    quat = rng.normal(size=(n, 4))
    quat[: n // 10] = [1, 0, 0, 0]
    quat[n // 10 : n // 5] = rng.choice([-1.0, 0, 1], (n // 5 - n // 10, 4)) + [1e-9, 0, 0, 0]
    return random_points(rng, n), normalize(quat)


@functools.cache
def compile_distance_and_slopes(a, b):
    def total(pos, rot):
        values = distance(a, b, pos, rot)
        return jnp.sum(values), values

    value_and_slopes = jax.jit(jax.value_and_grad(total, (0, 1), has_aux=True))

    def evaluate(pos, rot):
        (_, value), slopes = value_and_slopes(pos, rot)
        return tuple(map(np.asarray, (value, *slopes)))

    return evaluate


def check_pair(a, b, rng, n, separated_tolerance=1e-5, shallow_tolerance=1e-6, deep_tolerance=1e-6):
    """Check distances of separated shapes against MuJoCo, depths against a search over directions, and all signs."""
    pos, quat = poses(rng, n)
    rot, evaluate = rotations(quat), compile_distance_and_slopes(a, b)
    (actual, by_pos, _), expected = evaluate(pos, rot), distances(a, b, pos, quat)
    is_apart = expected > 0
    counts = np.sum(is_apart), np.sum(~is_apart), np.sum(np.abs(expected) < 0.02)
    assert min(counts) > 0.01 * n, counts
    np.testing.assert_array_equal(actual > 0, is_apart)
    np.testing.assert_allclose(actual[is_apart], expected[is_apart], atol=separated_tolerance)
    inside = np.flatnonzero(~is_apart)[:200]
    depth = -expected[inside] if b.kind == "plane" else overlap_depths(a, b, pos[inside], rot[inside], rng)
    # The search must not find a shorter translation, and the computed one must separate the shapes.
    limit = np.where(depth < 0.05, shallow_tolerance, deep_tolerance)
    assert np.all(-actual[inside] - depth < limit), np.max(-actual[inside] - depth)
    separated_pos = pos[inside] + by_pos[inside] * (1e-5 - actual[inside, None])
    assert np.min(distances(a, b, separated_pos, quat[inside])) > 0


def check_slopes(a, b, rng, n, deepest=-np.inf):
    """Return the errors of gradients against central differences at smooth points; all gradients must be finite.

    Shapes that overlap by more than ``-deepest`` are excluded.
    """
    pos, quat = poses(rng, n)
    rot, evaluate, h = rotations(quat), compile_distance_and_slopes(a, b), 1e-6
    spin = normalize(rng.normal(size=(n, 3)))
    cross = np.zeros((n, 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]], cross[:, [1, 2, 0], [2, 0, 1]] = spin, -spin
    value, by_pos, by_rot = evaluate(pos, rot)
    assert np.isfinite(by_pos).all()
    assert np.isfinite(by_rot).all()
    np.testing.assert_array_less(np.linalg.norm(by_pos, axis=1), 1 + 1e-6)
    sides = np.array([[evaluate(pos + s * h * e, rot)[0] for e in np.eye(3)] for s in (1, -1)])
    differences = (sides[0] - sides[1]).T / (2 * h)
    forward, backward = (evaluate(pos, rot + s * h * cross @ rot)[0] for s in (1, -1))
    turn_differences = (forward - backward) / (2 * h)
    smooth = np.abs(np.linalg.norm(differences, axis=1) - 1) < 1e-3
    smooth = smooth & (value > deepest)
    assert np.mean(smooth) > 0.4
    is_smooth_turn = smooth & (np.arange(n) >= n // 5)  # where axes are parallel the distance has a crease
    by_turn = np.sum(by_rot * (cross @ rot), axis=(1, 2))
    return np.abs(by_pos[smooth] - differences[smooth]).max(axis=1), np.abs(
        by_turn[is_smooth_turn] - turn_differences[is_smooth_turn]
    )


def check_finite(a, b, dtype, n):
    """Check that distances and gradients are finite with aligned centres, faces and edges, and far away.

    The number of poses is the same as in another test, so that nothing is compiled twice; 1,250 of them differ.
    """
    size = np.asarray([*b.size, 0.3, 0.3, 0.3])[:3]
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 0.5, 1.0, 1e4]] * 3), axis=-1).reshape(-1, 3)
    turns = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [0, 1, 1, 0], [1, 1, 1, 1], [1, 1e-4, 0, 0]], float)
    reach = size + np.asarray([*a.size, 0.1, 0.1])[:3]
    pos = np.concatenate([np.repeat(grid * scale, len(turns), axis=0) for scale in (size, reach)])
    rot = np.tile(rotations(normalize(turns)), (2 * len(grid), 1, 1))
    with jax.enable_x64(dtype == np.float64):
        for x in compile_distance_and_slopes(a, b)(
            np.resize(pos, (n, 3)).astype(dtype), np.resize(rot, (n, 3, 3)).astype(dtype)
        ):
            assert x.dtype == dtype
            assert np.isfinite(x).all()
