"""Camera with a segmentation of the target of each drone, such as its car."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation
from crazysim.errors import ConfigError
from crazysim.plugins.sensors.camera import Camera
from crazysim.plugins.sensors.image_sensor import ImageFn, Images


class TargetCamera(Camera):
    """Camera with a segmentation that is 1 where a pixel shows the drone's target, and 0 elsewhere.

    By default, its images do not show drones.
    """

    _: dataclasses.KW_ONLY
    target: str = ""
    """Name of the targets without their numbers: ``{target}:{i}`` is the target of drone i."""
    outputs: Sequence[str] = ("segmentation",)
    drones: bool = False

    def describe(self, sim: Simulation) -> dict[str, dict[str, Any]]:
        formats = super().describe(sim)
        return {k: x | ({"unit": "1", "far": 0} if k == "segmentation" else {}) for k, x in formats.items()}

    def image_fn(self, sim: Simulation) -> ImageFn:
        take_segmented_images, names = super().image_fn(sim), self.segment_names(sim)
        targets = [f"{self.target}:{k}" for k in range(sim.n_drones)]
        if missing_targets := [name for name in targets if name not in names]:
            raise ConfigError(
                f"expected target of {self.name!r} as the name of objects, one per drone, got {self.target!r} without "
                f"an object {missing_targets[0]!r}. Use sim.scene.add(..., name={self.target!r}, count=sim.n_drones)."
            )
        target_indices = np.array([names.index(name) for name in targets], np.int32)[:, None, None]

        def take_images(data: SimData, before: SimData | None = None) -> Images:
            images = take_segmented_images(data, before)
            if "segmentation" not in images:
                return images
            is_target = images["segmentation"] == target_indices
            return images | {"segmentation": is_target.astype(np.int32)}

        return take_images
