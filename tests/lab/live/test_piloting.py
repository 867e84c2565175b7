"""Piloting: sticks (keys or a gamepad) move the setpoint in the drone's axes, and clicks set it."""

from types import SimpleNamespace

import glfw
import numpy as np
import pytest

from crazysim.errors import ConfigError
from crazysim.lab.live import Gamepad, Keyboard, Live, Pilot, keyboard_sticks
from crazysim.lab.live.gamepad import DEADBAND, remove_deadband
from crazysim.lab.live.piloting import command_setpoint, hold_setpoint, move_setpoint
from crazysim.sim import Sim


def test_sticks_move_in_the_axes_of_the_drone():
    """At a yaw of 90 degrees, forwards is y and left is -x; the third stick moves up, and the fourth turns."""
    start = [1.0, 2.0, 3.0, np.pi / 2]
    np.testing.assert_allclose(move_setpoint(start, [1, 0, 0, 0], 1.0, 2.0, 0.5), [1, 4, 3, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(move_setpoint(start, [0, 1, 0, 0], 1.0, 2.0, 0.5), [-1, 2, 3, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(move_setpoint(start, [0, 0, -1, 0], 0.5, 2.0, 0.5), [1, 2, 2, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(
        move_setpoint(start, [0, 0, 0, 1], 1.0, 2.0, 0.5), [1, 2, 3, np.pi / 2 + 0.5], atol=1e-12
    )
    assert abs(move_setpoint([0, 0, 0, 3.0], [0, 0, 0, 1], 1.0, 1.0, 1.0)[3] - (4.0 - 2 * np.pi)) < 1e-12


def test_a_setpoint_is_written_and_read():
    command = np.ones(16)
    hold_setpoint(command, [1.0, 2.0, 3.0, -2.5])
    np.testing.assert_allclose(command_setpoint(command), [1, 2, 3, -2.5])
    np.testing.assert_allclose(np.linalg.norm(command[9:13]), 1.0)
    assert not command[3:9].any()


@pytest.fixture(scope="module")
def sim():
    return Sim(n_drones=2, control="state")


@pytest.fixture
def live(sim):
    sim.reset()
    with Live(sim, speed="max") as live:
        live.command[..., 2] = 1.0
        live.run(2.0)
        yield live


def test_keys_fly_the_selected_drone(live):
    """2 s forwards at 0.5 m/s is a metre, and the other drone stays."""
    live.select(0, 1)
    live.add(Pilot(speed=0.5))
    start = np.array(live.sim.data.states.pos[0])
    live.keyboard.press("up")
    live.run(2.0)
    live.keyboard.release("up")
    live.run(1.5)
    displacement = np.asarray(live.sim.data.states.pos[0]) - start
    np.testing.assert_allclose(displacement[1], [1.0, 0, 0], atol=0.1)
    np.testing.assert_allclose(displacement[0], 0, atol=0.05)


def test_limits_and_the_lead_of_the_setpoint(live):
    """The setpoint stays above the lower limit, and does not run far ahead of the drone."""
    live.add(Pilot(speed=1.0, low=(-np.inf, -np.inf, 0.4), high=(np.inf, np.inf, 2.0)))
    live.keyboard.press("s")
    live.run(2.0)
    np.testing.assert_allclose(live.command[0, 0, 2], 0.4)
    live.keyboard.release("s")
    live.command[0, 0, 0] = 100.0
    live.keyboard.press("w")
    live.run(0.01)
    assert live.command[0, 0, 0] < 1.0


def test_a_click_sends_the_selected_drone(live):
    pilot = Pilot(high=(2.0, 2.0, 3.0))
    live.add(pilot)
    live.on_click = pilot.go_to
    live.post(lambda live: live.click(0, np.array([0.5, 5.0, 0.0])))
    live.run(3.0)
    np.testing.assert_allclose(live.command[0, 0, :3], [0.5, 2.0, 1.0], atol=1e-6)
    live.click(1, np.zeros(3))  # the selected drone is in another world
    np.testing.assert_allclose(live.command[0, 0, :3], [0.5, 2.0, 1.0], atol=1e-6)


def test_keys_are_released():
    keyboard = Keyboard()
    live = SimpleNamespace(keyboard=keyboard)
    for key in ("up", "a", "s"):
        keyboard.press(key)
    np.testing.assert_array_equal(keyboard_sticks(live), [1, 0, -1, 1])
    keyboard.press("down")
    np.testing.assert_array_equal(keyboard_sticks(live), [0, 0, -1, 1])
    keyboard.release_all()
    np.testing.assert_array_equal(keyboard_sticks(live), 0)
    keyboard.hold("w", 60.0)
    assert keyboard.is_held("w")
    keyboard.hold("w", -1.0)
    assert not keyboard.is_held("w")


class FakeGlfw:
    """GLFW with one gamepad, number 3, that a test moves, with the names and numbers of the real module."""

    def __init__(self):
        self.axes, self.is_connected = [0.0] * 6, True

    def __getattr__(self, name):
        if not name.startswith("GAMEPAD_"):
            raise AttributeError(name)
        return getattr(glfw, name)

    def joystick_is_gamepad(self, number):
        return self.is_connected and number == 3

    def get_gamepad_state(self, number):
        return SimpleNamespace(axes=self.axes) if self.is_connected else None


def test_a_gamepad_is_sticks():
    fake = FakeGlfw()
    gamepad = Gamepad(fake)
    fake.axes = [0.0, -1.0, 1.0, 0.05, -1.0, -1.0]  # left stick up, right stick to the right, a little drift
    np.testing.assert_allclose(gamepad(None), [0, -1, 1, 0], atol=1e-12)
    fake.axes = [-1.0, 0.0, 0.0, -0.5, -1.0, -1.0]
    np.testing.assert_allclose(gamepad(None), [(0.5 - DEADBAND) / (1 - DEADBAND), 0, 0, 1])
    fake.is_connected = False
    np.testing.assert_array_equal(gamepad(None), 0)


def test_the_dead_band_of_sticks():
    np.testing.assert_array_equal(remove_deadband(np.array([DEADBAND, -DEADBAND, np.nan, np.inf])), 0)
    np.testing.assert_allclose(remove_deadband(np.array([1.0, -1.0, 1.2])), [1, -1, 1])


def test_a_gamepad_flies(live):
    fake = FakeGlfw()
    live.add(Pilot([keyboard_sticks, Gamepad(fake)], speed=0.5))
    start = np.array(live.sim.data.states.pos[0, 0])
    fake.axes[glfw.GAMEPAD_AXIS_RIGHT_X] = 1.0
    live.run(2.0)
    fake.axes[glfw.GAMEPAD_AXIS_RIGHT_X] = 0.0
    live.run(1.5)
    np.testing.assert_allclose(np.asarray(live.sim.data.states.pos[0, 0]) - start, [0, -1, 0], atol=0.1)


def test_wrong_input(live):
    fake = FakeGlfw()
    fake.is_connected = False
    with pytest.raises(ConfigError, match="expected a gamepad, got none"):
        Gamepad(fake)
    with pytest.raises(ConfigError, match="positive speed"):
        Pilot(speed=0)
    with pytest.raises(ConfigError, match="low <= high"):
        Pilot(low=(0, 0, 2), high=(1, 1, 1))
    with Live(Sim(control="attitude"), speed="max") as other:
        other.add(Pilot())
        with pytest.raises(ConfigError, match="control='state', got 'attitude'"):
            other.run(0.1)
