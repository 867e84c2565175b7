"""Colour pictures of many worlds in one call, traced by MuJoCo Warp, which MJX brings and which needs warp-lang."""

from __future__ import annotations

import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim.errors import ConfigError
from crazysim.scene.render import camera_id, require_size

MISSING = "pictures of many worlds at once need MuJoCo Warp; pip install 'crazysim[warp]'"


def installed() -> bool:
    """Return whether MuJoCo Warp can run here."""
    return importlib.util.find_spec("warp") is not None


class BatchRenderer:
    """One camera of many worlds, with the lights, shadows and materials of the scene; marks are not drawn.

    Its memory is that of the pictures, and of the scene in so many worlds.
    """

    def __init__(self, model: mujoco.MjModel, camera: str | int, width: int, height: int, n_worlds: int, device: Any):
        """Prepare; MuJoCo Warp compiles its kernels when it first runs on a machine, which takes some seconds.

        Args:
            model: The scene.
            camera: Name or id of a camera.
            width: Of each picture, pixels.
            height: Of each picture, pixels.
            n_worlds: How many worlds are drawn at once.
            device: JAX's device whose memory the poses are in.

        Raises:
            ImportError: If warp-lang is not installed.
            UnknownNameError: If there is no such camera.
            ConfigError: If it is the free one, or the size cannot be.
        """
        if not installed():
            raise ImportError(MISSING)
        require_size(width, height)
        number = camera_id(model, camera)
        if number < 0:
            raise ConfigError("MuJoCo Warp draws what a camera of the scene sees, and not the free camera; name one")
        import mujoco.mjx.third_party.mujoco_warp as mjw
        import warp as wp

        wp.config.quiet = True
        self._wp, self._mjw, self._shape = wp, mjw, (n_worlds, height, width)
        self._device = f"cuda:{device.local_hardware_id}" if device.platform == "gpu" else "cpu"
        has_sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX in model.tex_type
        with wp.ScopedDevice(self._device):
            self._model, self._data = mjw.put_model(model), mjw.make_data(model, nworld=n_worlds)
            self._context = mjw.create_render_context(
                model,
                nworld=n_worlds,
                cam_res=(width, height),
                render_rgb=True,
                render_depth=False,
                render_seg=False,
                cam_active=[number],
                use_shadows=True,
                render_skybox=has_sky,
            )

    def __call__(self, mocap_pos: Array, mocap_quat: Array, qpos: Array) -> Array:
        """Return the pictures, on JAX's device. (n_worlds, height, width, 3), uint8

        Args:
            mocap_pos: Positions of all mocap bodies, m. (n_worlds, n_mocap, 3)
            mocap_quat: Their attitudes, wxyz. (n_worlds, n_mocap, 4)
            qpos: Positions of joints. (n_worlds, n_qpos)
        """
        wp, mjw, d = self._wp, self._mjw, self._data
        with wp.ScopedDevice(self._device):
            for into, x, kind in (
                (d.mocap_pos, mocap_pos, wp.vec3),
                (d.mocap_quat, mocap_quat, wp.quat),
                (d.qpos, qpos, wp.float32),
            ):
                if x.size:
                    x = jax.block_until_ready(jnp.asarray(x, jnp.float32))
                    wp.copy(into, wp.from_jax(x, dtype=kind))
            for stage in (mjw.kinematics, mjw.com_pos, mjw.camlight):
                stage(self._model, d)
            mjw.refit_bvh(self._model, d, self._context)
            mjw.render(self._model, d, self._context)
            wp.synchronize_device(self._device)
            return _unpacked(wp.to_jax(self._context.rgb_data), self._shape)


def _unpacked(words: Array, shape: tuple[int, int, int]) -> Array:
    """Return pixels of four bytes as three colours; a copy, for the words will be written to."""
    return _bytes(words).reshape(*shape, 3)


@jax.jit
def _bytes(words: Array) -> Array:
    return jnp.stack([words >> shift for shift in np.array([16, 8, 0], np.uint32)], axis=-1).astype(jnp.uint8)
