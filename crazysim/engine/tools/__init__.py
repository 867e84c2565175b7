"""Tools for people who look into the engine: comparison, explanation, and CasADi expressions."""
