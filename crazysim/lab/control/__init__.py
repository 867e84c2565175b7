"""Controllers of the laboratory: LQR of loads and along trajectories, sampling model-predictive control."""
