"""Plugins of the laboratory: jets of rotors on the surfaces of loads, and radars."""
