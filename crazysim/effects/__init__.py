"""Optional physics, each a stage with a record of its own: off until it is added, and then part of every step."""

from crazysim.effects import battery, downwash, ground_effect, latency, motors, wind

__all__ = ["battery", "downwash", "ground_effect", "latency", "motors", "wind"]
