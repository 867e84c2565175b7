"""Free rigid bodies: balls and boxes that exchange impulses with each other and with drones; vehicles push them."""

from crazysim.plugins.bodies.free_bodies import FreeBodies, FreeBodiesData

__all__ = ["FreeBodies", "FreeBodiesData"]
