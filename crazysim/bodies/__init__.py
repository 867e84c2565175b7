"""Free rigid bodies: balls and boxes that drones, objects and each other push."""

from crazysim.bodies.free_bodies import FreeBodies, FreeBodiesData

__all__ = ["FreeBodies", "FreeBodiesData"]
