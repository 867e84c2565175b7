"""Wrapper that adds images of cameras and lidars to the observations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from crazysim.envs.env import Env
from crazysim.envs.state import EnvState
from crazysim.envs.wrappers.base import Wrapper
from crazysim.errors import ConfigError, expect, require, short_repr
from crazysim.plugins.sensors.image_sensor import OUTPUTS, ImageSensor, as_observation
from crazysim.plugins.sensors.sensor import rate_in


class CameraImages(Wrapper):
    """Add the images of a camera on each drone to the observations, flattened. (n_worlds, n_drones, k) each

    At the end of environment steps, at the rate of the camera, one kernel takes the images of all worlds. They become
    observations after the camera's latency; a new episode begins with a new image. They do not change rewards or the
    ends of episodes. Where an episode ends and a new episode begins in the same step, ``final_obs`` has the image of
    the step before. Reshape an observation to ``shapes[name]`` for a convolution. Worlds on a mesh of devices have no
    images.
    """

    def __init__(self, env: Env, camera: ImageSensor, names: Mapping[str, str] | None = None):
        super().__init__(env)
        self._sim: Any = env.sim
        sim = self._sim
        require(
            isinstance(camera, ImageSensor),
            f"expected a camera or lidar, got {camera!r}. Use for example Camera(16, 12).",
        )
        self.camera = camera
        expect(isinstance(names, (Mapping, type(None))), "names as a dict by output", names, "Use {'depth': 'view'}.")
        if unknown_outputs := set(names or {}) - set(camera.outputs):
            raise ConfigError(
                f"expected names of {', '.join(camera.outputs)}, the outputs of {camera.name!r}, got one of "
                f"{short_repr(min(unknown_outputs, key=str))}. Use outputs= of the camera."
            )
        self.names = {output: f"{camera.name}.{output}" for output in camera.outputs} | dict(names or {})
        """Names of the observations by output."""
        used_names = {name for wrapper in env.wrappers if isinstance(wrapper, CameraImages) for name in wrapper.shapes}
        if duplicates := used_names & self.shapes.keys():
            raise ConfigError(f"expected cameras of different names, got images {min(duplicates)!r} twice. Use name=.")
        self._period = sim.freq // rate_in(camera, env.base.freq)
        """Physics steps from one image to the next."""
        camera.check(sim, self._period)
        needs_record = camera.compares_images or np.any(camera.latency)
        self._is_immediate = self._period == env.n_substeps and not needs_record
        """Whether each environment step takes an image that is observed at its end."""
        self._capture = camera.capture_fn(sim)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes by the name of the observation: (height, width), and 3 for normals and colours, 2 for flow."""
        return {name: self.camera.image_size + OUTPUTS[output].shape for output, name in self.names.items()}

    def describe_images(self) -> dict[str, dict[str, Any]]:
        formats = self.camera.describe(self._sim)
        return {name: formats[output] for output, name in self.names.items()}

    def look(self, state: EnvState) -> EnvState:
        data, camera = state.data, self.camera
        if self._is_immediate:
            images, _ = self._capture(data, None)
        else:
            if self.name in state.memory:
                record = camera.update(self._capture, data, self.recall(state), self._period)
            else:
                record = camera.initial_record(self._capture, data, self._period)
            state, images = self.remember(state, record), record.images
        dtype, shape = data.states.pos.dtype, data.states.pos.shape[:2]
        flat = {self.names[k]: as_observation(x, dtype).reshape(*shape, -1) for k, x in images.items()}
        return state.replace(images=state.record.images | flat)
