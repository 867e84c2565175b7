"""Tests that compare an accelerator with the CPU; `make test-gpu` runs them, and nothing else collects them."""

import os

# Every worker would take three quarters of the memory.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
