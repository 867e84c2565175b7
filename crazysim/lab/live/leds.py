"""Colours of the drones' LEDs in a model."""

from __future__ import annotations

import mujoco
import numpy as np

from crazysim.drones.body import LED_MATERIALS


class Leds:
    """Materials of the drones' LEDs in a model."""

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        names = [model.material(k).name.partition(":") for k in range(model.nmat)]
        leds = [
            (k, int(drone)) for k, (kind, _, drone) in enumerate(names) if kind in LED_MATERIALS and drone.isdigit()
        ]
        self._materials, self._drones = np.array(leds, int).reshape(-1, 2).T
        self._unlit_colors = model.mat_rgba[self._materials].copy(), model.mat_emission[self._materials].copy()

    def set_colors(self, colors: np.ndarray) -> None:
        """Set the colours of the drones of one world, 0 to 1; zero for off. (n_drones, 3)"""
        drone_colors = colors[self._drones]
        brightest = drone_colors.max(-1, initial=0.0)
        is_lit, (rgba, emission) = brightest > 0, self._unlit_colors
        self._model.mat_rgba[self._materials] = np.where(is_lit[:, None], np.insert(drone_colors, 3, 1.0, axis=1), rgba)
        self._model.mat_emission[self._materials] = np.where(is_lit, brightest, emission)
