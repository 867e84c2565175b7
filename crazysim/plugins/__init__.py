"""Plugins: everything that sim.add takes, by kind, and the registry that adds it."""
