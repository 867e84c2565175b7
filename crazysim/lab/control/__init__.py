"""Controllers of the laboratory: sampling model-predictive control, and the flatness of a drone with a load."""
