"""Sensors, under the paths of Crazyflow."""
