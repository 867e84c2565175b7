"""Construction of the scene: a base file, one mocap body per drone, and the user's objects."""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from crazysim.drones.airframe import Airframe
from crazysim.drones.body import LED_MATERIALS, MATERIALS, MAX_LED_DRONES, BodyGeom, body_cameras, body_geoms
from crazysim.errors import ConfigError, require
from crazysim.scene import mjx

SCENE_FILE = Path(__file__).parents[1] / "scene.xml"
"""MJCF file of the default scene: floor, light and sky."""

DRONES_PER_CHUNK = 128
"""Largest number of drones that are added to a spec one by one."""


def build_spec(
    xml_path: str | Path | mujoco.MjSpec | None, airframes: Sequence[Airframe], freq: int, max_geom_pairs: int
) -> mujoco.MjSpec:
    """Return the scene as an editable spec, with the drones ``drone:0``, ``drone:1``, ... in it.

    Args:
        xml_path: MJCF scene without drones, or its spec; None for the default scene.
        airframes: Airframe of each drone. (n_drones,)
        freq: Physics steps per second, Hz.
        max_geom_pairs: Largest number of pairs that MJX checks per kind of collision; -1 for all.

    Raises:
        ConfigError: If the file does not exist, cannot be read, or has names that are reserved for drones.
    """
    _handle_warnings_of_mujoco()
    spec = xml_path if isinstance(xml_path, mujoco.MjSpec) else read_spec(xml_path)
    spec.option.timestep = 1 / freq
    spec.add_numeric(name="max_geom_pairs", data=[max_geom_pairs])
    reserved_names = [body.name for body in spec.bodies if body.name.startswith("drone:")]
    require(
        not reserved_names,
        f"expected no bodies named 'drone:...', which are reserved for the drones, got {reserved_names} in "
        f"{str(xml_path)!r}",
    )
    _add_drones(spec, airframes)
    # mjx.kinematics refuses a model without any degree of freedom, and mocap bodies have none.
    dummy = spec.worldbody.add_body(name="_dummy", mass=1e-6, inertia=[1e-9] * 3)
    dummy.add_joint(name="_dummy_joint", type=mujoco.mjtJoint.mjJNT_SLIDE)
    # A body of a user's spec can then be attached several times.
    spec.copy_during_attach = True
    return spec


def read_spec(xml_path: str | Path | None) -> mujoco.MjSpec:
    """Return the spec of an MJCF file; None for the default scene: floor, light and sky.

    Raises:
        ConfigError: If the file does not exist or cannot be read.
    """
    require(
        xml_path is None or isinstance(xml_path, (str, Path)),
        f"expected the path of an MJCF file or None as xml_path, got {xml_path!r}",
    )
    path = SCENE_FILE if xml_path is None else Path(xml_path)
    require(path.is_file(), f"expected an existing MJCF file as xml_path, got {str(path)!r}")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ConfigError(f"expected a scene that MuJoCo can read, got {str(path)!r}: {error}") from error


def _add_drones(spec: mujoco.MjSpec, airframes: Sequence[Airframe]) -> None:
    # MuJoCo goes through the whole spec for every geom that is added and every body that is attached. 4,096 drones take
    # 30 s one by one, and 2 s in chunks that are filled separately.
    n_drones = len(airframes)
    leds = dict.fromkeys((_material_name(led, i) for i in range(n_drones) for led in LED_MATERIALS), (1, 1, 1, 0.15))
    for name, rgba in (MATERIALS | leds).items():
        spec.add_material(name=name, rgba=rgba)
    if n_drones <= DRONES_PER_CHUNK:
        _add_bodies(spec, airframes, range(n_drones))
        return
    for first in range(0, n_drones, DRONES_PER_CHUNK):
        chunk = mujoco.MjSpec()
        _add_bodies(chunk, airframes, range(first, min(first + DRONES_PER_CHUNK, n_drones)))
        spec.attach(chunk, prefix="", frame=spec.worldbody.add_frame())


def _handle_warnings_of_mujoco() -> None:
    # Its warning that attached names have no prefix is left out: scenes are not saved here.
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(
            lambda text: None if "empty prefix" in text else print(f"MuJoCo: {text}", file=sys.stderr)
        )


def _add_bodies(spec: mujoco.MjSpec, airframes: Sequence[Airframe], indices: range) -> None:
    unique_airframes = {id(airframe): airframe for airframe in airframes}
    parts = {key: (body_geoms(airframe), body_cameras(airframe)) for key, airframe in unique_airframes.items()}
    for i in indices:
        geoms, cameras = parts[id(airframes[i])]
        body = spec.worldbody.add_body(name=f"drone:{i}", mocap=True)
        for geom in geoms:
            _add_geom(body, geom, i)
        for camera in cameras:
            mode = mujoco.mjtCamLight.mjCAMLIGHT_TRACK if camera.tracks else mujoco.mjtCamLight.mjCAMLIGHT_FIXED
            spec_camera = body.add_camera(name=f"{camera.name}:{i}", pos=camera.pos, fovy=camera.fovy, mode=mode)
            spec_camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
            spec_camera.alt.xyaxes = camera.xyaxes


def _add_geom(body: mujoco.MjsBody, geom: BodyGeom, i: int) -> None:
    spec_geom = body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{geom.kind.upper()}"), size=geom.size, mass=0)
    if geom.end is None:
        spec_geom.pos = geom.pos
    else:
        spec_geom.fromto = [*geom.pos, *geom.end]
    if geom.collides:
        spec_geom.name, spec_geom.group, spec_geom.condim, spec_geom.rgba = (
            f"{geom.name}:{i}",
            3,
            1,
            (0.5, 0.5, 0.5, 0.3),
        )
        _set_collision_bits(spec_geom, geom.name == "col_sphere")
    else:
        spec_geom.group, spec_geom.contype, spec_geom.conaffinity = 2, 0, 0
        spec_geom.material = _material_name(geom.material, i)


def _material_name(material: str, i: int) -> str:
    return f"{material}:{i}" if material in LED_MATERIALS and i < MAX_LED_DRONES else material


def use_boxes(spec: mujoco.MjSpec, n_drones: int, enable: bool) -> None:
    """Make the boxes of drones collide, or their spheres if ``enable`` is False, from the next compilation on."""
    for i in range(n_drones):
        for kind in ("col_sphere", "col_box"):
            geom = spec.geom(f"{kind}:{i}")
            _set_collision_bits(geom, (kind == "col_box") == enable)


def _set_collision_bits(geom: mujoco.MjsGeom, collides: bool) -> None:
    geom.contype, geom.conaffinity = (3, 1) if collides else (0, 0)


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        with warnings.catch_warnings():
            # Users attach bodies without a prefix, as the scene's documentation shows; nothing is saved here.
            warnings.filterwarnings("ignore", message="Attaching a spec with an empty prefix")
            return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ConfigError(f"expected a scene that compiles, got: {error}") from error


def put_model(mj_model: mujoco.MjModel, device: jax.Device) -> mjx.Model:
    """Put the model on a device, as arrays."""
    with _explain_mjx_errors():
        return mjx.put_model(mj_model, device=device)


def make_data(mj_model: mujoco.MjModel, n_worlds: int, device: jax.Device) -> mjx.Data:
    """Return the initial state of the scene in every world. (n_worlds, ...)"""
    with _explain_mjx_errors():
        world = mjx.put_data(mj_model, mujoco.MjData(mj_model), device=device)
    # Copied by NumPy: XLA would compile a copy of each of the 80 arrays.
    return jax.device_put(jax.tree.map(lambda x: np.broadcast_to(x, (n_worlds, *x.shape)), world), device)


@contextlib.contextmanager
def _explain_mjx_errors() -> Iterator[None]:
    try:
        yield
    except (NotImplementedError, ValueError) as error:
        raise ConfigError(
            f"expected a scene that MJX supports, which contacts need, got: {error}. Give geoms that need not touch "
            f"anything contype='0' conaffinity='0', or use contact_report."
        ) from error


def check_poses(mjx_data: mjx.Data, mj_model: mujoco.MjModel, n_worlds: int) -> mjx.Data:
    """Return MJX data into which a user has written poses, with the poses checked and converted to floats."""
    changes = {}
    for name, size in (("mocap_pos", 3), ("mocap_quat", 4)):
        value, shape = getattr(mjx_data, name), (n_worlds, mj_model.nmocap, size)
        require(
            np.shape(value) == shape,
            f"expected mjx_data.{name} of shape {shape} = (n_worlds, mocap bodies, {size}), got "
            f"{np.shape(value)}. To move some bodies use sim.mjx_data.{name}.at[:, ids].set(...).",
        )
        require(
            isinstance(value, jax.Array) or np.isfinite(value).all(),
            f"expected finite numbers in mjx_data.{name}, got NaN or infinity",
        )
        changes[name] = jnp.asarray(value, dtype=float)
    return mjx_data.replace(**changes)


def spec_mocap_ids(spec: mujoco.MjSpec) -> dict[str, int]:
    """Return the mocap ids that bodies will have once the spec is compiled, by name.

    MuJoCo numbers mocap bodies in the order of the children of the world body.
    """
    return {body.name: k for k, body in enumerate(b for b in spec.worldbody.bodies if b.mocap)}


def mocap_ids(mj_model: mujoco.MjModel, names: Iterable[str]) -> list[int]:
    ids = []
    for name in names:
        body = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_BODY, name)
        require(
            body >= 0 and mj_model.body_mocapid[body] >= 0,
            f"expected a mocap body {name!r}, got none. Edits of sim.spec must leave drones and objects with poses "
            f"in the scene. Use set_pose of its handle to move an object away, or add it with mocap=False.",
        )
        ids.append(int(mj_model.body_mocapid[body]))
    return ids
