"""Rigid bodies that push each other: free balls and boxes, and drones that collide."""

from crazysim.bodies.drone_collisions import DroneCollisions, DroneCollisionsData
from crazysim.bodies.free_bodies import FreeBodies, FreeBodiesData

__all__ = ["DroneCollisions", "DroneCollisionsData", "FreeBodies", "FreeBodiesData"]
