"""Law 9: wrong input is told at once, with what came and what is needed, and the simulation stays as it was."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import LEVELS

from crazysim import ConfigError, Sim, load_airframe
from crazysim.core import functional as F
from crazysim.core.data import command_shape
from crazysim.core.pipeline import append_fn, insert_fn_before, remove_fn, replace_fn


def broken(tmp_path, text):
    path = tmp_path / "broken.xml"
    path.write_text(text, encoding="utf-8")
    return path


# What is passed, and what the message must contain: what came, then what was needed or what to do.
WRONG_SETTINGS = [
    ({"n_worlds": 0}, "n_worlds is 0", "positive whole number"),
    ({"n_worlds": 2.5}, "n_worlds is 2.5", "positive whole number"),
    ({"n_worlds": True}, "n_worlds is True", "positive whole number"),
    ({"n_worlds": np.int64(-1)}, "n_worlds is", "positive whole number"),
    ({"n_drones": -3}, "n_drones is -3", "positive whole number"),
    ({"n_drones": "4"}, "n_drones is '4'", "positive whole number"),
    ({"freq": 0}, "freq is 0", "positive whole number"),
    ({"freq": -500}, "freq is -500", "positive whole number"),
    ({"freq": 500.0}, "freq is 500.0", "positive whole number"),
    ({"freq": 20_000}, "freq is 20000", "jax_enable_x64"),
    ({"attitude_freq": 0}, "attitude_freq is 0", "positive whole number"),
    ({"attitude_freq": -50}, "attitude_freq is -50", "positive whole number"),
    ({"attitude_freq": 2.5}, "attitude_freq is 2.5", "positive whole number"),
    ({"attitude_freq": 300}, "attitude_freq is 300", "divide freq = 500 Hz", "250 Hz"),
    ({"attitude_freq": 1000}, "attitude_freq is 1000", "divide freq = 500 Hz", "500 Hz"),
    ({"control": "state", "state_freq": 33}, "state_freq is 33", "25 Hz"),
    ({"control": "body_rate", "body_rate_freq": 300}, "body_rate_freq is 300", "250 Hz"),
    ({"control": "force_torque", "force_torque_freq": 400}, "force_torque_freq is 400", "250 Hz"),
    ({"drone": "cf99"}, "'cf99'", "cf21B_500"),
    ({"drone": "/nowhere/mine.toml"}, "/nowhere/mine.toml", "no TOML file"),
    ({"drone": 3}, "not 3", "a dict or an airframe"),
    ({"drone": {}}, "no table [rigid_body]", "Add [rigid_body]"),
    ({"dynamics": "quadratic"}, "'quadratic'", "'first_principles', 'so_rpy'"),
    ({"dynamics": None}, "None", "'first_principles'"),
    ({"control": "velocity"}, "'velocity'", "'state', 'attitude', 'body_rate', 'force_torque', 'rotor_vel'"),
    ({"integrator": "heun"}, "'heun'", "'euler', 'symplectic_euler', 'rk4'"),
    ({"dynamics": "so_rpy", "control": "rotor_vel"}, "'rotor_vel'", "dynamics='first_principles'"),
    ({"dynamics": "so_rpy_rotor", "control": "force_torque"}, "'force_torque'", "dynamics='first_principles'"),
    ({"dynamics": "so_rpy_rotor_drag", "control": "body_rate"}, "'body_rate'", "dynamics='first_principles'"),
    ({"drone": "hb_x500"}, "'hb_x500' has no parameters for dynamics 'first_principles'", "so_rpy"),
    ({"device": "abacus"}, "'abacus' does not exist", "'cpu' or 'gpu'"),
    ({"device": "cpu:99"}, "'cpu:99' does not exist", "'cpu' or 'gpu'"),
    ({"device": None}, "not None", "jax.Device"),
    ({"mesh": 2}, "got 2", "world_mesh"),
    ({"xml_path": "/nowhere/scene.xml"}, "/nowhere/scene.xml does not exist", "xml_path="),
    ({"xml_path": 3}, "xml_path is 3", "MJCF"),
    ({"rng_key": "lucky"}, "'lucky'", "an integer"),
    ({"rng_key": 1.5}, "1.5", "an integer"),
    ({"rng_key": 2**70}, str(2**70), "64 bits"),
]


@pytest.mark.parametrize("case", WRONG_SETTINGS, ids=lambda case: "-".join(f"{k}={v}" for k, v in case[0].items()))
def test_wrong_settings_are_told_at_construction(case):
    settings, *fragments = case
    with pytest.raises(ValueError) as error:
        Sim(**settings)
    for fragment in fragments:
        assert fragment in str(error.value)


@pytest.mark.parametrize(
    "text, fragment",
    [
        ("<mujoco><worldbody>", "is not a scene MuJoCo can read"),
        ("no XML at all", "is not a scene MuJoCo can read"),
        ("<mujoco><worldbody><geom type='teapot'/></worldbody></mujoco>", "is not a scene MuJoCo can read"),
        ("<mujoco><worldbody><geom type='sphere'/></worldbody></mujoco>", "does not compile"),
        ("<mujoco><worldbody><body name='drone:0'/></worldbody></mujoco>", "'drone:0'"),
    ],
)
def test_a_broken_scene_file_is_told_at_construction(text, fragment, tmp_path):
    with pytest.raises(ConfigError) as error:
        Sim(xml_path=broken(tmp_path, text))
    assert fragment in str(error.value)


def airframe(**changes):
    """Return the tables of a drone that flies, with some numbers exchanged."""

    def copy(node):
        return {k: copy(v) if hasattr(v, "items") else v for k, v in node.items()}

    tables = copy(load_airframe("cf21B_500").tables)
    for path, value in changes.items():
        table, key = path.split("__")
        tables[table][key] = value
    return tables


@pytest.mark.parametrize(
    "changes, fragments",
    [
        ({"rigid_body__mass": 0.0}, ("mass is 0.0 kg", "positive")),
        ({"rigid_body__mass": -1.0}, ("mass is -1.0 kg", "positive")),
        ({"rigid_body__mass": "heavy"}, ("'heavy'", "not a number")),
        ({"rigid_body__mass": np.nan}, ("rigid_body.mass", "not finite")),
        ({"rigid_body__mass": 5.0}, ("cannot lift 5.0 kg",)),
        ({"rigid_body__mass": [1.0, 2.0]}, ("rigid_body.mass has shape (2,)", "needed is ()")),
        ({"rigid_body__inertia": [1e-5, -1e-5, 1e-5]}, ("-1e-05", "positive")),
        ({"rigid_body__inertia": [1e-5, 1e-5]}, ("inertia", "three positive moments")),
        ({"rotors__position": [[0.1, 0.1]]}, ("(1, 2)", "(n, 3)")),
        ({"rotors__yaw_torque_sign": [1, -1]}, ("yaw_torque_sign has shape (2,)", "(4,)")),
        ({"rotors__thrust_min": 0.3}, ("thrust_min 0.3 N", "0 <= min < max")),
        ({"rotors__thrust_max": -0.1}, ("thrust_max -0.1 N", "0 <= min < max")),
        ({"rotors__lag": [1.0, 2.0]}, ("rotors.lag has shape (2,)", "(4,)")),
        ({"drag__coefficients": [1.0]}, ("drag.coefficients has shape (1,)", "(3,)")),
    ],
)
def test_airframes_that_cannot_fly_are_refused(changes, fragments):
    with pytest.raises(ConfigError) as error:
        load_airframe(airframe(**changes))
    for fragment in fragments:
        assert fragment in str(error.value)


def test_an_airframe_file_that_is_no_toml_is_refused(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("mass = = 3", encoding="utf-8")
    with pytest.raises(ConfigError, match="not valid TOML"):
        Sim(drone=path)


@pytest.fixture(scope="module", params=LEVELS)
def at_level(request):
    return Sim(n_worlds=3, n_drones=2, control=request.param)


def wrong_commands(shape):
    """Yield wrong commands for a shape, with two parts of the message each."""
    zeros = np.zeros(shape)
    needed = str(shape)
    yield zeros[0], str(shape[1:]), needed
    yield zeros[:, :1], str((3, 1, shape[2])), needed
    yield zeros[:, 0], str((3, shape[2])), needed
    yield zeros[..., :-1], str((*shape[:2], shape[2] - 1)), needed
    yield np.zeros((2, 3, shape[2])), str((2, 3, shape[2])), needed
    yield 0.0, "()", "n_worlds, n_drones"
    yield None, "()", "n_worlds, n_drones"
    yield [[1.0, 2.0], [3.0]], "no regular array", "command"
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


def test_wrong_commands_leave_the_simulation_as_it_was(at_level):
    sim, level = at_level, at_level.control.value
    before, shape = sim.data, command_shape(at_level.data, at_level.control)
    tried = 0
    for command, *fragments in wrong_commands(shape):
        for send in (getattr(sim, f"{level}_control"), lambda c: getattr(F, f"{level}_control")(sim.data, c)):
            with pytest.raises(ValueError) as error:
                send(command)
            assert level in str(error.value)
            for fragment in fragments:
                assert fragment in str(error.value)
            assert sim.data is before
        tried += 1
    assert tried == 21


def test_a_command_of_another_level_names_both(at_level):
    sim, before = at_level, at_level.data
    for other in set(LEVELS) - {sim.control.value}:
        with pytest.raises(ConfigError) as error:
            getattr(sim, f"{other}_control")(np.zeros((3, 2, 16 if other == "state" else 4)))
        assert f"takes {sim.control.value!r} commands, not {other!r}" in str(error.value)
        assert f"control={other!r}" in str(error.value)
        assert sim.data is before


def test_device_commands_are_looked_at_only_when_asked(at_level):
    """Looking at a device array would wait for the device, so it is done with ``check_finite=True`` only."""
    sim, before = at_level, at_level.data
    set_command = getattr(sim, f"{sim.control.value}_control")
    command = jnp.zeros(command_shape(sim.data, sim.control)).at[2, 0, 1].set(jnp.nan)
    with pytest.raises(ValueError, match=r"NaN or infinite.* in world\(s\) \[2\]"):
        set_command(command, check_finite=True)
    assert sim.data is before
    set_command(command)
    assert sim.data is not before
    sim.data = before


def test_commands_are_cast_to_the_type_of_the_state(at_level):
    """The one conversion that is documented: nothing of the values is lost but digits, and nothing is clipped."""
    before = at_level.data
    level, shape = at_level.control.value, command_shape(at_level.data, at_level.control)
    command = np.arange(np.prod(shape)).reshape(shape) * 1000
    for given in (command, command.tolist(), command.astype(np.float64), jnp.asarray(command, jnp.int32)):
        data = getattr(F, f"{level}_control")(before, given)
        staged = data.controls.rotor_vel if level == "rotor_vel" else getattr(data.controls, level).staged_cmd
        assert staged.dtype == before.states.pos.dtype
        np.testing.assert_array_equal(staged, command)


@pytest.fixture(scope="module")
def sim():
    return Sim(n_worlds=3, n_drones=1)


def stage_that_is_none(data):
    return data


# What is called, and what the message must contain.
WRONG_CALLS = [
    (lambda sim: sim.step(0), "n_steps is 0", "positive whole number"),
    (lambda sim: sim.step(-5), "n_steps is -5", "positive whole number"),
    (lambda sim: sim.step(1.0), "n_steps is 1.0", "positive whole number"),
    (lambda sim: sim.step(True), "n_steps is True", "positive whole number"),
    (lambda sim: sim.step("3"), "n_steps is '3'", "positive whole number"),
    (lambda sim: sim.reset(np.zeros(2, bool)), "shape (2,)", "(3,) and bool"),
    (lambda sim: sim.reset(np.zeros((3, 1), bool)), "shape (3, 1)", "(3,) and bool"),
    (lambda sim: sim.reset(np.array([1, 0, 1])), "int64", "(3,) and bool"),
    (lambda sim: sim.reset(jnp.zeros(3)), "float32", "(3,) and bool"),
    (lambda sim: sim.reset([0, 2]), "shape (2,)", "(3,) and bool"),
    (lambda sim: sim.reset([[True], [True, False]]), "[[True], [True, False]]", "one bool per world"),
    (lambda sim: sim.reset(True), "shape ()", "(3,) and bool"),
    (lambda sim: sim.seed(1.5), "1.5", "an integer"),
    (lambda sim: sim.seed("7"), "'7'", "an integer"),
    (lambda sim: sim.seed(None), "None", "an integer"),
    (lambda sim: sim.render("rgb_array", world=3), "world 3 does not exist", "0 to 2"),
    (lambda sim: sim.render("rgb_array", world=-1), "world -1 does not exist", "0 to 2"),
    (lambda sim: setattr(sim, "max_visual_geom", 0), "max_visual_geom is 0", "positive whole number"),
    (lambda sim: remove_fn(sim.step_pipeline, "wind"), "No stage named 'wind'", "integration"),
    (lambda sim: replace_fn(sim.step_pipeline, stage_that_is_none, "wind"), "No stage named 'wind'", "integration"),
    (
        lambda sim: insert_fn_before(sim.step_pipeline, "wind", stage_that_is_none),
        "No stage named 'wind'",
        "integration",
    ),
    (
        lambda sim: append_fn(sim.step_pipeline, stage_that_is_none, "integration"),
        "'integration' already exists",
        "name=",
    ),
    (lambda sim: append_fn(sim.step_pipeline, None), "got None", "a function"),
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
        (lambda d: d.replace(states=d.states.replace(vel=jnp.zeros(3))), ("data.states.vel", "(3,)", "(3, 1)")),
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


def test_a_spec_that_does_not_compile_leaves_the_old_scene():
    sim = Sim()
    before, model = sim.data, sim.mj_model
    geom = sim.spec.worldbody.add_geom(name="bad", size=[-1.0, 0, 0])
    with pytest.raises(ConfigError, match="the scene does not compile"):
        sim.build_mjx()
    assert sim.data is before
    assert sim.mj_model is model
    sim.spec.delete(geom)
    sim.build_mjx()


def test_no_assertion_checks_what_users_pass():
    """Under ``python -O`` an assert is gone."""
    from pathlib import Path

    import crazysim

    files = list(Path(crazysim.__file__).parent.rglob("*.py"))
    assert len(files) > 30
    for path in files:
        lines = path.read_text(encoding="utf-8").splitlines()
        assert not [line for line in lines if line.strip().startswith("assert ")], path


def test_commands_under_jit_are_checked_in_shape_too(sim):
    with pytest.raises(ValueError, match=r"has shape \(1, 4\)"):
        jax.eval_shape(lambda data, cmd: F.attitude_control(data, cmd, check_finite=True), sim.data, jnp.zeros((1, 4)))
