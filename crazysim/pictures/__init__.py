"""Pictures of many worlds, films, and recorded flights."""

from crazysim.pictures.film import Film
from crazysim.pictures.flight import Flight
from crazysim.pictures.recording import Recorder, flight_of
from crazysim.pictures.trail import Trail
from crazysim.pictures.view import View, pictures_of

__all__ = ["Film", "Flight", "Recorder", "Trail", "View", "flight_of", "pictures_of"]
