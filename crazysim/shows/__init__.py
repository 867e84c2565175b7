"""Light shows in the simulation: flying them, measuring separation and tracking, and showing them with lights."""

from crazysim.shows.flight import ShowFlight, fly
from crazysim.shows.live_show import ShowLights, live_show
from crazysim.shows.show_report import collisions, report, sampled_approaches, summary, tracking_rms
from crazysim.shows.view import film, page, play

__all__ = [
    "ShowFlight",
    "ShowLights",
    "collisions",
    "film",
    "fly",
    "live_show",
    "page",
    "play",
    "report",
    "sampled_approaches",
    "summary",
    "tracking_rms",
]
