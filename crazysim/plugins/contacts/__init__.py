"""Contacts: logs of them, the response of drones and loads, collisions, terrain, and the solver behind them."""
