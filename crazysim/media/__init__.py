"""Images of many worlds, films, and recorded flights."""

from crazysim.media.batch import render_worlds
from crazysim.media.film import Film
from crazysim.media.flight import Flight
from crazysim.media.flight_recorder import Recorder, flight_of
from crazysim.media.trail import Trail
from crazysim.media.view import View

__all__ = ["Film", "Flight", "Recorder", "Trail", "View", "flight_of", "render_worlds"]
