"""Tools to inspect the engine: explanation, and CasADi expressions."""
