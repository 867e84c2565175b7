"""Every example runs, prints its result, and passes its own checks."""

import importlib.util
from pathlib import Path

import pytest

ELSEWHERE = {"sac"}
"""Examples that need Torch, which ``.ci/sb3`` runs."""
EXAMPLES = sorted(x for x in (Path(__file__).parents[2] / "docs" / "examples").glob("*.py") if x.stem not in ELSEWHERE)


def fits(result):
    """Check that a fit, started 4 % off or more, finds every number to 0.2 % with a matching standard deviation."""
    assert len(result) == 7
    for name, (found, true, sigma) in result.items():
        assert abs(found - true) < min(4 * sigma, 2e-3 * true), name
        assert sigma < 1e-3 * true, name


def races(result):
    """Check that three laps were flown in every world, and nothing was hit."""
    passed, hit = result
    assert passed.shape == hit.shape == (16,)
    assert passed.min() >= 12
    assert not hit.any()


def repeats(result):
    """Check that the twin was never touched, and that its replay gave the same flight."""
    closest, same = result
    assert closest > 0.05
    assert same


def lands(result):
    """Check that the drones followed their circle, and stand on the floor."""
    error, heights = result
    assert error < 0.25
    assert max(heights) < 0.01


def mixes(result):
    """Check that the drones carry their load, the cars drive, and the real drone was passed at a distance."""
    heights, hanging, speeds, closest = result
    assert heights.min() > 1.8
    assert 0.9 < hanging < 1.3
    assert speeds.min() > 0.5
    assert 0.3 < closest < 2.0


def calms(errors):
    """Check that the pushes moved the loads, and that the loads came back to their goals."""
    assert errors[0] > 0.02
    assert errors[-1] < 0.02


def places(result):
    """Check that every load was carried along its path, and set down within millimetres."""
    placed, distance, rms = result
    assert placed.all()
    assert distance.max() < 5e-3
    assert rms < 0.03


def keeps_apart(result):
    """Check that a drone escorted a car, and that nothing touched or left its path."""
    closest, touches, rms = result
    assert closest[0] > 0.2
    assert 0.2 < closest[1] < 0.8
    assert not touches.any()
    assert rms.shape == (5,)
    assert rms.max() < 0.15


def visits(result):
    """Check that every world passed all points, and hovers at the last one."""
    passed, distance = result
    assert passed.tolist() == [5] * 8
    assert distance.max() < 0.05


def learns(result):
    """Check that the student hovers nearly as often as its teacher."""
    teacher, student = result
    assert teacher > 0.98
    assert student > 0.95


CHECKS = {
    "crazyswarm2": lands,
    "fit_flight": fits,
    "hooked_load": calms,
    "mixed_fleet": keeps_apart,
    "mixed_reality": mixes,
    "pick_and_place": places,
    "race": races,
    "replayed_twin": repeats,
    "student": learns,
    "waypoints": visits,
}
"""Further checks of the values that ``main`` of an example returns."""


LONG = {"student": "trains two policies", "waypoints": "trains a policy"}


@pytest.mark.parametrize(
    "path",
    [pytest.param(x, marks=[pytest.mark.long(LONG[x.stem])] if x.stem in LONG else []) for x in EXAMPLES],
    ids=lambda path: path.stem,
)
def test_example_runs(path, capsys):
    spec = importlib.util.spec_from_file_location(f"example_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    result = module.main()
    if path.stem in CHECKS:
        CHECKS[path.stem](result)
    assert capsys.readouterr().out.strip(), "an example prints its result"
    assert module.__doc__
