"""Shared by tests of trainings: environments with equal options, and their compiled functions."""

import functools

import pytest

from crazysim.envs import AutoReset, make
from crazysim.train import config, training


@pytest.fixture(scope="module")
def shared_environments():
    """Let runs with equal options share environments and their compiled functions."""
    shared = functools.cache(make)

    def make_shared(task, n_worlds=1, **options):
        frozen = {name: tuple(x) if isinstance(x, list) else x for name, x in options.items()}
        return shared(task, n_worlds, **frozen)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config, "make", make_shared)
        patch.setattr(training, "AutoReset", functools.cache(AutoReset))
        yield
