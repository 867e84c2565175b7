"""Contact logs, the response of drones and loads to contact, collisions, terrain, and the solver."""
