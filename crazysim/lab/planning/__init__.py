"""Planning of trajectories: through waypoints and corridors, within limits, and checks of what is planned."""
