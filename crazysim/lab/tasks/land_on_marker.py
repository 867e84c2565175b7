"""Land on a marker on the ground that the drone observes with a camera."""

from __future__ import annotations

import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.envs.tasks.goals import motion_of
from crazysim.envs.tasks.land import PAD, Land
from crazysim.lab.tasks.target_camera import TargetCamera


class LandOnMarker(Land):
    """Land on a marker on the ground, 2 cm thick, that the drone observes with a camera.

    Rules and settings are the same as in ``land``, with a marker instead of the pad. Policies observe neither the
    position of the marker nor the horizontal position of the drone. ``make`` adds a camera that looks down. Its
    image ``segmentation`` is 1 where a pixel shows the marker.
    """

    name = "land_on_marker"
    target_name = "marker"
    height = 0.02

    def observe(self, data: SimData) -> dict[str, Array]:
        return motion_of(data)

    def privileged(self, data: SimData) -> dict[str, Array]:
        return self.relative_target_motion(data)

    def policy_camera(self) -> TargetCamera:
        return TargetCamera(16, 16, fovy=120.0, pos=(0.0, 0.0, 0.0), rpy=(0.0, np.pi / 2, 0.0), target=PAD)
