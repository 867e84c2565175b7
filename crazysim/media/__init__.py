"""Pictures of many worlds, films, and recorded flights."""

from crazysim.media.film import Film
from crazysim.media.flight import Flight
from crazysim.media.recording import Recorder, flight_of
from crazysim.media.trail import Trail
from crazysim.media.view import View, pictures_of

__all__ = ["Film", "Flight", "Recorder", "Trail", "View", "flight_of", "pictures_of"]
