"""Light shows in the simulation: flying them, measuring separation and tracking, and showing them with lights."""

from crazysim.shows.flight import ShowFlight, fly
from crazysim.shows.report import collisions, report, sampled_approaches, summary, tracking_rms
from crazysim.shows.view import film, page, play

__all__ = [
    "ShowFlight",
    "collisions",
    "film",
    "fly",
    "page",
    "play",
    "report",
    "sampled_approaches",
    "summary",
    "tracking_rms",
]
