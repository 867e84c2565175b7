"""Images among the observations."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from crazysim.envs.env import Env
from crazysim.envs.state import EnvState, Obs
from crazysim.envs.wrappers.base import Wrapper
from crazysim.errors import ConfigError
from crazysim.scene.depth import Along, find_cameras
from crazysim.tables import POSITIVE, read_number


class DepthImages(Wrapper):
    """Add ``obs["depth"]``: a depth image of the camera of each drone, row by row, in m. (n_worlds, n_drones, k)

    An image is taken of all worlds at the end of every environment step, by the kernel of ``Sim.depth``; it does not
    change rewards or the ends of episodes. Where an episode ends and another one begins in the same step, ``final_obs``
    has the image of the step before. Reshape it for a convolution: ``depth.reshape(-1, height, width)``. Worlds on a
    mesh of devices have no images.
    """

    def __init__(
        self,
        env: Env,
        camera: str = "fpv_cam",
        width: int = 16,
        height: int = 12,
        max_depth: float = 10.0,
        drones: bool = True,
        along: Along = "axis",
        key: str = "depth",
    ):
        """Add images to the observations of an environment.

        Args:
            env: The environment.
            camera: Name of a camera that every drone has: ``fpv_cam`` or ``track_cam``.
            width: Pixels.
            height: Pixels.
            max_depth: Largest depth, m; also the value where nothing is nearer.
            drones: True for other drones to be visible.
            along: ``"axis"`` for depth along the axis of the camera, ``"ray"`` for the distance from it.
            key: Name of the observation.
        """
        super().__init__(env)
        self.max_depth = read_number("max_depth", max_depth, POSITIVE)
        self.key, self._n_pixels = key, width * height
        if env.sim.mesh is not None:
            raise ConfigError("expected worlds on one device for images, got a mesh of devices. Leave out mesh=.")
        self._depth = env.sim.scene.depth_fn(camera, width, height, drones, along=along)
        mounting = find_cameras(env.sim.scene.mj_model, camera, ())[0]
        self._format = {
            "height": height,
            "width": width,
            "unit": "m",
            "far": self.max_depth,
            "along": along,
            "camera": camera,
            "fovy": mounting.fovy,
            "pos": list(mounting.pos),
            "rot": [list(row) for row in mounting.rot],
            "follows_rotation": mounting.follows_rotation,
        }

    def describe_images(self) -> dict[str, dict[str, Any]]:
        return {self.key: self._format}

    def look(self, state: EnvState) -> Obs:
        distance = self._depth(state.data).distance
        n_worlds, n_drones = state.full_data.states.pos.shape[:2]
        if distance.shape[1] != n_drones:
            raise ConfigError(
                f"expected a camera of every drone, got {distance.shape[1]} cameras for {n_drones} drones. Use "
                f"camera='fpv_cam' or camera='track_cam'."
            )
        return {self.key: jnp.minimum(distance, self.max_depth).reshape(n_worlds, n_drones, self._n_pixels)}
