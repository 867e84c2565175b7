"""Programs of JAX in NumPy, for the tests; see ``small_programs``."""
