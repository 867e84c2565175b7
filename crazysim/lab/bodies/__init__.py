"""Rigid bodies that collide: drones with drones, and free balls and boxes."""
