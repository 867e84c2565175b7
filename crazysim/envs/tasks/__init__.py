"""The tasks: each a function that furnishes a simulation and returns what is to be done in it."""
