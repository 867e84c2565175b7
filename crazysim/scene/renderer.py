"""Images of a compiled scene: of one world by MuJoCo's renderer, of many worlds at once by MuJoCo Warp."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import mujoco
from jax import Array
from numpy.typing import ArrayLike, NDArray

from crazysim.core.settings import positive_integer
from crazysim.scene.batch_render import BatchRenderer
from crazysim.scene.overlays import Overlays
from crazysim.scene.render import ModelRenderer


class SceneRenderer:
    """Renderers of a scene, created on first use, and the overlays of the next image."""

    overlays: Overlays
    """Lines, points, labels and text of the next image."""
    viewer: ModelRenderer | None
    """Renderer of one world; None before the first image."""

    def __init__(self, device: jax.Device):
        self._device = device
        self.overlays = Overlays()
        self.viewer = None
        # Arguments and renderer of the last call of ``render_worlds``.
        self._batch: tuple[tuple[int | str, ...], BatchRenderer] | None = None

    def render(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        mode: str,
        camera: int | str,
        cam_config: Mapping[str, ArrayLike] | None,
        width: int,
        height: int,
    ) -> NDArray | tuple[NDArray, NDArray] | None:
        """Return or show an image of one world with the overlays, then clear them; see ``Sim.render``."""
        if self.viewer is None:
            self.viewer = ModelRenderer(model, data, self.overlays.limit + model.ngeom)
        image = self.viewer.render(mode, camera, cam_config, width, height, self.overlays)
        self.overlays.clear()
        return image

    def render_worlds(
        self,
        model: mujoco.MjModel,
        poses: tuple[Array, Array, Array],
        camera: int | str,
        width: int,
        height: int,
    ) -> Array:
        """Return images of a camera in several worlds; see ``Scene.render_worlds``. (n, height, width, 3), uint8"""
        key = (camera, width, height, len(poses[0]))
        if self._batch is None or self._batch[0] != key:  # keep only one: each holds the state of all its worlds
            self._batch = None
            self._batch = (key, BatchRenderer(model, camera, width, height, len(poses[0]), self._device))
        return self._batch[1](*poses)

    @property
    def max_visual_geom(self) -> int:
        """Largest number of overlays in one image."""
        return self.overlays.limit

    @max_visual_geom.setter
    def max_visual_geom(self, limit: int) -> None:
        self.overlays.limit = positive_integer("max_visual_geom", limit)
        self.close()

    def close(self) -> None:
        """Close the window and free the renderers; the next image makes new ones."""
        if self.viewer is not None:
            self.viewer.close()
            self.viewer = None
        self._batch = None
