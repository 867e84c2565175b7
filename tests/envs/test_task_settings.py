"""Law 9: settings of tasks that do not fit are refused by name."""

import pytest

from crazysim import ConfigError, Sim
from crazysim.envs import make
from crazysim.envs.tracks import Track
from crazysim.lab.tasks.target_camera import TargetCamera

TWO_GATES = {"gates_pos": [(0, 0, 1), (0.2, 0, 1)], "gates_rpy": [(0, 0, 0)] * 2}

WRONG_SETTINGS = [
    ("avoid", {"n_poles": -1}, "n_poles"),
    ("avoid", {"n_poles": 0, "n_boxes": 0}, "n_poles"),
    ("avoid", {"n_seen": 0}, "n_seen"),
    ("avoid", {"n_boxes": 1.5}, "n_boxes"),
    ("chase", {"speed": 4.0}, "speed"),
    ("chase", {"speed": "x"}, "speed"),
    ("deliver", {"mass": 0.0}, "mass"),
    ("deliver", {"length": "x"}, "length"),
    ("deliver", {"speed": 5}, "speed"),
    ("follow_car", {"speed": 4.0}, "speed"),
    ("forest", {"density": 2.0}, "cells of 0.707 m"),
    ("forest", {"radii": (0.3, 0.1)}, "smallest before"),
    ("forest", {"speed": 0.0}, "speed"),
    ("forest", {"trees_seen": 13}, "trees_seen"),
    ("land", {"speed": -1}, "speed"),
    ("land", {"radius": 2.0}, "radius"),
    ("land_on_marker", {"radius": 0.7}, "radius"),
    ("land_on_marker", {"speed": -1.0}, "speed"),
    ("race", {"level": 4}, "level"),
    ("race", {"n_drones": 9, "level": 3}, "8 drones"),
    ("race", {"track": Track(gates_rpy=[(0, 0, 0)])}, "gates_rpy"),
    ("race", {"track": Track(start=(0.3, 0.25, 0.7))}, "gate 1"),
    ("race", {"track": Track(**TWO_GATES, start=(0.3, 0, 1))}, "gate 1 .*0.30 m"),
    ("race", {"track": Track(obstacles_pos=[(-1.5, 0.7, 1.5)])}, "obstacle 1"),
    ("race", {"track": Track(start=(-2.4, 0.75, 0.4))}, "within the limits"),
    ("race", {"track": Track(low=(3, 0, 0))}, "upper limit"),
    ("race", {"track": Track(low=(-1, -1, 0), high=(1, 1, 2)), "level": 3}, "room"),
    ("multi_race", {"practice": True, "n_drones": 5}, "as many drones as gates"),
    ("head_to_head", {"n_drones": 1}, "several drones"),
    ("head_to_head", {"ends_with": -1}, "ends_with"),
    ("race_by_camera", {"level": 4}, "level"),
    ("race_by_camera", {"gates_observed": 2}, "gates_observed"),
    ("swarm", {"n_drones": 1}, "two drones"),
    ("swarm", {"formation": [(0, 0, 1)]}, "formation"),
    ("swarm", {"formation": [(0, 0, 1), (1, 0, 1), (0, 1, 1), (0, 0, 1.5)]}, r"places \[0, 3\]"),
    ("swarm", {"formation": [(0, 0, 0.1), (1, 0, 1), (0, 1, 1), (2, 0, 1.5)]}, "0.2 m above the floor"),
    ("swarm", {"formation": "abc"}, "formation"),
    ("swarm", {"n_seen": 0}, "n_seen"),
    ("transport", {"opening": 0.5}, "opening .*0.55 m"),
    ("transport", {"length": 1.0}, "opening .*1.25 m"),
    ("transport", {"swing": -0.1}, "swing"),
    ("transport", {"mass": -1.0}, "mass"),
]


@pytest.mark.parametrize(("task", "options", "setting"), WRONG_SETTINGS)
def test_wrong_settings_are_refused_by_name(task, options, setting):
    with pytest.raises(ConfigError, match=setting):
        make(task, 1, **options)


def test_a_camera_without_targets_is_refused():
    with pytest.raises(ConfigError, match=r"target of 'camera' .*'pad:0'"):
        TargetCamera(target="pad").image_fn(Sim())
