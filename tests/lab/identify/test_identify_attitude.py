"""Fitted dynamics are found in logs with attitude commands."""

import re

import numpy as np
import pytest

from crazysim.__main__ import main
from crazysim.drones import load_airframe
from crazysim.errors import ConfigError
from crazysim.lab.identify import FittedModel, identify_attitude, prediction_errors, read_log
from crazysim.lab.identify.attitude_logs import derivatives_svf, preprocessing
from crazysim.lab.identify.fitted import sys_id_rotation, sys_id_translation
from crazysim.sim import Sim

MODEL = "so_rpy_rotor_drag"
RATE, SECONDS = 100, 30
COLUMN_NAMES = "t x y z qx qy qz qw roll_command pitch_command yaw_command thrust_command".split()
PARAMETER_NAMES = (
    "cmd_f_coef", "thrust_dyn_coef", "drag_coefficients", "rpy_coef", "rpy_rates_coef", "cmd_rpy_coef",
)  # fmt: skip
NOISE_STD = 1e-3
"""Standard deviation of the noise of positions, m, and of the parts of quaternions."""


def fly(airframes):
    """Return columns of simulated flights with the fitted model, which start in hover."""
    n, rng = len(airframes), np.random.default_rng(0)
    sim = Sim(drone=airframes, dynamics=MODEL, control="attitude", freq=1000, attitude_freq=RATE, integrator="rk4")
    loaded = [load_airframe(a) for a in airframes]
    weight = 9.81 * np.array([a.value("rigid_body.mass") for a in loaded])
    hover = weight / [a.value(f"fitted.{MODEL}.cmd_f_coef") for a in loaded]
    states = sim.data.states
    pos = np.stack([3.0 * np.arange(n), np.zeros(n), np.full(n, 50.0)], axis=-1)[None].astype(np.float32)
    rotor_vel = np.zeros_like(states.rotor_vel) + hover[:, None].astype(np.float32)
    sim.data = sim.data.replace(states=states.replace(pos=pos, rotor_vel=rotor_vel))
    cmd, rows = np.c_[np.zeros((n, 3)), hover], []
    for k in range(SECONDS * RATE):
        states = sim.data.states
        pos, quat, vel = (np.asarray(x)[0] for x in (states.pos, states.quat, states.vel))
        if k >= RATE and k % 25 == 0:
            for i, (v, height) in enumerate(zip(vel, pos[:, 2], strict=True)):
                back = np.clip([0.1 * v[1], -0.1 * v[0]], -0.2, 0.2)
                lift = rng.uniform(0.8, 1.25) - np.clip(0.15 * v[2] + 0.02 * (height - 50), -0.25, 0.25)
                cmd[i] = [*rng.uniform(-0.35, 0.35, 2) + back, rng.uniform(-0.5, 0.5), hover[i] * lift]
        rows.append(np.c_[np.full(n, k / RATE), pos, quat, cmd])
        sim.attitude_control(cmd[None].astype(np.float32))
        sim.step(1000 // RATE)
    return [dict(zip(COLUMN_NAMES, x, strict=True)) for x in np.transpose(rows, (1, 2, 0))]


N_DRAWN, N_WITHOUT_NOISE = 8, 3
"""Number of airframes whose fitted model is drawn, and how many of their flights are also fitted without noise."""


@pytest.fixture(scope="module")
def drawn_models():
    rng = np.random.default_rng(1)
    return [draw_model(rng, k) for k in range(N_DRAWN)]


@pytest.fixture(scope="module")
def flights(drawn_models):
    """Return the flight of a cf2x_L250, and those of the airframes that are drawn."""
    return fly(["cf2x_L250", *(airframe for airframe, _ in drawn_models)])


@pytest.fixture
def flight(flights):
    return flights[0]


def stack_columns(flight, *names):
    return np.stack([flight[name] for name in names], axis=-1)


def test_names_of_crazyflow_find_the_parameters(flight):
    data = {"time": flight["t"], "cmd_f": flight["thrust_command"], "pos": stack_columns(flight, *"xyz")}
    data |= {"quat": stack_columns(flight, "qx", "qy", "qz", "qw")}
    data |= {"cmd_rpy": stack_columns(flight, "roll_command", "pitch_command", "yaw_command")}
    log, airframe = derivatives_svf(preprocessing(data)), load_airframe("cf2x_L250")
    result = sys_id_translation(MODEL, float(airframe.value("rigid_body.mass")), log)
    true = {key: airframe.value(f"fitted.{MODEL}.{key}") for key in ("cmd_f_coef", "thrust_dyn_coef")}
    drag = airframe.value(f"fitted.{MODEL}.drag_coefficients")
    assert result["cmd_f_coef"] == pytest.approx(true["cmd_f_coef"], rel=0.005)
    # Products of attitude, thrust and velocity are formed after the filter. This biases lag and drag by less than 1%.
    assert result["thrust_dyn_coef"] == pytest.approx(true["thrust_dyn_coef"], rel=0.01)
    assert result["drag_xy_coef"] == pytest.approx(drag[0], rel=0.01)
    assert result["drag_z_coef"] == pytest.approx(drag[2], rel=0.01)
    rotation = sys_id_rotation(log)
    for key, x in rotation.items():
        np.testing.assert_allclose(x, airframe.value(f"fitted.{MODEL}.{key}"), rtol=0.01, err_msg=key)


def list_numbers(parameters):
    """Return the numbers of parameters by name, without those of pitch and y, which equal those of roll and x."""
    return np.concatenate(
        [np.ravel(parameters[name])[[0, -1][: np.size(parameters[name])]] for name in PARAMETER_NAMES]
    )


def draw_model(rng, k):
    """Return an airframe whose fitted model is drawn about that of cf2x_L250, and its numbers."""
    base = load_airframe("cf2x_L250")
    spreads = {"cmd_f_coef": (0.9, 1.1), "thrust_dyn_coef": (0.5, 1.5), "drag_coefficients": (0.5, 2.0)}
    truth = {"acc_coef": 0.0}
    for name in PARAMETER_NAMES:
        value = np.asarray(base.value(f"fitted.{MODEL}.{name}"))
        factors = rng.uniform(*spreads.get(name, (0.7, 1.4)), 2)
        truth[name] = (value * (factors[[0, 0, 1]] if value.ndim else factors[0])).tolist()
    return {"name": f"drawn{k}", "base": "cf2x_L250", "fitted": {MODEL: truth}}, list_numbers(truth)


@pytest.mark.long("flies nine airframes for 30 s and fits them")
def test_errors_are_as_large_as_their_deviations(drawn_models, flights):
    """Of 80 numbers with noise, whose shares scatter by 5% of 1, and of 30 without.

    Without noise, most errors are far below the 0.05% by which integrals between samples may be off.
    """
    rng, cases = np.random.default_rng(2), [*zip(drawn_models, flights[1:], strict=True)]
    for noise, largest_share, chosen in ((0.0, 1.0, cases[:N_WITHOUT_NOISE]), (NOISE_STD, 0.95, cases)):
        errors = []
        for (_, truth), columns in chosen:
            noisy = {k: x + noise * rng.normal(size=len(x)) * (k[0] in "xyzq") for k, x in columns.items()}
            fit, text = identify_attitude([read_log(noisy)], "cf2x_L250", MODEL, "flight")
            lines = re.findall(r"^# \w+: ([\d., e-]+)$", text, re.MULTILINE)
            deviations = [float(x) for line in lines for x in line.split(", ")[-2:]]
            values = list_numbers({name: fit.value(f"fitted.{MODEL}.{name}") for name in PARAMETER_NAMES})
            errors += list((values - truth) / deviations)
        shares = np.array([np.mean(np.abs(errors) <= k) for k in (1, 2, 3)])
        assert np.all(shares >= [0.63, 0.93, 0.985]), shares
        assert shares[0] <= largest_share, shares


def test_command_writes_the_fitted_model(flight, tmp_path, capsys):
    path, out, plot = tmp_path / "flight.npz", tmp_path / "mine.toml", tmp_path / "errors.png"
    np.savez(path, **flight)
    options = ["--airframe", "cf2x_L250", "--dynamics", MODEL, "--mass", "0.033", "--out", str(out)]
    assert main(["identify", str(path), *options, "--test", str(path), "--plot", str(plot)]) == 0
    printed = capsys.readouterr().out
    assert "held-out logs, cf2x_L250\n" in printed
    assert "held-out logs, identified\n" in printed
    assert plot.read_bytes().startswith(b"\x89PNG")
    mine, base = load_airframe(out), load_airframe("cf2x_L250")
    for key in ("rpy_coef", "rpy_rates_coef", "cmd_rpy_coef"):
        np.testing.assert_allclose(mine.value(f"fitted.{MODEL}.{key}"), base.value(f"fitted.{MODEL}.{key}"), rtol=0.02)
    assert 'mass = { value = 0.033, unit = "kg", source = "given" }' in out.read_text()
    Sim(drone=out, dynamics=MODEL, control="attitude")


def test_the_true_model_predicts_its_own_flight(flight):
    """Velocities and rates of the log are derivatives over 0.06 s, which leaves errors where predictions start."""
    model = FittedModel.create(load_airframe("cf2x_L250"), MODEL)
    errors = prediction_errors([read_log(flight)], model)
    assert np.all(errors["position"] < 0.03 * errors["position at constant velocity"])
    assert np.all(errors["attitude"] < 0.01 * errors["attitude unchanged"])
    # The mean of a distribution is below its RMSE.
    for name in ("position", "attitude"):
        assert np.all(errors[f"{name} (mean)"] < errors[name])


def test_a_residual_of_a_fitted_model_is_refused(flight, tmp_path, capsys):
    path, out = tmp_path / "flight.npz", tmp_path / "a.toml"
    np.savez(path, **flight)
    assert main(["identify", str(path), "--dynamics", MODEL, "--out", str(out), "--network", "0"]) != 0
    assert "Leave --network out" in capsys.readouterr().err
    assert not out.exists()


def test_logs_without_commands_and_other_models_are_refused(flight, tmp_path, capsys):
    path = tmp_path / "flight.npz"
    np.savez(path, **{key: x for key, x in flight.items() if not key.endswith("command")})
    assert main(["identify", str(path), "--dynamics", "so_rpy", "--out", str(tmp_path / "a.toml")]) != 0
    assert "attitude_command" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="so_rpy_rotor"):
        sys_id_translation("first_principles", 0.03, {})
    with pytest.raises(ConfigError, match="cmd_f"):
        preprocessing({"time": flight["t"]})


def test_outliers_are_interpolated_and_fast_turns_are_not():
    """A circle of 1 m in 1 s, as in Crazyflow's tests of these functions."""
    t = np.linspace(0, 1, 100)
    pos = np.stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t), t], axis=-1)
    data = {"time": t, "quat": np.tile([0.0, 0, 0, 1], (100, 1)), "cmd_rpy": np.zeros((100, 3)), "cmd_f": np.ones(100)}
    np.testing.assert_array_equal(preprocessing(data | {"pos": pos})["pos"], pos)
    spoiled = pos.copy()
    spoiled[40:42] += 1.0
    # The error of a straight line over three intervals of 10 ms at an acceleration of 40 m/s^2.
    np.testing.assert_allclose(preprocessing(data | {"pos": spoiled})["pos"], pos, atol=40 * 0.03**2 / 8)
