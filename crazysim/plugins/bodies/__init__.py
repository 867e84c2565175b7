"""Free rigid bodies: balls and boxes that drones, vehicles and each other push."""

from crazysim.plugins.bodies.free_bodies import FreeBodies, FreeBodiesData

__all__ = ["FreeBodies", "FreeBodiesData"]
