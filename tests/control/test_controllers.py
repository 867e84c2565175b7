"""Controllers in a simulation: the protocol, the firmware's controllers in flight, and several with a switch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_states

from crazysim import ConfigError, Latency, Sim, load_airframe
from crazysim.control import PID, AirframeParams, Control, Controller, Setpoint
from crazysim.control.mellinger import MellingerParams
from crazysim.engine.pytree import PyTree, leaf

WORLDS, DRONES = 3, 2


class SpringMemory(PyTree):
    n_ticks: jax.Array = leaf("drone", 1, (1,))
    feedforward: jax.Array = leaf("drone", 1, (8,))


class SpringParams(AirframeParams):
    mass: jax.Array = leaf("parameter", 1, (1,), airframe="rigid_body.mass")


class Spring(Controller, params=SpringParams, memory=SpringMemory):
    name = "spring"
    levels = (Control.state,)
    output = Control.force_torque
    freq: int = 100

    def update(self, data, command, memory, params):
        s = data.states
        force = params.mass * (9.81 + 4 * (command.pos - s.pos) - 4 * s.vel)[2:]
        memory = SpringMemory(memory.n_ticks + 1, command.feedforward())
        return jnp.concatenate([force, -1e-3 * s.ang_vel]), memory


def make_setpoint(sim, offset=(0.0, 0.0, 1.0), yaw=0.0):
    cmd = np.zeros((sim.n_worlds, sim.n_drones, 16), np.float32)
    cmd[..., :3] = np.asarray(sim.default_data.states.pos) + offset
    cmd[..., 9:13] = [0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]
    return cmd


def take_off(controller, n_steps, engine="auto", offset=(0.0, 0.0, 1.0), n_worlds=WORLDS, **settings):
    """Return a simulation after takeoff; as on real drones, PID can only take off straight up."""
    sim = Sim(n_worlds, DRONES, drone="cf2x_L250", control="state", controller=controller, engine=engine, **settings)
    sim.state_control(make_setpoint(sim, offset))
    sim.step(n_steps)
    return sim


def controller_memory(sim):
    return sim.data.controls.controller.memory


CRAZYFLOW_MEMORY = {
    "state": {"state": ("pos_err_i",), "attitude": ("ang_vel_des", "r_int_error", "prev_ang_vel")},
    "attitude": {"attitude": ("ang_vel_des", "r_int_error", "prev_ang_vel")},
    "body_rate": {"body_rate": ("r_int_error", "prev_ang_vel")},
}
"""Names of the controllers' memory in Crazyflow, by command level and record."""


@pytest.mark.parametrize("control", CRAZYFLOW_MEMORY)
def test_memory_of_crazyflows_cascade_is_read_under_crazyflows_names(control):
    sim = Sim(control=control, controller="crazyflow", engine="interpret")
    stages = [f"{level}_controller" for level in (*CRAZYFLOW_MEMORY[control], "force_torque")]
    assert list(sim.step_pipeline)[: len(stages)] == stages
    sim.data = with_states(sim.data, pos=[0, 0, 1.0], ang_vel=[0.1, 0.2, 0.3])
    command = np.full((1, 1, 16 if control == "state" else 4), 0.125)
    getattr(sim, f"{control}_control")(command)
    sim.step(10)
    controls, names = sim.data.controls, CRAZYFLOW_MEMORY[control]
    assert controls.controller is getattr(controls, control).controller
    for level, memory in names.items():
        record = getattr(controls, level)
        assert record.params is record.controller.params
        assert {name: getattr(record, name) is getattr(record.controller.memory, name) for name in memory} == (
            dict.fromkeys(memory, True)
        )
        assert all(np.any(getattr(record, name)) for name in memory if (control, name) != ("attitude", "ang_vel_des"))
    if control == "state":  # the body rates of a state command go along with the attitude
        assert controls.state.feedforward is controls.state.staged_feedforward is None
        np.testing.assert_array_equal(controls.attitude.staged_ang_vel_des, command[..., 13:])
    other_controls = Sim(control=control).data.controls
    for level, memory in names.items():
        record = getattr(other_controls, level)
        assert record is None or all(getattr(record, name) is None for name in memory)


def test_gains_of_crazyflow_are_set_under_crazyflows_names():
    sim = Sim(control="attitude", controller="crazyflow", engine="interpret")
    controls, ctrl = sim.data.controls, sim.data.controls.attitude
    doubled = ctrl.params.replace(kR=2 * ctrl.params.kR)
    sim.data = sim.data.replace(controls=controls.replace(attitude=ctrl.replace(params=doubled)))
    np.testing.assert_array_equal(sim.data.controls.controller.params.kR, 2 * ctrl.params.kR)
    controller_data = sim.data.controls.controller
    sim.data = sim.data.replace(
        controls=sim.data.controls.replace(controller=controller_data.replace(params=ctrl.params))
    )
    np.testing.assert_array_equal(sim.data.controls.attitude.params.kR, ctrl.params.kR)
    fitted = Sim(dynamics="so_rpy").data.controls
    assert fitted.controller is fitted.attitude.controller is fitted.attitude.params is None


def test_desired_body_rates_go_along_with_an_attitude_in_crazyflow():
    sim = Sim(control="attitude", controller="crazyflow", engine="interpret")
    sim.data = with_states(sim.data, pos=[0, 0, 10.0])
    sim.attitude_control(np.array([[[0.0, 0.0, 0.0, 0.3]]]))
    ctrl = sim.data.controls.attitude
    ctrl = ctrl.replace(staged_ang_vel_des=ctrl.staged_ang_vel_des + np.float32([0.5, 0, 0]))
    sim.data = sim.data.replace(controls=sim.data.controls.replace(attitude=ctrl))
    sim.step(5)
    np.testing.assert_array_equal(sim.data.controls.attitude.ang_vel_des, [[[0.5, 0, 0]]])
    assert sim.data.states.ang_vel[0, 0, 0] > 0.001  # otherwise it is zero


class Height(Controller):
    """Thrust that climbs to a setpoint, and a level attitude, which another controller follows."""

    name = "height"
    levels = (Control.state,)
    output = Control.attitude
    freq: int = 50
    inner: Controller | None = PID(hold_yaw=True)

    def update(self, data, command, memory, params):
        s = data.states
        thrust = 0.32 + 0.2 * (command.pos - s.pos)[2:] - 0.15 * s.vel[2:]
        return jnp.concatenate([jnp.zeros(3), thrust]), memory


def test_a_controller_of_attitudes_is_followed_by_its_inner_one():
    sim = Sim(drone="cf2x_L250", control="state", controller=Height(), attitude_freq=250)
    rates = sim.control_freq, sim.data.controls.attitude.freq, sim.data.controls.attitude.controller.freq
    assert rates == (50, 250, 250)
    sim.data = with_states(sim.data, pos=[0, 0, 1.0], ang_vel=[0.5, 0, 0], rotor_vel=[1.5e4] * 4)
    sim.state_control(pos=[0, 0, 2.0])
    sim.step(10)
    attitude = np.asarray(sim.data.controls.attitude.cmd)[0, 0]
    np.testing.assert_allclose(attitude, [0, 0, 0, 0.32 + 0.2], atol=2e-2)
    sim.step(390)
    assert sim.data.states.pos[0, 0, 2] > 1.2
    assert abs(sim.data.states.ang_vel[0, 0, 0]) < 0.2
    with pytest.raises(ConfigError, match=r"a controller that commands rotors .* got 'height' with output 'attitude'"):
        Sim(control="state", controller=Height(inner=None))
    with pytest.raises(ConfigError, match="controller 'spring' follows, state, got control='attitude'"):
        Sim(control="state", controller=Height(inner=Spring()))


def test_the_cascade_of_crazyflow_takes_turns_with_another_controller():
    """At the levels that the cascade follows, it flies in a switch as it does without one."""
    command = np.array([[[0.1, -0.1, 0.3, 0.33]]])

    def fly(**settings):
        sim = Sim(drone="cf2x_L250", control="attitude", engine="interpret", **settings)
        sim.data = with_states(sim.data, pos=[0, 0, 10.0])
        sim.attitude_control(command)
        sim.step(50)
        return np.asarray(sim.data.states.quat)

    without_switch, cascade, mellinger = (
        fly(**settings)
        for settings in (
            {"controller": "crazyflow"},
            {"controller": ["crazyflow", "mellinger"], "switch": 0},
            {"controller": ["crazyflow", "mellinger"], "switch": 1},
        )
    )
    np.testing.assert_allclose(cascade, without_switch, atol=1e-6)
    assert np.abs(mellinger - without_switch).max() > 1e-4


def test_a_pitch_rate_through_a_flip_disturbs_no_other_axis():
    """Euler angles jump at a pitch of 90 degrees."""
    sim = Sim(drone="cf2x_L250", control="body_rate", controller="pid")
    sim.data = with_states(sim.data, pos=[0, 0, 50.0])
    sim.body_rate_control(np.array([[[0.0, 6.0, 0.0, 0.25]]], np.float32))
    for _ in range(10):
        sim.step(50)
        rate = np.asarray(sim.data.states.ang_vel)[0, 0]
        np.testing.assert_allclose(rate[::2], 0.0, atol=0.05)
    assert rate[1] > 5.5


def test_a_controller_runs_at_its_rate_and_resets_per_world():
    sim = take_off(Spring(), 101, "interpret")
    np.testing.assert_array_equal(np.asarray(controller_memory(sim).n_ticks)[..., 0], 21.0)
    sim.reset(np.array([True, False, True]))
    np.testing.assert_array_equal(np.asarray(controller_memory(sim).n_ticks)[:, 0, 0], [0, 21, 0])
    assert sim.control_freq == 100


def test_feedforward_reaches_the_controller():
    sim = Sim(WORLDS, DRONES, control="state", controller=Spring(), engine="interpret")
    cmd = make_setpoint(sim)
    cmd[..., 15] = 0.7
    sim.state_control(cmd)
    sim.step()
    np.testing.assert_allclose(
        np.asarray(controller_memory(sim).feedforward)[0, 0], [0, 0, 0, 0, 0, 0, 0.7, 0], atol=1e-6
    )
    feedforward = np.arange(8 * WORLDS * DRONES).reshape(WORLDS, DRONES, 8)
    sim.state_control(cmd, feedforward=feedforward)
    np.testing.assert_array_equal(sim.data.controls.state.staged_feedforward, feedforward)
    sim.step(5)
    np.testing.assert_allclose(controller_memory(sim).feedforward, feedforward)
    with pytest.raises(ValueError, match=r"feedforward command has shape.*jerk"):
        sim.state_control(cmd, feedforward=feedforward[0])
    with pytest.raises(ConfigError, match=r"no feedforward, which .* does not follow, got one. Use controller='auto'"):
        Sim(control="state", controller="crazyflow").state_control(cmd[:1, :1], feedforward=feedforward[:1, :1])


def test_latency_delays_setpoint_and_feedforward():
    sim = Sim(control="state", controller=Spring(freq=500), engine="interpret")
    sim.add(Latency(10))
    cmd = make_setpoint(sim)
    cmd[..., 15] = 0.5
    sim.state_control(cmd)
    sim.step(10)
    assert np.asarray(controller_memory(sim).feedforward)[0, 0, 6] == 0
    assert np.asarray(sim.data.controls.state.cmd)[0, 0, 2] == 0
    sim.step()
    assert np.asarray(controller_memory(sim).feedforward)[0, 0, 6] == 0.5
    np.testing.assert_array_equal(sim.data.controls.state.cmd, cmd)


def test_a_memory_without_scopes_is_refused():
    class Bare(Spring):
        def memory(self, airframe):
            return {"count": np.zeros(1)}

    with pytest.raises(ConfigError, match=r"expected leaves of scope drone in dict of controller 'spring'.*opaque"):
        Sim(control="state", controller=Bare())


def test_incomplete_controllers_are_refused():
    with pytest.raises(TypeError, match="no field 'freq'"):

        class Rateless(Controller):
            name = "rateless"

    with pytest.raises(TypeError, match=r"no class variables \['levels', 'output'\]"):

        class Undeclared(Controller):
            name = "undeclared"
            freq: int = 100


def test_a_subclass_of_gains_needs_the_same_gains():
    class Heavier(MellingerParams):
        extra_mass: jax.Array = leaf("parameter", 1, (1,))

    own = Heavier.create(load_airframe("cf2x_L250"), extra_mass=0.01)
    np.testing.assert_array_equal(own.kp, MellingerParams.create(load_airframe("cf2x_L250")).kp)
    assert own.extra_mass.shape == (1,)
    with pytest.raises(ConfigError, match=r"lacks \[mellinger\] mass, .*which controller 'mellinger' needs"):
        Heavier.create(load_airframe("bumblebee"), extra_mass=0.01)


def test_memory_that_begins_at_zero_needs_a_core_shape():
    class Shapeless(PyTree):
        integral: jax.Array = leaf("drone", 1)

    class Forgetful(Spring, memory=Shapeless):
        name = "forgetful"

    with pytest.raises(ConfigError, match=r"core shape for integral of Shapeless.*leaf\('drone', 1, \(3,\)\)"):
        Sim(control="state", controller=Forgetful())


# Several controllers --------------------------------------------------------------------------------------------


def switch_at_one_second(state, setpoint, time):
    return jnp.where(time < 1.0, 0, 1)


def test_a_switch_function_exchanges_controllers_in_flight():
    sim = take_off(["pid", Spring()], 800, switch=switch_at_one_second, strict=True)
    np.testing.assert_array_equal(controller_memory(sim).active, 1)
    np.testing.assert_array_equal(controller_memory(sim).controllers[1].n_ticks, 60.0)
    assert "not fused" not in sim.explain()


def test_a_switch_chooses_a_controller_for_each_drone():
    index = np.array([[0, 1], [1, 0], [0, 0]])
    switched_sim = take_off(["pid", "mellinger"], 300, "interpret", switch=index)
    separate_sims = [take_off(name, 300, "interpret") for name in ("pid", "mellinger")]
    expected = np.where(index[..., None] == 0, *(np.asarray(sim.data.states.pos) for sim in separate_sims))
    np.testing.assert_allclose(switched_sim.data.states.pos, expected, atol=1e-5)
    np.testing.assert_array_equal(np.asarray(controller_memory(switched_sim).active)[..., 0], index)
    # The memory of an inactive controller does not change.
    assert not np.any(np.asarray(controller_memory(switched_sim).controllers[1].ang_vel)[index == 0])


def test_a_switch_function_gets_state_and_setpoint():
    def switch_when_high(state, setpoint, time):
        assert isinstance(setpoint, Setpoint)
        return (state.pos[2] > 0.5 * setpoint.pos[2]).astype(int)

    sim = take_off(["pid", "mellinger"], 10, switch=switch_when_high)
    np.testing.assert_array_equal(controller_memory(sim).active, 0)
    sim.step(1000)
    np.testing.assert_array_equal(controller_memory(sim).active, 1)


@pytest.mark.parametrize("names, max_change", [(["mellinger", "pid"], 200.0), (["pid", "mellinger"], 1500.0)])
def test_a_switch_in_hover_is_bumpless(names, max_change):
    """PID continues thrust and torque; Mellinger's integral is limited to 0.02 N about its nominal mass."""
    sim = take_off(names, 6000, switch=lambda state, setpoint, time: jnp.where(time < 12.0, 0, 1))
    before = np.asarray(sim.data.controls.rotor_vel)
    sim.step()
    np.testing.assert_array_equal(controller_memory(sim).active, 1)
    assert np.max(np.abs(np.asarray(sim.data.controls.rotor_vel) - before)) < max_change
    sim.step(1000)
    assert np.max(np.abs(np.asarray(sim.data.states.vel))) < 0.1


@pytest.mark.parametrize(
    ("controller", "control"),
    [("pid", "state"), ("mellinger", "attitude"), ("crazyflow", "state")],
)
def test_missing_gains_are_listed_all_at_once(controller, control):
    complete = load_airframe("cf2x_L250")
    light = {"base": "cf2x_L250", "name": "light", "rigid_body": {"mass": 0.03}}
    with pytest.raises(ConfigError) as error:
        Sim(drone=light, control=control, controller=controller)
    message = str(error.value)
    assert f"which controller {controller!r} needs. Its base 'cf2x_L250' has [fitted], [controller], " in message
    assert "are not inherited. Use controller='auto', which needs no gains, or add them" in message
    listed = message.split(", which")[0].split(" lacks ")[1].split("; ")
    for entry in listed:
        path, _, keys = entry.partition("] ")
        table = light
        for part in path[1:].split("."):
            table = table.setdefault(part, {})
        table |= {key: complete.value(f"{path[1:]}.{key}") for key in keys.split(", ")}
    Sim(drone=light, control=control, controller=controller)
