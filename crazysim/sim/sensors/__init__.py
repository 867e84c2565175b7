"""Sensors, under Crazyflow's import paths."""
