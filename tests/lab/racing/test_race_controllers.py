"""Controllers of lsy_drone_racing: loading, the rules of their race, and the ranking."""

import importlib.util
import json
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crazysim import ConfigError, Sim
from crazysim.__main__ import main
from crazysim.lab.racing import competition, controllers, ranking

PILOT = """
import numpy as np
from lsy_drone_racing.control import Controller
from lsy_drone_racing.control.way import SPEED
from lsy_drone_racing.utils import draw_line, load_config
from crazyflow.sim.visualize import draw_points

POINTS = [[-1.5, 0.75, 0.4], [0.0, 0.5, 0.7], [0.5, 0.25, 0.7], [1.2, -0.2, 0.9], [1.35, 0.4, 1.2], [1.05, 0.75, 1.2],
          [0.5, 0.9, 1.2], [-0.6, -0.25, 0.8], [-1.0, -0.25, 0.7], [-1.25, -0.25, 0.75], [-1.25, -0.25, 1.4],
          [-0.7, -0.5, 1.4], [-0.2, -0.65, 1.25], [0.0, -0.75, 1.2], [0.6, -0.75, 1.2]]

class Pilot(Controller):
    def __init__(self, obs, info, config):
        super().__init__(obs, info, config)
        assert config.env.track.gates[0]["pos"] == config["env"]["track"]["gates"][0].pos
        assert obs["gates_quat"].shape == (4, 4) and obs["gates_visited"].dtype == bool and obs["target_gate"] == 0
        legs = np.linalg.norm(np.diff(POINTS, axis=0), axis=-1)
        self.time, self.dt, self.ends = 0.0, 1 / config.env.freq, np.append(0, np.cumsum(legs)) / SPEED

    def compute_control(self, obs, info=None):
        setpoint = [np.interp(self.time, self.ends, x) for x in np.transpose(POINTS)]
        return np.concatenate([setpoint, np.zeros(10)])

    def step_callback(self, action, obs, reward, terminated, truncated, info):
        from lsy_drone_racing.control import way  # modules beside the file are found during a run, too
        self.time += self.dt
        return False
"""
FALLER = """
import numpy as np
from lsy_drone_racing.control.controller import Controller

class Faller(Controller):
    def compute_control(self, obs, info=None):
        return np.array([0.0, 0.5, 0.0, 0.5])
"""


@pytest.fixture
def folder(tmp_path):
    files = {
        "pilot.py": PILOT, "faller.py": FALLER, "way.py": "SPEED = 0.7\n",
        "missing.py": "import acados_nowhere\nclass X(Controller): pass\n",
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.long("compiles the race for commands of both levels")
def test_a_folder_is_ranked_and_a_controller_that_raises_is_named(folder, capsys):
    path = folder / "ranking.json"
    modules = set(sys.modules)
    arguments = ["race", "--controller", str(folder), "--level", "0", "--runs", "2", "--ranking", str(path)]
    assert main(arguments) == 1
    rows = [line.split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("|")][2:]
    assert [row[2].strip() for row in rows] == ["pilot.py", "faller.py", "missing.py"]
    assert [row[3].strip() for row in rows] == ["100%", "0%", "0%"]
    assert "ModuleNotFoundError: No module named 'acados_nowhere'" in rows[2][6]
    scores = json.loads(path.read_text())["scores"]
    # The setpoint passes the last gate 0.6 m before its end, and the drone follows it by less than a second.
    length = float(np.linalg.norm(np.diff(_points(), axis=0), axis=-1).sum())
    assert all((length - 0.6) / 0.7 < time < length / 0.7 + 1 for time in scores[0]["times"])
    assert not any(name.startswith(("lsy_drone_racing", "crazyflow")) or name == "controller"
                   for name in set(sys.modules) - modules)  # fmt: skip


def _points():
    names = {}
    exec(PILOT[PILOT.index("POINTS") : PILOT.index("class")], names)
    return np.array(names["POINTS"])


def test_a_file_needs_one_controller(folder):
    with pytest.raises(ConfigError, match=r"got none.*lsy_drone_racing\.control\.Controller"), \
            controllers.loaded(folder / "way.py"):  # fmt: skip
        pass
    (folder / "empty").mkdir()
    with pytest.raises(ConfigError, match="controller files"):
        ranking.find_pilots([folder / "empty"])


@pytest.mark.skipif(importlib.util.find_spec("crazyflow") is not None, reason="Crazyflow itself is used")
def test_modules_that_crazysim_lacks_are_not_found_in_crazyflow(folder):
    with controllers.loaded(folder / "pilot.py"):
        assert importlib.import_module("crazyflow").Sim is Sim
        with pytest.raises(ModuleNotFoundError):
            importlib.import_module("crazyflow.envs")  # and crazysim.envs is not executed again


def test_a_configuration_has_attributes_and_keys(tmp_path):
    (tmp_path / "level.toml").write_text("[env]\nfreq = 50\n[[env.track.gates]]\npos = [1, 2, 3]\n")
    config = competition.load_config(tmp_path / "level.toml")
    assert config.env.track.gates[0]["pos"] == [1, 2, 3]
    assert config.env.get("disturbances") is None
    with pytest.raises(AttributeError, match="expected an entry of freq, track, got 'seed'"):
        config.env.seed  # noqa: B018


def test_controllers_are_ordered_by_time_if_they_finish_half_of_their_runs():
    scores = [
        ranking.Score("fast but rare", [5.0, None, None]),
        ranking.Score("slow", [9.0, 8.0]),
        ranking.Score("never", [None, None]),
        ranking.Score("half", [6.0, None]),
    ]
    order = [score.name for score in sorted(scores, key=lambda score: score.order)]
    assert order == ["half", "slow", "fast but rare", "never"]


def test_boxes_touch_where_mujoco_finds_no_distance():
    """Random poses of a drone near a gate and a pole; poses whose distance is below 1 mm are left out."""
    rng = np.random.default_rng(0)
    for boxes in (competition.GATE_BOXES, competition.POLE_BOXES):
        drone, *geoms = (
            f'<geom type="box" pos="{" ".join(map(str, pos))}" size="{" ".join(map(str, half))}"/>'
            for pos, half in [((0, 0, 0), competition.DRONE), *boxes]
        )
        model = mujoco.MjModel.from_xml_string(
            f'<mujoco><worldbody><body mocap="true">{drone}</body>{"".join(geoms)}</worldbody></mujoco>'
        )
        data = mujoco.MjData(model)
        n, drone_id = len(boxes), int(model.body_geomadr[1])
        pos, quat = rng.uniform(-0.5, 0.5, (300, 3)) * [0.3, 1, 1], rng.standard_normal((300, 4))
        quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
        distances = []
        for x, q in zip(pos, quat, strict=True):
            data.mocap_pos[0], data.mocap_quat[0] = x, np.roll(q, 1)
            mujoco.mj_kinematics(model, data)
            others = [k for k in range(n + 1) if k != drone_id]
            distances.append([mujoco.mj_geomDistance(model, data, drone_id, k, 1.0, None) for k in others])
        distance = np.min(distances, axis=-1)
        touch = jax.jit(jax.vmap(lambda x, q, b=boxes: competition.touches_boxes(
            x, q, np.zeros((1, 3), np.float32), np.float32([[0, 0, 0, 1]]), b)))  # fmt: skip
        touches = np.asarray(touch(np.float32(pos), np.float32(quat)))[:, 0]
        clear = np.abs(distance) > 1e-3
        assert 5 < touches.sum() < 280
        np.testing.assert_array_equal(touches[clear], distance[clear] < 0)


def test_commands_have_the_order_and_limits_of_lsy_drone_racing():
    env = controllers.competition_env(0, "state")
    action = np.arange(13, dtype=np.float32)
    command = np.asarray(env.actions.command(action))
    np.testing.assert_array_equal(command[:9], action[:9])
    np.testing.assert_allclose(Rotation.from_quat(command[9:13]).as_euler("xyz")[2], 9 - 2 * np.pi, rtol=1e-5)
    np.testing.assert_array_equal(command[13:], action[10:])
    attitude = controllers.competition_env(0, "attitude").actions
    limited = np.asarray(attitude.command(np.float32([2, -2, 0.5, 9])))
    np.testing.assert_allclose(limited, [np.pi / 2, -np.pi / 2, 0.5, 0.8], rtol=1e-6)


def test_the_floor_disables_a_drone_only_away_from_its_start():
    env = controllers.competition_env(2, "attitude")
    state = jax.jit(env.reset)(jax.random.key(0))
    pos = np.asarray(state.data.states.pos)
    assert 0.01 <= pos[0, 0, 2] <= 0.03
    for shift, expected in (((0, 0, -1), False), ((0.05, 0, -1), True), ((0, 0, 3), True), ((0, -1, 1), False)):
        states = state.data.states.replace(pos=jnp.asarray(pos + np.float32(shift)))
        assert bool(env.task.leaves_arena(state.data.replace(states=states))[0, 0]) == expected, shift
