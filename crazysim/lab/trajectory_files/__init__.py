"""Files of trajectories: CSV, and the Crazyflie's trajectory memory."""
