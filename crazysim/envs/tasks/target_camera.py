"""Camera whose segmentation shows the target of each drone, such as its car, and nothing else."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation
from crazysim.plugins.sensors.camera import Camera
from crazysim.plugins.sensors.image_sensor import ImageFn, Images


class TargetCamera(Camera):
    """Camera whose segmentation is 1 where a pixel shows the drone's target, and 0 elsewhere.

    Drones are invisible.
    """

    _: dataclasses.KW_ONLY
    target: str = ""
    """Name of the targets without their numbers; object i of this name is the target of drone i."""
    outputs: Sequence[str] = ("segmentation",)
    drones: bool = False

    def describe(self, sim: Simulation) -> dict[str, dict[str, Any]]:
        formats = super().describe(sim)
        return {k: x | ({"unit": "1", "far": 0} if k == "segmentation" else {}) for k, x in formats.items()}

    def image_fn(self, sim: Simulation) -> ImageFn:
        take_all_bodies = super().image_fn(sim)
        first = self.segment_names(sim).index(f"{self.target}:0")
        index = (first + np.arange(sim.n_drones, dtype=np.int32))[:, None, None]

        def take_images(data: SimData) -> Images:
            images = take_all_bodies(data)
            is_target = images["segmentation"] == index
            return images | {"segmentation": is_target.astype(np.int32)}

        return take_images
