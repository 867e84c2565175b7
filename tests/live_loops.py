"""Live loops in tests."""

import contextlib
import logging
from collections.abc import Iterator

import jax
import pytest

from crazysim.lab.live import Live


class CompilationLog:
    """A process of a live loop that makes JAX log compilations once the processes before it have compiled."""

    def compile(self, live: Live) -> None:
        jax.config.update("jax_log_compiles", True)

    def __call__(self, live: Live) -> None:
        pass


@contextlib.contextmanager
def no_compilation(live: Live, caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """Check that a loop runs and compiles nothing after its clock has started."""
    live.add(CompilationLog())
    caplog.clear()
    try:
        with caplog.at_level(logging.WARNING, "jax"):
            yield
            assert jax.config.jax_log_compiles
    finally:
        jax.config.update("jax_log_compiles", False)
    assert not [x.getMessage() for x in caplog.records if x.getMessage().startswith("Compiling")]
