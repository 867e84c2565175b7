"""Law 9 for curves, plans, files and limits: each row has a call and the setting, or the remedy, that its error names.

``tests/laws/test_law_09_any_input.py`` has values of any other type.
"""

import re

import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.lab.planning.piece_table import PieceTable
from crazysim.trajectories import (
    Limits,
    Trajectory,
    check,
    circle,
    figure_eight,
    formation,
    helix,
    hover,
    line,
    lissajous,
    minimum_snap,
    of_bezier,
    save_csv,
    save_samples,
    spline,
)
from crazysim.trajectories.files import pack_compressed, pack_poly4d, save_memory

BENT = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1.5]])
TIMES, POINTS = np.arange(6.0), np.ones((6, 3))
NAN, TIGHT = np.full((3, 3), np.nan), Limits(speed=1.0, acceleration=2.0)
EIGHT, UP = figure_eight(), line([0, 0, 0], [0, 0, 1], 2.0)
PAIR = Trajectory.stack([EIGHT, UP])
FAR, HIGH = Trajectory.of_pieces([1.0], np.full((1, 4, 1), 33.0)), Trajectory.of_pieces([1.0], np.ones((1, 4, 9)))


def snap(*durations, points=BENT, **settings):
    return minimum_snap(points, list(durations) or None, **({} if durations else {"limits": TIGHT}) | settings)


def bezier(ends, *curves, **settings):
    return of_bezier(ends, [np.full((4, 3), x) if np.isscalar(x) else x for x in curves], **settings)


def of_zeros(durations, *shape):
    return Trajectory.of_pieces(durations, np.zeros(shape))


CURVES = [
    (lambda: figure_eight(period=1.0, speed=1.0), "period or speed"),
    (lambda: figure_eight(period=0.0), "period"),
    (lambda: circle(speed=-1.0), "speed"),
    (lambda: circle(speed=1e30), "period"),
    (lambda: circle(radius=0.0, speed=1.0), "size"),
    (lambda: circle(radius=1e300), "radius"),
    (lambda: helix(turns=0), "turns"),
    (lambda: helix(turns=1e7), "at most 20000 polynomials"),
    (lambda: lissajous(frequencies=(1, 2, 0.5)), "whole"),
    (lambda: lissajous(frequencies=(10**6, 1, 1)), "at most 20000 polynomials"),
    (lambda: lissajous(center=(1, 2)), "center"),
    (lambda: circle().moved((1, 2)), "offset"),
    (lambda: circle().moved((1e300, 0, 0)), "offset"),
    (lambda: circle().moved(yaw=np.inf), "yaw"),
    (lambda: line([0, 0, 1], [0, 0, 1], speed=1.0), "point"),
    (lambda: hover(duration=0), "duration"),
    (lambda: formation.grid(0), "n"),
    (lambda: formation.line(2, spacing=0.0), "spacing"),
    (lambda: formation.circle(2, center=(0.0, 0.0)), "center"),
    (lambda: formation.grid(2, yaw=np.nan), "yaw"),
    (lambda: formation.circle(3, spacing=1.0, radius=1.0), "spacing or radius"),
    (lambda: formation.matched(np.zeros((2, 3)), np.zeros((3, 3))), "starts as targets"),
    (lambda: formation.matched(np.zeros((2, 3)), np.full((2, 3), 1e300)), "a size up to"),
]
PIECES = [
    (lambda: of_zeros([1.0, 2.0], 3, 4, 8), "n_pieces"),
    (lambda: of_zeros([1.0], 1, 2, 8), "without yaw"),
    (lambda: of_zeros([1.0, 0.0], 2, 4, 8), "positive durations"),
    (lambda: of_zeros([1.0, np.inf], 2, 4, 8), "positive durations"),
    (lambda: of_zeros([1e9, 1e-9], 2, 4, 8), "piece 1"),
    (lambda: of_zeros([1.0], 1, 4, 0), "at least one"),
    (lambda: Trajectory.of_pieces([1.0], np.full((1, 4, 2), np.nan)), "finite"),
    (lambda: Trajectory.of_pieces([1e20], np.ones((1, 3, 3))), "finite in float32"),
    (lambda: Trajectory.stack([]), "at least one trajectory"),
    (lambda: Trajectory.stack([PAIR, UP]), "each of one vehicle"),
    (lambda: EIGHT.evaluate(np.linspace(0, 1, 5)), "jax.vmap"),
    (lambda: PAIR.evaluate(0.5), "evaluate_one"),
    (lambda: EIGHT.evaluate_one(0, 0.5), "evaluate(t)"),
    (lambda: EIGHT.derivatives(0.5, 5), "order from 0 to 4"),
    (lambda: PAIR.repeat(2), "unstacked()"),
    (lambda: PAIR.padded(9, 7), "unstacked()"),
    (lambda: PAIR.then(UP), "unstacked()"),
    (lambda: UP.then(PAIR), "unstacked()"),
    (lambda: UP.then("up"), "trajectory to follow"),
    (lambda: PieceTable.create([]), "at least one"),
    (lambda: PieceTable.create([EIGHT, UP], [0.0, 1.0, 2.0]), "each of 2 drones"),
    (lambda: PieceTable.create([UP], -100.0), "positive, finite duration"),
    (lambda: PieceTable.create([EIGHT, UP], 0.0, np.nan), "positive, finite duration"),
]
PLANS = [
    (lambda: snap(points=[[0, 0, 1]]), "at least two"),
    (lambda: snap(points=np.zeros((3, 2))), "waypoints"),
    (lambda: snap(points=[[0, 0, 1], [0, np.nan, 1]]), "finite waypoints"),
    (lambda: snap(points=[*BENT, BENT[-1]]), "number 2 and 3"),
    (lambda: minimum_snap(BENT), "durations or limits"),
    (lambda: snap(1.0), "2 positive, finite durations"),
    (lambda: snap(1.0, 0.0), "durations"),
    (lambda: snap(1.0, 1e300), "ascending times in float32"),
    (lambda: snap(1.0, 1.0, yaw=2.99e307), "yaw"),
    (lambda: snap(yaw=[0.0, 1.0]), "one for each of 3"),
    (lambda: snap(0.1, 0.1, limits=TIGHT), "Multiply"),
    (lambda: snap(limits=Limits(height=0.5)), "below the height"),
    (lambda: snap(limits=Limits(height=5.0)), "bound the speed"),
    (lambda: snap(points=[[0, 0, 1], [1, 0, -0.1]]), "Move it"),
    (lambda: snap(corridors=0.0), "corridors"),
    (lambda: snap(corridors=[0.1] * 3), "one or 2"),
    (lambda: snap(1.0, 1.0, velocities=[[0, 0, 9]] * 3, corridors=0.001), "corridors"),
    (lambda: snap(velocities=np.zeros((2, 3))), "velocities"),
    (lambda: snap(1.0, 1.0, velocities=np.full((3, 3), 1e300)), "velocities"),
    (lambda: snap(velocities=np.full((3, 3), 3.0)), "however slow"),
    (lambda: snap(1.0, points=BENT[:2], velocities=NAN[:2], accelerations=NAN[:2], jerks=NAN[:2]), "unique"),
    (lambda: Limits(speed=0.0), "speed of Limits"),
    (lambda: Limits(jerk=np.nan), "jerk of Limits"),
    (lambda: Limits(thrust=1.0), "cannot hover"),
    (lambda: Limits(min_thrust=1.0), "less than 1 weight"),
    (lambda: Limits(floor=np.nan), "floor of Limits"),
    (lambda: Limits(floor=1.0, height=1.0), "below the height"),
    (lambda: check([], Limits()), "at least one"),
    (lambda: check(UP, Limits(), names=["a", "b"]), "1 names"),
    (lambda: check(UP, Limits(), tolerance=0.0), "tolerance"),
]
FILES = [
    (lambda: spline(TIMES, POINTS, 4), "degree 3, 5 or 7"),
    (lambda: spline(TIMES[:-1], POINTS), "shapes"),
    (lambda: spline(TIMES[::-1], POINTS), "ascending"),
    (lambda: spline(TIMES * np.nan, POINTS), "ascending"),
    (lambda: spline(TIMES, np.where(np.eye(6, 3) > 0, np.inf, POINTS)), "at index [0, 0]"),
    (lambda: spline(TIMES, POINTS, yaw=[0.0, 1.0]), "one for each of 6"),
    (lambda: spline(TIMES, POINTS, yaw=4.99e305), "yaw"),
    (lambda: spline([-1e300, 0.0, 1.0], POINTS[:3]), "ascending times in float32"),
    (lambda: spline(TIMES[:1], POINTS[:1]), "at least 2"),
    (lambda: spline(TIMES[:3], POINTS[:3], 7, at_rest=False), "at least 4"),
    (lambda: bezier([1.0, 2.0], 1.0), "1 curves"),
    (lambda: bezier([]), "at least one"),
    (lambda: of_bezier([1.0], None), "control points as a list"),
    (lambda: bezier([1.0], np.ones((4, 2))), "control points"),
    (lambda: bezier([1.0, 2.0], 1.0, np.ones((4, 4))), "for all"),
    (lambda: bezier([1.0, 1.0], 1.0, 1.0), "ascending"),
    (lambda: bezier([0.0], 1.0), "positive"),
    (lambda: bezier([1.0], np.nan), "finite control points"),
    (lambda: pack_compressed(FAR), "16 bits"),
    (lambda: pack_compressed(HIGH), "degree 8"),
    (lambda: pack_poly4d(HIGH), "degree 8"),
    (lambda: pack_poly4d(PAIR), "one vehicle"),
    (lambda: save_csv(None, "x.csv"), "a trajectory"),
    (lambda: save_memory(FAR, "nowhere/a.bin"), "existing folder"),
    (lambda: save_samples("x.csv", [0.0], np.zeros((2, 3))), "shapes"),
    (lambda: save_samples("x.csv", 0.0, [0, 0, 0]), "times (n,)"),
    (lambda: save_samples("x.csv", [0, 1], BENT[:2], yaw=[[0], [0]]), "times (n,)"),
    (lambda: save_samples("x.csv", [0, 1], [[0, 0, 1], [0, 0, np.nan]]), "finite pos"),
]


@pytest.mark.parametrize(("call", "words"), [*CURVES, *PIECES, *PLANS, *FILES])
def test_a_wrong_setting_is_named(call, words):
    with pytest.raises(ConfigError, match=re.escape(words)):
        call()
