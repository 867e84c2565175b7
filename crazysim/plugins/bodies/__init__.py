"""Free rigid bodies: balls and boxes that exchange impulses with each other and with drones; vehicles push them."""

from typing import TYPE_CHECKING

from crazysim.names import lazy_getattr

if TYPE_CHECKING:
    from crazysim.lab.bodies.free_bodies import FreeBodies, FreeBodiesData

__all__ = ["FreeBodies", "FreeBodiesData"]

__getattr__ = lazy_getattr(__name__)
