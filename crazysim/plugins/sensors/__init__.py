"""Sensors: range finders and radars."""
