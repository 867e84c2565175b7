"""Comparisons of the simulation with logs of real flights."""
