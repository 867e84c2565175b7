"""The commands that make and check airframes, as a user runs them."""

import tomllib

import numpy as np
import pytest
from disks import full_disk

from crazysim import load_airframe
from crazysim.__main__ import main
from crazysim.commands.airframe_check import describe_airframe

REQUIRED_OPTIONS = ("--mass", "1.2", "--propeller", "0.127", "--thrust-to-weight", "4")


def rows(text):
    return {line[:22].strip(): line[22:] for line in text.splitlines()}


def test_new_writes_a_file_that_check_reads_and_draws(tmp_path, capsys, opengl):
    path, picture = tmp_path / "mine.toml", tmp_path / "mine.png"
    assert main(["airframe", "new", str(path), *REQUIRED_OPTIONS, "--arm", "0.12", "--cells", "6"]) == 0
    out = capsys.readouterr().out
    assert f"wrote {path}; estimated: inertia" in out
    assert f"crazysim airframe check {path}" in out
    assert load_airframe(path).name == "mine"
    assert load_airframe(path).value("battery.cells") == 6
    assert main(["airframe", "check", str(path), "--picture", str(picture)]) == 0
    result = rows(capsys.readouterr().out)
    assert result["wheelbase"] == "240 mm, the largest distance of two rotors"  # twice the arm
    assert [result[f"rotor {k}"].split("; turns ")[1].split()[0] for k in range(1, 5)] == [
        "counter-clockwise",
        "clockwise",
    ] * 2
    assert {result[f"rotor {k}"].split(";")[0] for k in range(1, 5)} == {  # 120 mm over the root of two
        f"85 mm {a}, 85 mm {b}" for a in ("forward", "back") for b in ("left", "right")
    }
    assert result["thrust over weight"] == "4.00"
    assert result["hover"] == "25% of the largest thrust"
    assert result["tilt at full thrust"] == "holds height up to 76 degrees"  # arccos(1 / 4) = 75.5 degrees
    assert "50% of" in result["rotor speed"]  # thrust is quadratic in the speed
    assert result["rotor time constant"] == "0.05 s in hover"
    assert result["auto"] == "state, attitude, body_rate"
    loops = ("position", "velocity", "attitude", "rate")
    gains = "; ".join(f"[pid.{loop}] kp, ki, kd" for loop in loops)
    lacking = f"{gains}; [pid] tilt_max, thrust_base, thrust_min; [controller] pwm_max"
    assert result["pid"] == f"none; not state, attitude, body_rate: lacks {lacking}"
    assert result["mellinger"].startswith(
        "none; not state, attitude: lacks [mellinger] mass, mass_thrust, kp, kd, ki, integral_max, kR, "
    )
    assert result["mellinger"].endswith("; [controller] pwm_max")
    assert result["crazyflow"].startswith("force_torque; not state: lacks [controller.state] kp, kd, ki, int_err_max;")
    assert "; not attitude, body_rate: lacks [controller.attitude] kR, kw, ki_m" in result["crazyflow"]
    assert "warning" not in result
    from matplotlib.image import imread

    image = np.asarray(imread(picture))[..., :3]
    assert image.shape == (640, 960, 3)
    dark = np.asarray(image).mean(axis=-1) < 0.35
    assert 0.05 < dark[150:500, 200:760].mean() < 0.6, "the propellers are in the middle"


def test_new_takes_rotors_one_by_one(tmp_path):
    path = tmp_path / "tri.toml"
    places = "0.2,0.2 -0.3,0,0.01 0.2,-0.2,0"
    arguments = [
        str(path),
        *REQUIRED_OPTIONS,
        "--spins",
        "ccw",
        "cw",
        "CCW",
        "--name",
        "tri copter",
        "--positions",
        places,
    ]
    assert main(["airframe", "new", *arguments]) == 0
    airframe = load_airframe(path)
    assert airframe.name == "tri copter"
    np.testing.assert_allclose(airframe.value("rotors.position"), [[0.2, 0.2, 0], [-0.3, 0, 0.01], [0.2, -0.2, 0]])
    np.testing.assert_array_equal(airframe.value("rotors.yaw_torque_sign"), [-1, 1, -1])
    warnings = [line for line in describe_airframe(airframe).splitlines() if line.startswith("warning")]
    assert len(warnings) == 2
    assert "not centred on the centre of mass" in warnings[0]
    assert "turn one way" in warnings[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["mine.txt", *REQUIRED_OPTIONS], "expected the name of a file that ends with .toml"),
        (["none/mine.toml", *REQUIRED_OPTIONS], "expected an existing folder"),
        (["mine.toml", *REQUIRED_OPTIONS], "expected either arm"),
        (["mine.toml", *REQUIRED_OPTIONS, "--arm", "0.12", "--rotors", "100000"], "rotors from 4 to 64, which"),
        (["mine.toml", *REQUIRED_OPTIONS, "--arm", "0.12", "--spins", "left"], "--spins of ccw and cw, got 'left'"),
        (["mine.toml", *REQUIRED_OPTIONS, "--positions", "a,b"], "--positions such as"),
        (["there.toml", *REQUIRED_OPTIONS, "--arm", "0.12"], "expected a new file"),
        (["mine.toml", *REQUIRED_OPTIONS[:-1], "0.5", "--arm", "0.12"], "expected rotors that lift"),
    ],
)
def test_wrong_arguments_are_one_line_and_write_nothing(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.toml").write_text("")
    assert main(["airframe", "new", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error
    assert not (tmp_path / "mine.toml").exists()


def test_a_full_disk_leaves_nothing(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    with full_disk():
        assert main(["airframe", "new", str(path), *REQUIRED_OPTIONS, "--arm", "0.12"]) == 2
    error = capsys.readouterr().err.strip()
    assert "expected a file that can be written" in error
    assert "\n" not in error
    assert not list(tmp_path.iterdir())


def test_a_drone_is_checked_by_hand():
    """The largest torques at hover are the thrust left to the limits of the rotors times their lever arms."""
    airframe = load_airframe("cf21B_500")
    hover = 0.0434 * 9.81 / 4
    spare = min(hover - airframe.value("rotors.thrust_min"), 0.2 - hover)
    text = rows(describe_airframe(airframe))
    assert f"up to {4 * spare * 0.035355 / 25e-6:.3g} rad/s^2" in text["roll"]
    assert text["pid"] == "state, attitude, body_rate"
    fitted = rows(describe_airframe(load_airframe("hb_x500")))
    assert fitted["dynamics"].startswith("so_rpy")
    assert fitted["auto"].startswith("state")


def test_the_file_states_the_assumptions_of_its_estimates(tmp_path):
    path = tmp_path / "mine.toml"
    assert main(["airframe", "new", str(path), *REQUIRED_OPTIONS, "--arm", "0.12"]) == 0
    sources = tomllib.loads(path.read_text(encoding="utf-8"))["sources"]
    assert "figure of merit of 0.44" in sources["torque_curve"]


def test_warnings_state_what_makes_flights_slow():
    """Weak yaw: 9.81 / 4 - 0.5 N of spare thrust, 0.1 mm of drag torque over thrust, four times, over 0.02 kg m^2."""
    quad = {
        "rigid_body": {"mass": 1.0, "inertia": [0.01, 0.01, 0.02]},
        "rotors": {
            "position": [[0.1, -0.1, 0], [-0.1, -0.1, 0], [-0.1, 0.1, 0], [0.1, 0.1, 0]],
            "yaw_torque_sign": [-1, 1, -1, 1],
            "thrust_min": 0.5,
            "thrust_max": 10.0,
            "inertia": 1e-5,
            "thrust_curve": [0, 0, 1e-8],
            "torque_curve": [0, 0, 1e-12],
            "lag": [4, 0, 4, 0],
        },
        "drag": {"coefficients": [-0.1, -0.1, -0.1]},
    }
    rotors = quad["rotors"]
    assert warnings_of(quad) == [
        "yaw has at most 0.039 rad/s^2 under controller 'auto': a turn by 90 degrees takes 13 s at least",
        "rotors lag by 0.25 s: a drone that is thrown takes long to recover",
    ]
    quick = warnings_of(quad | {"rotors": rotors | {"torque_curve": [0, 0, 2e-10], "lag": [900, 0, 900, 0]}})
    assert len(quick) == 1
    assert "Use freq=600 or more" in quick[0]
    # Five rotors, of which one has no partner: 2e-4 kg m^2 at 1,467 rad/s over 0.01 kg m^2.
    places = [[0.1, -0.1, 0], [-0.1, -0.1, 0], [-0.1, 0.1, 0], [0.1, 0.1, 0], [0, 0, 0.1]]
    five = rotors | {"position": places, "yaw_torque_sign": [-1, 1, -1, 1, 1], "torque_curve": [0, 0, 2e-10]}
    heavy = warnings_of(quad | {"rotors": five | {"inertia": 2e-4, "lag": [20, 0, 20, 0], "thrust_min": 0.1}})
    assert len(heavy) == 3
    assert "equal thrusts do not balance the yaw torque" in heavy[0]
    assert "at 1 rad/s of roll or pitch their momentum takes 29 of" in heavy[1]
    assert "turns roll into pitch at 29 rad/s, against a bandwidth of controller 'auto' of" in heavy[2]


def warnings_of(airframe):
    lines = describe_airframe(load_airframe(airframe)).splitlines()
    return [line[22:] for line in lines if line.startswith("warning")]
