"""Every example runs, prints its result, and passes its own checks."""

import functools
import importlib.util
from pathlib import Path

import pytest

from crazysim import train
from crazysim.train import runs

NEEDS_TORCH = {"rsl_rl_ppo", "sac"}
"""Examples that need Torch, which ``.ci/sb3`` runs."""
EXAMPLES = sorted(
    x for x in (Path(__file__).parents[2] / "docs" / "examples").glob("*.py") if x.stem not in NEEDS_TORCH
)


def check_fit(result):
    """Check that a fit, started 4 % off or more, finds every number to 0.2 % with a matching standard deviation."""
    assert len(result) == 7
    for name, (estimate, true, sigma) in result.items():
        assert abs(estimate - true) < min(4 * sigma, 2e-3 * true), name
        assert sigma < 1e-3 * true, name


def check_race(result):
    """Check that three laps were flown in every world, and nothing was hit."""
    n_passed, has_hit = result
    assert n_passed.shape == has_hit.shape == (16,)
    assert n_passed.min() >= 12
    assert not has_hit.any()


def check_replay(result):
    """Check that the twin was never touched, and that its replay gave the same flight."""
    distance, is_same = result
    assert distance > 0.05
    assert is_same


def check_landing(result):
    """Check that the drones followed their circle, and stand on the floor."""
    error, heights = result
    assert error < 0.25
    assert max(heights) < 0.01


def check_mixed_reality(result):
    """Check that the drones carry their load, the cars drive, and the real drone was passed at a distance."""
    heights, load_height, speeds, distance = result
    assert heights.min() > 1.8
    assert 0.9 < load_height < 1.3
    assert speeds.min() > 0.5
    assert 0.3 < distance < 2.0


def check_damping(errors):
    """Check that the pushes moved the loads, and that the loads came back to their goals."""
    assert errors[0] > 0.02
    assert errors[-1] < 0.02


def check_placement(result):
    """Check that every load was carried along its path, and set down within millimetres."""
    placed, distance, rms = result
    assert placed.all()
    assert distance.max() < 5e-3
    assert rms < 0.03


def check_separation(result):
    """Check that a drone escorted a car, and that nothing touched or left its path."""
    distances, touches, rms = result
    assert distances[0] > 0.2
    assert 0.2 < distances[1] < 0.8
    assert not touches.any()
    assert rms.shape == (5,)
    assert rms.max() < 0.15


def check_waypoints(result):
    """Check that every world passed all points, and hovers at the last one."""
    passed, distance = result
    assert passed.tolist() == [5] * 8
    assert distance.max() < 0.05


def check_student(result):
    """Check that the student hovers nearly as often as its teacher."""
    teacher, student = result
    assert teacher > 0.98
    assert student > 0.95


def check_success(metrics):
    """Check that a training of less than half of its iterations hovers."""
    assert metrics["success"] > 0.9


CHECKS = {
    "crazyswarm2": check_landing,
    "fit_flight": check_fit,
    "hooked_load": check_damping,
    "mixed_fleet": check_separation,
    "mixed_reality": check_mixed_reality,
    "one_file_ppo": check_success,
    "pick_and_place": check_placement,
    "race": check_race,
    "replayed_twin": check_replay,
    "student": check_student,
    "waypoints": check_waypoints,
}
"""Further checks of the values that ``main`` of an example returns."""


SETTINGS = {"student": {"iterations": 40}, "one_file_ppo": {"iterations": 40, "starts": 200}}
"""Arguments of ``main`` for quicker tests."""
CONSTANTS = {"one_file_ppo": {"WORLDS": 512}}
"""Numbers of a module for quicker tests."""
LONG_REASONS = {
    "one_file_ppo": "trains a policy",
    "student": "trains two policies",
    "waypoints": "trains a policy unless student has",
}


@pytest.fixture(scope="module", autouse=True)
def _shared_trainings(tmp_path_factory):
    """Let examples with equal trainings share them, without plots."""

    @functools.cache
    def run_once(task, settings):
        config, options = dict(settings[0]), dict(settings[1:])
        return runs.run(task, tmp_path_factory.mktemp("run") / "out", config=config, **options)

    def run(task, _, config, **options):
        return run_once(task, (tuple(config.items()), *sorted(options.items())))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "run", run)
        patch.setattr(runs, "plot_curve", lambda *_: None)
        patch.setattr(runs, "plot_episode", lambda *_: None)
        yield


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(x, marks=[pytest.mark.long(LONG_REASONS[x.stem])] if x.stem in LONG_REASONS else [])
        for x in EXAMPLES
    ],
    ids=lambda path: path.stem,
)
def test_example_runs(path, capsys):
    spec = importlib.util.spec_from_file_location(f"example_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    vars(module).update(CONSTANTS.get(path.stem, {}))
    result = module.main(**SETTINGS.get(path.stem, {}))
    if path.stem in CHECKS:
        CHECKS[path.stem](result)
    assert capsys.readouterr().out.strip(), "an example prints its result"
    assert module.__doc__
