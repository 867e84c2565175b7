"""Law 9: wrong input is an error at once, with expected and given value and a remedy, and changes nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import LEVELS

from crazysim import Cars, ConfigError, Sim, Terrain, Wind
from crazysim.control.geometric import Geometric
from crazysim.core import functional as F
from crazysim.core.data import command_shape
from crazysim.media import View
from crazysim.sim import rollout
from crazysim.sim.visualize import change_material

# Arguments, and parts of the message: the given value, then the expected one or the remedy.
WRONG_SETTINGS = [
    ({"n_worlds": 0}, "n_worlds is 0", "positive whole number"),
    ({"n_worlds": 2.5}, "n_worlds is 2.5", "positive whole number"),
    ({"n_worlds": 2**31 - 1}, "n_worlds=2147483647", "fit into the", "Use fewer worlds"),
    ({"n_drones": -3}, "n_drones is -3", "positive whole number"),
    ({"freq": 20_000}, "freq is 20000", "jax_enable_x64"),
    ({"drone": "cf99"}, "'cf99'", "cf21B_500"),
    ({"drone": "/nowhere/mine.toml"}, "/nowhere/mine.toml", "no file of that path"),
    ({"drone": {}}, "no table [rigid_body]", "Add [rigid_body]"),
    ({"dynamics": "quadratic"}, "'quadratic'", "'first_principles', 'so_rpy'"),
    ({"control": "velocity"}, "'velocity'", "'state', 'attitude', 'body_rate', 'force_torque', 'rotor_vel'"),
    ({"engine": "warp"}, "'warp'", "auto, plain, lanes, fused"),
    ({"integrator": "heun"}, "'heun'", "'euler', 'symplectic_euler', 'rk4'"),
    ({"dynamics": "so_rpy", "control": "rotor_vel"}, "'rotor_vel'", "dynamics='first_principles'"),
    ({"drone": "hb_x500"}, "expected dynamics that drone 'hb_x500' has parameters for", "so_rpy"),
    ({"device": "abacus"}, "got 'abacus'", "'cpu' or 'gpu'"),
    ({"device": "cpu:-1"}, "got 'cpu:-1'", "Use device='cpu'"),
    ({"drone": []}, "got an empty list", "a list with one for each drone"),
    ({"mesh": 2}, "got 2", "world_mesh"),
    ({"xml_path": "/nowhere/scene.xml"}, "expected an existing MJCF file as xml_path", "/nowhere/scene.xml"),
    ({"control": "state", "controller": Geometric(feedforward="no")}, "feedforward of Geometric", "got 'no'"),
    ({"rng_key": "lucky"}, "'lucky'", "an integer"),
    ({"rng_key": 2**70}, str(2**70), "64 bits"),
]


@pytest.mark.parametrize("case", WRONG_SETTINGS, ids=lambda case: "-".join(f"{k}={v}" for k, v in case[0].items()))
def test_wrong_settings_are_errors_at_construction(case):
    settings, *fragments = case
    with pytest.raises(ValueError) as error:
        Sim(**settings)
    for fragment in fragments:
        assert fragment in str(error.value)


@pytest.fixture(scope="module", params=LEVELS)
def level_sim(request):
    return Sim(n_worlds=3, n_drones=2, control=request.param)


def wrong_commands(shape):
    zeros = np.zeros(shape)
    needed = str(shape)
    yield zeros[0], str(shape[1:]), needed
    yield zeros[:, :1], str((3, 1, shape[2])), needed
    yield zeros[:, 0], str((3, shape[2])), needed
    yield zeros[..., :-1], str((*shape[:2], shape[2] - 1)), needed
    yield np.zeros((2, 3, shape[2])), str((2, 3, shape[2])), needed
    yield 0.0, "()", "n_worlds, n_drones"
    yield None, *(("no position", "16 numbers") if shape[-1] == 16 else ("()", "n_worlds, n_drones"))
    yield [[1.0, 2.0], [3.0]], "a regular array, got", "command"
    yield zeros[..., :0].tolist(), str((3, 2, 0)), needed
    yield np.full(shape, "up"), "<U2", "real numbers"
    yield np.zeros(shape, bool), "bool", "real numbers"
    yield np.zeros(shape, complex), "complex128", "real numbers"
    yield np.full(shape, None), "object", "real numbers"
    yield jnp.zeros(shape, bool), "bool", "real numbers"
    yield jnp.zeros(shape[1:]), str(shape[1:]), needed
    for bad, world in ((np.nan, 1), (np.inf, 2), (-np.inf, 0)):
        command = zeros.copy()
        command[world, 1, 2] = bad
        yield command, "NaN or infinite", f"world(s) [{world}]"
        yield command.tolist(), "NaN or infinite", f"world(s) [{world}]"


def test_wrong_commands_leave_the_simulation_as_it_was(level_sim):
    sim, level = level_sim, level_sim.control.value
    before, shape = sim.data, command_shape(level_sim.data, level_sim.control)
    tried = 0
    for command, *fragments in wrong_commands(shape):
        for send in (getattr(sim, f"{level}_control"), lambda c: getattr(F, f"{level}_control")(sim.data, c)):
            with pytest.raises(ValueError) as error:
                send(command)
            assert level in str(error.value)
            for fragment in fragments:
                assert fragment in str(error.value)
            assert isinstance(error.value, ConfigError)
            assert sim.data is before
        tried += 1
    assert tried == 21


def test_a_command_of_another_level_names_both(level_sim):
    sim, before = level_sim, level_sim.data
    for other in set(LEVELS) - {sim.control.value}:
        with pytest.raises(ConfigError) as error:
            getattr(sim, f"{other}_control")(np.zeros((3, 2, 16 if other == "state" else 4)))
        assert f"takes {sim.control.value!r} commands, not {other!r}" in str(error.value)
        assert f"control={other!r}" in str(error.value)
        assert sim.data is before


def test_device_commands_are_checked_only_on_request(level_sim):
    """Reading a device array waits for the device, so it is done only with ``check_finite=True``."""
    sim, before = level_sim, level_sim.data
    set_command = getattr(sim, f"{sim.control.value}_control")
    command = jnp.zeros(command_shape(sim.data, sim.control)).at[2, 0, 1].set(jnp.nan)
    with pytest.raises(ValueError, match=r"NaN or infinite.* in world\(s\) \[2\]"):
        set_command(command, check_finite=True)
    assert sim.data is before
    set_command(command)
    assert sim.data is not before
    sim.data = before


@pytest.fixture(scope="module")
def sim():
    return Sim(n_worlds=3, n_drones=1)


# Calls, and parts of the message.
WRONG_CALLS = [
    (lambda sim: sim.step(0), "n_steps is 0", "positive whole number"),
    (lambda sim: sim.reset(np.zeros(2, bool)), "shape (2,)", "(3,) and bool"),
    (lambda sim: sim.reset([[True], [True, False]]), "[[True], [True, False]]", "one bool per world"),
    (lambda sim: setattr(sim, "max_visual_geom", 0), "max_visual_geom is 0", "positive whole number"),
    (lambda sim: sim.sync(1.0), "expected a world from 0 to 2, got 1.0"),
    (
        lambda sim: sim.rollout(lambda params, data: jnp.zeros((*data.states.pos.shape[:2], 4)), None, 2 * 10**9),
        "expected arrays that fit into the ",
        "got the records of all steps",
        "Keep less",
    ),
    (
        lambda sim: rollout(sim.step_fn, sim.data, lambda params, data: None, None, 2 * 10**9, 1),  # outside of jit
        "expected arrays that fit into the ",
        "Keep less",
    ),
    (lambda sim: setattr(sim, "step_pipeline", []), "expected step_pipeline as a dict", "got []"),
    (lambda sim: setattr(sim, "step_pipeline", {"still": 3}), "expected names and functions", "'still': 3"),
    (lambda sim: sim.scene.add("box", size=(np.nan, 1, 1)), "expected size of 'box' to be positive", "nan"),
    (lambda sim: sim.scene.add("sphere", radius="1"), "expected radius of 'sphere' as a number, got '1'"),
    (lambda sim: sim.scene.add("box", count=10**9), "count is 1000000000", "at most 100000"),
    (lambda sim: sim.add(Cars(1, rgba=(1, 0, 0))), "expected rgba of Cars of shape (4,)", "got (3,)"),
    (
        lambda sim: sim.add(Terrain(np.zeros((2, 2)), (1, 1), rgba=(2, 0, 0, 1))),
        "expected rgba",
        "got [2.0, 0.0, 0.0, 1.0]",
    ),
    (lambda sim: change_material(sim, "led_top", [0], rgba=(np.nan,) * 4), "expected rgba to be from 0 to 1", "nan"),
    (lambda sim: View(width=10**9), "width is 1000000000", "at most 16384"),
    (lambda sim: sim.add(Wind((1e300, 0, 0))), "expected", "1e+300"),
]


@pytest.mark.parametrize("case", WRONG_CALLS, ids=lambda case: case[1])
def test_wrong_calls_leave_the_simulation_as_it_was(sim, case):
    call, *fragments = case
    before, stages = sim.data, dict(sim.step_pipeline)
    with pytest.raises(ValueError) as error:
        call(sim)
    for fragment in fragments:
        assert fragment in str(error.value)
    assert sim.data is before
    assert sim.step_pipeline == stages


KEEPS_TRACED_VALUES = {
    "command": lambda sim, x: sim.attitude_control(jnp.zeros((3, 1, 4)) + x),
    "data": lambda sim, x: setattr(sim, "data", sim.data.replace(params=sim.data.params.replace(mass=x + jnp.ones(1)))),
    "default_data": lambda sim, x: setattr(
        sim, "default_data", sim.data.replace(params=sim.data.params.replace(mass=x + jnp.ones(1)))
    ),
    "member": lambda sim, x: sim[sim.names[0]].set(pos=x + jnp.zeros(3)),
    "mask": lambda sim, x: sim.reset(jnp.ones(3) > x),
    "rollout": lambda sim, x: sim.rollout(lambda params, data: jnp.zeros((3, 1, 4)) + params, x),
}
"""Methods that would keep the values of a function that is being traced."""


@pytest.mark.parametrize("name", KEEPS_TRACED_VALUES)
@pytest.mark.parametrize("steps_before", [0, 1], ids=["record", "flat"])
def test_a_simulation_refuses_traced_values(sim, name, steps_before):
    sim.reset()
    for _ in range(steps_before):
        sim.step()
    before, keep = sim.data, KEEPS_TRACED_VALUES[name]
    with pytest.raises(ConfigError, match=r"got traced ones.*crazysim.core.functional"):
        jax.jit(lambda x: (keep(sim, x), x)[1])(0.5)
    assert sim.data is before
    sim.step()
    sim.reset()


@pytest.mark.parametrize("body", ["drone:1", "gate", 3])
def test_contacts_of_a_body_that_does_not_exist_name_those_that_do(sim, body):
    before = sim.data
    with pytest.raises(ValueError) as error:
        sim.contacts(body)
    assert repr(body) in str(error.value)
    assert "drone:0" in str(error.value)
    assert sim.data is before


@pytest.mark.parametrize(
    "edit, fragments",
    [
        (lambda d: d.replace(params=d.params.replace(mass=jnp.ones((3, 1)))), ("data.params.mass", "(3, 1)")),
        (lambda d: d.replace(params=d.params.replace(J=jnp.ones(3))), ("data.params.J", "(3,)")),
        (lambda d: d.replace(states=d.states.replace(vel=jnp.zeros(3))), ("data.states.vel", "(3,)", "(3, 1, 3)")),
        (lambda d: d.replace(core=d.core.replace(steps=jnp.zeros(3, jnp.int32))), ("data.core.steps", "(3,)")),
    ],
)
def test_data_with_axes_of_its_own_is_refused_at_the_next_step(sim, edit, fragments):
    before = sim.data
    sim.data = edit(before)
    edited = sim.data
    with pytest.raises(ValueError) as error:
        sim.step()
    for fragment in fragments:
        assert fragment in str(error.value)
    assert sim.data is edited
    sim.data = before


def with_state(sim, **fields):
    return sim.data.replace(states=sim.data.states.replace(**fields))


def with_command(sim, **fields):
    controls = sim.data.controls
    return sim.data.replace(controls=controls.replace(attitude=controls.attitude.replace(**fields)))


@pytest.mark.parametrize(
    "wrong, fragments",
    [
        (lambda sim: None, ("got NoneType", "sim.data.replace")),
        (lambda sim: sim.data.replace(core=None), ("got SimData",)),
        (lambda sim: Sim(n_worlds=2).data, ("data of 3 worlds of 1 drones", "got data of 2 worlds of 1 drones")),
        (lambda sim: Sim(n_worlds=3, control="state").data, ("'attitude' commands", "'state' commands")),
        (lambda sim: Sim(n_worlds=3, freq=250).data, ("at 500 Hz", "at 250 Hz")),
        (lambda sim: Sim(n_worlds=3, dynamics="so_rpy").data, ("first-principles", "fitted")),
        (lambda sim: Sim(n_worlds=3, controller="crazyflow").data, ("with memory AutoMemory", "memory AttitudeMemory")),
        (lambda sim: Sim(n_worlds=3, attitude_freq=250).data, ("freq=500, got", "AutoParams and freq=250")),
        (lambda sim: Sim(n_worlds=3, controller=["auto"], switch=0).data, ("got memory SwitchMemory(AutoMemory)",)),
        (
            lambda sim: sim.data.replace(
                controls=sim.data.controls.replace(
                    controller=sim.data.controls.controller.replace(
                        memory=jax.tree.map(lambda x: x[..., :2], sim.data.controls.controller.memory)
                    )
                )
            ),
            ("of shapes [(3, 1, 3), ", "got memory AutoMemory of shapes [(3, 1, 2), "),
        ),
        (lambda sim: with_state(sim, pos=jnp.zeros((3, 1, 2))), ("data.states.pos", "shape (3, 1, 3)", "got an array")),
        (lambda sim: with_state(sim, vel=jnp.zeros((3, 1, 3), int)), ("data.states.vel", "(3, 1, 3) and type int32")),
        (lambda sim: with_state(sim, force=0.0), ("data.states.force as an array of shape (3, 1, 3)", "got 0.0")),
        (lambda sim: with_command(sim, cmd=jnp.zeros((3, 1, 3))), ("data.controls.attitude.cmd", "(3, 1, 3)")),
        (lambda sim: with_command(sim, staged_cmd=None), ("data.controls.attitude.staged_cmd", "got None")),
        (
            lambda sim: sim.data.replace(controls=sim.data.controls.replace(rotor_vel=jnp.zeros((3, 1, 4), bool))),
            ("data.controls.rotor_vel as an array of shape (3, 1, 4)", "bool"),
        ),
    ],
)
@pytest.mark.parametrize("name", ["data", "default_data"])
def test_data_of_another_simulation_is_refused_where_it_is_assigned(sim, name, wrong, fragments):
    before, default, other = sim.data, sim.default_data, wrong(sim)
    with pytest.raises(ConfigError) as error:
        setattr(sim, name, other)
    for fragment in fragments:
        assert fragment in str(error.value)
    assert sim.data is before
    assert sim.default_data is default


@pytest.mark.parametrize(
    "call",
    [
        lambda sim, data: F.state_control(data, pos=[0, 0, 1]),
        lambda sim, data: F.attitude_control(data, np.zeros((3, 1, 4))),
        lambda sim, data: F.time(data),
        lambda sim, data: F.controllable(data),
        lambda sim, data: sim.step_fn(data),
        lambda sim, data: sim.reset_fn(data, sim.default_data),
        lambda sim, data: sim.reset_fn(sim.data, data),
        lambda sim, data: sim.scene.contact_fn()(data),
        lambda sim, data: sim.scene.depth_fn(width=2, height=2)(data),
    ],
)
def test_a_simulation_in_place_of_its_data_is_refused_by_pure_functions(sim, call):
    for data in (sim, None):
        with pytest.raises(ConfigError, match=r"expected the data of a simulation, got .*sim\.data"):
            call(sim, data)
