"""Light shows in the simulation: flying them, measuring separation and tracking, and showing them with lights."""

from crazysim.lab.show_files import Cue, Lights, Show, load_show, save_show
from crazysim.lab.shows.flight import ShowFlight, fly_show
from crazysim.lab.shows.show_report import collisions, report, sampled_approaches, summary, tracking_rms
from crazysim.lab.shows.view import ShowLights, film, live_show, page

__all__ = [
    "Cue",
    "Lights",
    "Show",
    "ShowFlight",
    "ShowLights",
    "collisions",
    "film",
    "fly_show",
    "live_show",
    "load_show",
    "page",
    "report",
    "sampled_approaches",
    "save_show",
    "summary",
    "tracking_rms",
]
