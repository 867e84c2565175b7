"""Light shows in the simulation: flying them, measuring separation and tracking, and showing them with lights."""

from crazysim.shows.flight import ShowFlight, fly
from crazysim.shows.report import closest_approaches, collisions, report, summary, tracking_rms
from crazysim.shows.view import film, page, play

__all__ = [
    "ShowFlight",
    "closest_approaches",
    "collisions",
    "film",
    "fly",
    "page",
    "play",
    "report",
    "summary",
    "tracking_rms",
]
