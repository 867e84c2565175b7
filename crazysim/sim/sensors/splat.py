"""Images of Gaussian splats, under Crazyflow's import path."""

from crazysim.sim.crazyflow_splats import (
    build_render_splat_fn,
    build_render_splat_rgbd_fn,
    camera_intrinsics,
    render_splat_rgb,
    render_splat_rgbd,
    viewmats,
)

__all__ = [
    "build_render_splat_fn",
    "build_render_splat_rgbd_fn",
    "camera_intrinsics",
    "render_splat_rgb",
    "render_splat_rgbd",
    "viewmats",
]
