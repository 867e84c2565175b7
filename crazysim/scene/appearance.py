"""Materials, lights, textures and sky of a compiled scene, as tables for the colours of rays."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from crazysim.core.data import SimData
from crazysim.core.random import episode_keys, uniform
from crazysim.core.settings import check_settings, setting
from crazysim.scene.collision import texture_of
from crazysim.scene.first_hit import Target
from crazysim.scene.hit_color import MAX_LEVELS, Light, Paint, View
from crazysim.scene.visual_geoms import DEFAULT_COLOR

DEFAULT_SHINE = 0.0, 0.5, 0.5
"""MuJoCo's emission, specular and shininess of geoms without a material (``mjv_initGeom``)."""
SHININESS_SCALE = 128.0
"""OpenGL's exponent of highlights for a shininess of 1."""
AMBIENT_WITHOUT_LIGHTS = 0.3
"""MuJoCo's ambient light in scenes without lights."""
SKY_RADIUS = 0.7
"""Distance at which MuJoCo draws the sky, divided by ``zfar``."""
TEXTURED_KINDS = ("plane", "rectangle", "box", "hfield", "mesh")
"""Kinds of geoms on which textures are drawn; round ones have the mean colour."""


@dataclasses.dataclass(frozen=True)
class RandomColors:
    """Colours and light that differ in every world and episode, for policies that fly by colour."""

    surfaces: float = setting(default=0.3, low=0.0, high=1.0)
    """Largest change of red, green and blue of the floor and of each object and drone, a share of their values."""
    lights: float = setting(default=0.3, low=0.0, high=1.0)
    """Largest change of the brightness of each light, a share of it."""
    tilt: float = setting(default=20.0, low=0.0, high=80.0)
    """Largest angle by which the directions of lights change, degrees."""
    textures: bool = False
    """Whether each body draws one of all two-dimensional textures of the scene for its textured surfaces."""

    def __post_init__(self) -> None:
        check_settings(self)

    def apply(
        self, paint: Paint, data: SimData, body_index: Sequence[int], n_lights: int, textures: np.ndarray
    ) -> Paint:
        """Return tables with rows for each world; see ``color_at_hit``.

        Args:
            paint: Tables of the scene.
            data: Data of all worlds, for their random keys.
            body_index: ``Target.body_index`` of each geom.
            n_lights: Number of lights.
            textures: Textures to choose from, as in ``Paint.textures``. (n_textures, 2)
        """
        n_bodies, dtype = max(body_index, default=0) + 1, paint.looks.dtype
        draw = jax.vmap(lambda key: uniform(key, (n_bodies * 3 + n_lights * 4,), dtype))
        numbers = 2 * draw(episode_keys(data, "colors")) - 1
        by_body = numbers[:, : n_bodies * 3].reshape(len(numbers), n_bodies, 3)[:, np.asarray(body_index, int)]
        by_light = numbers[:, n_bodies * 3 :].reshape(len(numbers), n_lights, 4)
        looks = jnp.broadcast_to(paint.looks[: len(body_index)], (*by_body.shape[:2], paint.looks.shape[1]))
        looks = looks.at[..., :3].multiply(1 + self.surfaces * by_body)
        rows = jnp.broadcast_to(paint.textures[: len(body_index)], (*by_body.shape[:2], 2))
        if self.textures and len(textures):
            pick = jax.vmap(lambda key: jax.random.randint(key, (n_bodies,), 0, len(textures)))
            choice = jnp.asarray(textures)[pick(episode_keys(data, "textures"))[:, np.asarray(body_index, int)]]
            rows = jnp.where(rows[..., 1:] > 0, choice, rows)
        # A direction tilts by a part of the unit ball that is perpendicular to it.
        pos, direction, colors, rest = jnp.split(paint.lights[:n_lights], (3, 6, 15), axis=-1)
        shift = by_light[..., :3] / jnp.maximum(jnp.linalg.norm(by_light[..., :3], axis=-1, keepdims=True), 1)
        shift = shift - jnp.sum(shift * direction, axis=-1, keepdims=True) * direction
        direction = direction + np.tan(np.radians(self.tilt)) * shift
        direction = direction / jnp.maximum(jnp.linalg.norm(direction, axis=-1, keepdims=True), 1e-6)
        colors = colors * (1 + self.lights * by_light[..., 3:])
        pos, rest = (jnp.broadcast_to(x, (*by_light.shape[:2], x.shape[-1])) for x in (pos, rest))
        lights = jnp.concatenate([pos, direction, colors, rest], axis=-1)
        changed = {"looks": looks, "lights": lights, "textures": rows}
        return paint._replace(**{name: x.reshape(-1, x.shape[-1]) for name, x in changed.items() if x.size})


class Appearance:
    """Materials, lights, textures and sky of a compiled scene."""

    def __init__(
        self,
        model: mujoco.MjModel,
        shadows: bool,
        random_colors: RandomColors | None = None,
        has_derivatives: bool = False,
    ):
        self._model, self._random_colors = model, random_colors
        self.has_derivatives = has_derivatives
        """Whether colours are numbers from 0 to 1 with derivatives, instead of uint8."""
        data = mujoco.MjData(model)
        for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):
            update(model, data)
        # Headlight, then lights of the kinds that MuJoCo's renderer knows.
        head, spot = model.vis.headlight, mujoco.mjtLightType.mjLIGHT_SPOT
        kinds = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL), int(spot)
        lights = [k for k in range(model.nlight) if model.light_active[k] and int(model.light_type[k]) in kinds]
        lights_of_scene = [
            Light(False, int(model.light_type[k]) == int(spot), shadows and bool(model.light_castshadow[k]))
            for k in lights
        ]
        rows = [
            [*data.light_xpos[k], *data.light_xdir[k], *model.light_ambient[k], *model.light_diffuse[k],
             *model.light_specular[k], *model.light_attenuation[k], model.light_exponent[k],
             np.cos(np.deg2rad(model.light_cutoff[k]))] for k in lights
        ]  # fmt: skip
        if head.active:
            lights_of_scene.insert(0, Light(True, False))
            rows.insert(0, [*np.zeros(6), *head.ambient, *head.diffuse, *head.specular, 1, 0, 0, 0, -1])
        self._light_rows = np.array(rows).reshape(-1, 20)
        # Sky, and haze before it where a plane is infinite.
        skies = np.flatnonzero(model.tex_type == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX))
        has_sky = len(skies) > 0
        self._sky = _read_texture(model, skies[0]) if has_sky else np.zeros((1, 1, 3))
        is_infinite = (model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)) & ~model.geom_size[:, :2].any(axis=1)
        plane = int(np.argmax(is_infinite))
        has_haze = bool(has_sky and is_infinite.any() and data.geom_xmat[plane, 8] > 1 - 1e-6)
        self._plane_height = float(data.geom_xpos[plane, 2]) if has_haze else 0.0
        self.flags = tuple(lights_of_scene), has_sky, has_haze, random_colors is not None
        """First arguments of ``color_at_hit``."""

    def paint(self, data: SimData, targets: Sequence[Target], pixel_angle: float) -> Paint:
        """Return the tables of the scene, or of the scene in each world.

        Args:
            data: Data of all worlds.
            targets: ``Targets.all_geoms``.
            pixel_angle: Angle between neighbouring pixels in the middle of the image, rad.
        """
        model, size = self._model, self._sky.shape[1]
        sides = self._sky.reshape(-1, size, size, 3)
        images = [sides if len(sides) == 6 else np.repeat(sides, 6, axis=0)]
        looks, textures, levels = np.zeros((len(targets), 9)), np.zeros((len(targets), 2), np.int32), [[0, 1, 1]]
        rows_of_texture: dict[int, tuple[int, int]] = {}
        flat = int(mujoco.mjtTexture.mjTEXTURE_2D)

        def load(texture: int) -> tuple[int, int]:
            if texture not in rows_of_texture:
                reduced = _reduced_images(_read_texture(model, texture))
                rows_of_texture[texture] = len(levels), len(reduced)
                for image in reduced:
                    levels.append([sum(x.size for x in images) // 3, image.shape[1], image.shape[0]])
                    images.append(image)
            return rows_of_texture[texture]

        if self._random_colors is not None and self._random_colors.textures:
            for texture in np.flatnonzero(model.tex_type == flat):
                load(int(texture))
        for target, look, rows in zip(targets, looks, textures, strict=True):
            geom, shape = target.geom.index, target.geom.shape
            material, texture = int(model.geom_matid[geom]), texture_of(model, geom)
            rgba, shine, repeat, half = model.geom_rgba[geom], DEFAULT_SHINE, np.ones(2), model.geom_size[geom, :2]
            if material >= 0:
                rgba = model.mat_rgba[material] if np.array_equal(rgba, DEFAULT_COLOR) else rgba
                shine = model.mat_emission[material], model.mat_specular[material], model.mat_shininess[material]
                repeat = np.where(model.mat_texrepeat[material] > 0, model.mat_texrepeat[material], 1.0)
                repeat = repeat * np.where(model.mat_texuniform[material] & (half > 0), half, 1.0)
            has_coordinates = shape.triangles is not None
            if shape.kind in ("hfield", "mesh") and not has_coordinates:
                repeat = repeat / half
            is_centred = shape.kind in ("hfield", "mesh") or (shape.kind in ("plane", "rectangle") and not half.all())
            shift = 0.5 * (is_centred and not has_coordinates)
            look[:] = *rgba[:3], *shine[:2], SHININESS_SCALE * shine[2], *repeat, shift
            is_flat = texture >= 0 and int(model.tex_type[texture]) == flat
            if texture >= 0 and not (is_flat and shape.kind in TEXTURED_KINDS):
                look[:3] *= _read_texture(model, texture).mean(axis=(0, 1))
            elif texture >= 0:
                rows[:] = load(texture)
        texels = np.concatenate([np.rint(255 * x).reshape(-1, 3) for x in images]).astype(np.int32)
        tables = (
            looks,
            textures,
            levels,
            texels @ [[1], [1 << 8], [1 << 16]],
            self._light_rows,
            [self._view(pixel_angle)],
        )
        # Empty tables get a row of zeros, since an array without rows has no memory.
        arrays = [x if len(x) else np.zeros((1, x.shape[1]), x.dtype) for x in map(np.asarray, tables)]
        dtype = data.states.pos.dtype
        paint = Paint(*(jnp.asarray(x, np.int32 if x.dtype.kind == "i" else dtype) for x in arrays))
        if self._random_colors is None:
            return paint
        bodies, choices = [target.body_index for target in targets], np.array([*rows_of_texture.values()], np.int32)
        return self._random_colors.apply(paint, data, bodies, len(self.flags[0]), choices)

    def _view(self, pixel_angle: float) -> View:
        vis, far = self._model.vis, self._model.vis.map.zfar * self._model.stat.extent
        share = vis.map.haze
        slope = np.arctan2(1, share)
        # Not zero, by which the derivative of the haze is divided.
        densest = max(np.sqrt(0.5) * share * np.sin(slope) / np.sin(0.75 * np.pi - slope), 1e-6)
        ambient = 0.0 if self.flags[0] else AMBIENT_WITHOUT_LIGHTS
        radius = far * SKY_RADIUS if self.flags[1] else far
        numbers = (
            pixel_angle,
            radius,
            ambient,
            self._sky.shape[1],
            self._plane_height,
            *vis.rgba.haze[:3],
            share,
            densest,
        )
        return View._make(numbers)


def _read_texture(model: mujoco.MjModel, texture: int) -> np.ndarray:
    shape = int(model.tex_height[texture]), int(model.tex_width[texture]), int(model.tex_nchannel[texture])
    first = int(model.tex_adr[texture])
    texels = model.tex_data[first : first + np.prod(shape)].reshape(shape)[..., :3] / 255
    if int(model.tex_colorspace[texture]) == int(mujoco.mjtColorSpace.mjCOLORSPACE_SRGB):
        return np.where(texels <= 0.04045, texels / 12.92, ((texels + 0.055) / 1.055) ** 2.4)
    return texels


def _reduced_images(image: np.ndarray) -> list[np.ndarray]:
    images = [image]
    while max(image.shape[:2]) > 1 and len(images) < MAX_LEVELS:
        height, width = (max(n // 2, 1) for n in image.shape[:2])
        rows, columns = image.shape[0] // height, image.shape[1] // width
        blocks = image[: rows * height, : columns * width].reshape(height, rows, width, columns, 3)
        image = blocks.mean(axis=(1, 3))
        images.append(image)
    return images
