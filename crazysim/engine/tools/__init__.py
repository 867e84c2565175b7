"""Tools to inspect the engine: comparison, explanation, and CasADi expressions."""
