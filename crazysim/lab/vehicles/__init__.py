"""Ground vehicles: cars, bicycles and trailers, paths on the ground, and controllers that follow them."""
