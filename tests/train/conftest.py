"""Shared by tests of trainings: environments with equal options, and their compiled functions."""

import functools

import pytest

from crazysim.envs import AutoReset, make
from crazysim.train import config, runs, training


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


@pytest.fixture(scope="module", autouse=True)
def _without_plots():
    """Leave out the plots of runs, which take longer to draw than small policies to train."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "plot_curve", lambda *_: None)
        patch.setattr(runs, "plot_episode", lambda *_: None)
        yield
