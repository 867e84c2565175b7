"""The MuJoCo scene: building, syncing, querying and rendering it."""

from typing import TYPE_CHECKING

from crazysim.names import lazy_getattr

if TYPE_CHECKING:
    from crazysim.lab.scene.maps import map_spec
    from crazysim.lab.scene.splat_images import build_splat_fn

__all__ = ["build_splat_fn", "map_spec"]

__getattr__ = lazy_getattr(__name__)
