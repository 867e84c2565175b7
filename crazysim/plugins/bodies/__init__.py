"""Free rigid bodies: balls and boxes that push each other, and that drones and vehicles push."""

from crazysim.plugins.bodies.free_bodies import FreeBodies, FreeBodiesData

__all__ = ["FreeBodies", "FreeBodiesData"]
