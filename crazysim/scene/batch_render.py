"""Images of many worlds in one call, ray-traced by MuJoCo Warp, which comes with MJX and needs warp-lang."""

from __future__ import annotations

import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim.core.settings import check_image_size
from crazysim.errors import not_installed, require
from crazysim.scene.render import camera_id

INSTALL_MESSAGE = not_installed("images of many worlds at once need", "warp-lang", "warp")


def is_installed() -> bool:
    return importlib.util.find_spec("warp") is not None


class BatchRenderer:
    """Renderer of one camera in many worlds, with lights, shadows and materials, without overlays.

    It allocates memory for the images and for the state of the scene in every world.
    """

    def __init__(
        self, model: mujoco.MjModel, camera: str | int, width: int, height: int, n_worlds: int, device: jax.Device
    ):
        require(is_installed(), INSTALL_MESSAGE, ImportError)
        check_image_size(width, height)
        camera_index = camera_id(model, camera)
        require(
            camera_index >= 0, "expected a camera of the scene, got the free camera, which MuJoCo Warp cannot render"
        )
        import warp as wp

        wp.config.log_level = wp.LOG_WARNING  # must be set before MuJoCo Warp starts Warp
        import mujoco.mjx.third_party.mujoco_warp as mjw

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
                cam_active=[camera_index],
                use_shadows=True,
                render_skybox=has_sky,
            )

    def __call__(self, mocap_pos: Array, mocap_quat: Array, qpos: Array) -> Array:
        wp, mjw, d = self._wp, self._mjw, self._data
        with wp.ScopedDevice(self._device):
            for target, x, dtype in (
                (d.mocap_pos, mocap_pos, wp.vec3),
                (d.mocap_quat, mocap_quat, wp.quat),
                (d.qpos, qpos, wp.float32),
            ):
                if x.size:
                    x = jax.block_until_ready(jnp.asarray(x, jnp.float32))
                    wp.copy(target, wp.from_jax(x, dtype=dtype))
            for update in (mjw.kinematics, mjw.com_pos, mjw.camlight):
                update(self._model, d)
            mjw.refit_bvh(self._model, d, self._context)
            mjw.render(self._model, d, self._context)
            wp.synchronize_device(self._device)
            return _unpack_colors(wp.to_jax(self._context.rgb_data), self._shape)


def _unpack_colors(pixels: Array, shape: tuple[int, int, int]) -> Array:
    return _color_bytes(pixels).reshape(*shape, 3)


@jax.jit
def _color_bytes(pixels: Array) -> Array:
    return jnp.stack([pixels >> shift for shift in np.array([16, 8, 0], np.uint32)], axis=-1).astype(jnp.uint8)
