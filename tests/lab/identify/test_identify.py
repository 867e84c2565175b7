"""Identification finds the airframe that flew a log, and refuses or repairs bad logs."""

import re
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import rotation
from crazysim.__main__ import main
from crazysim.drones import load_airframe
from crazysim.dynamics import first_principles
from crazysim.errors import ConfigError
from crazysim.lab.identify import (
    Columns,
    errors_table,
    fit_residual,
    identify,
    prediction_errors,
    read_log,
)
from crazysim.lab.identify.readers import Stream, resample
from crazysim.lab.plugins.residual import Residual, residual_inputs, residual_wrench
from crazysim.sim import Sim

FACTORS = {"inertia x": 1.3, "inertia y": 1.2, "thrust factor": 1.05}
"""Parameters of the airframe that flew the logs, as factors of those of cf21B_500."""
DRAG = (-0.03, -0.025, -0.02)
"""Its drag coefficients, N s/m."""
N_FLIGHTS = 6


@pytest.fixture(scope="module")
def flights():
    """Return columns of simulated flights of a drone that differs from cf21B_500, sampled at 250 Hz."""
    base = load_airframe("cf21B_500")
    inertia = np.diag(base.inertia) * [FACTORS["inertia x"], FACTORS["inertia y"], 1]
    curve = base.value("rotors.thrust_curve") * FACTORS["thrust factor"]
    drone = {
        "base": "cf21B_500",
        "rigid_body": {"inertia": inertia.tolist()},
        "rotors": {"thrust_curve": curve.tolist()},
        "drag": {"coefficients": list(DRAG)},
    }
    sim = Sim(n_worlds=N_FLIGHTS, drone=drone, control="attitude", integrator="rk4")
    start_pos = sim.data.states.pos + np.array([0, 0, 20.0], np.float32)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=start_pos))
    rng, rows = np.random.default_rng(0), []
    weight = float(base.value("rigid_body.mass")) * 9.81
    for k in range(600):
        if k % 25 == 0:
            cmd = np.zeros((N_FLIGHTS, 1, 4), np.float32)
            cmd[:, 0, :3] = rng.uniform(-0.5, 0.5, (N_FLIGHTS, 3))
            cmd[:, 0, 3] = weight * rng.uniform(0.9, 1.2, N_FLIGHTS)
        sim.attitude_control(cmd)
        sim.step(2)
        s = sim.data.states
        rows.append(np.concatenate([np.asarray(x)[:, 0] for x in (s.pos, s.quat, s.vel, s.ang_vel, s.rotor_vel)], -1))
    names = "x y z qx qy qz qw vx vy vz wx wy wz rpm1 rpm2 rpm3 rpm4".split()
    table = np.stack(rows[100:], axis=1).astype(np.float64)
    return [{"t": 0.004 * np.arange(len(x)), **dict(zip(names, x.T, strict=True))} for x in table]


@pytest.fixture(scope="module")
def result(flights):
    return identify([read_log(x) for x in flights[:-1]])


def test_identification_finds_the_airframe_of_the_logs(result):
    # Interpolated rotor speeds between samples bias the moments by up to 3%.
    for name, true in FACTORS.items():
        assert abs(result.values[name] - true) < 0.03 * true, name
    # Slow flights tell linear and quadratic drag apart only roughly; their sum at the flights' speed is the drag.
    for axis, true in zip("xyz", DRAG, strict=True):
        drag = result.values[f"drag {axis}"] + result.values[f"quadratic drag {axis}"]
        assert abs(drag - true) < 0.15 * abs(true), axis
    assert max(map(abs, result.delays.values())) < 2e-3
    assert not result.doubtful, result.values


@pytest.mark.long("compiles predictions of flights")
def test_identified_model_predicts_held_out_flights(flights, result):
    errors = prediction_errors([read_log(flights[-1])], result.model)
    assert np.all(errors["position"] < 0.1 * errors["position at constant velocity"])
    for name in ("unchanged", "at constant body rates"):
        assert np.all(errors["attitude"] < 0.1 * errors[f"attitude {name}"])
    assert "attitude, degrees" in errors_table(errors)


def test_the_errors_of_predictions_that_are_off_by_a_known_amount(flights, result, monkeypatch):
    """The root mean square of attitudes is computed from the chord 2 sin(a / 2) of an angle."""
    shift, angle = jnp.array([0.0, 0.3, -0.4]), 0.6
    turn = jnp.array([0.0, np.sin(angle / 2), 0.0, np.cos(angle / 2)])

    def predict(model, batch, dt, constant_rates=False):
        return batch.pos + shift, rotation.multiply(batch.quat, jnp.broadcast_to(turn, batch.quat.shape))

    monkeypatch.setattr("crazysim.lab.identify.prediction._predict_all", predict)
    errors = prediction_errors([read_log(flights[-1])], result.model)
    chord = 2 * np.sin(angle / 2)
    expected = {"position": (0.5, 0.5), "attitude": (np.degrees(chord), np.degrees(angle))}
    for name, (rmse, mean) in expected.items():
        for kind in (name, f"{name} at constant body rates"):
            np.testing.assert_allclose(errors[kind], rmse, rtol=1e-5)
            np.testing.assert_allclose(errors[f"{kind} (mean)"], mean, rtol=1e-5)


@pytest.mark.long("identifies and predicts as the command does")
def test_command_writes_an_airframe(flights, tmp_path, capsys, monkeypatch):
    """The training has a test of its own: here its result is given."""

    def fit(logs, model, **options):
        assert options == {"n_hidden": 4, "iterations": 3}
        linear = model.residual.linear
        hidden = jnp.ones((4, linear.shape[1]))
        return model.replace(residual=Residual(linear, hidden=hidden, output=jnp.full((6, 4), 1e-9), is_bound=True))

    monkeypatch.setattr("crazysim.lab.commands.identify.fit_residual", fit)
    table = {k: x for k, x in flights[0].items() if k != "t"} | {"seconds": flights[0]["t"]}
    # Commands that these speeds follow with a lag of first order of 25 1/s.
    table |= {f"command{k}": table[f"rpm{k}"] + np.gradient(table[f"rpm{k}"], 0.004) / 25 for k in range(1, 5)}
    path, out = tmp_path / "flight.csv", tmp_path / "mine.toml"
    options = ["--network", "4", "--iterations", "3", "--plot", str(tmp_path / "errors.png")]
    np.savetxt(path, np.stack(list(table.values()), -1), delimiter=",", header=",".join(table), comments="")
    status = main(
        ["identify", f"{path}@:2", "--test", f"{path}@0:", "--columns", "time=seconds", "--out", str(out), *options]
    )
    assert status == 0, capsys.readouterr().err
    assert main(["identify", f"{path}@5:6", "--columns", "time=seconds", "--out", str(tmp_path / "other.toml")]) == 2
    printed = capsys.readouterr()
    assert "between 5 and 6 s, got 0" in printed.err
    assert "held-out logs" in printed.out
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")
    # One block of 10 s.
    assert re.search(r"^drag z +-[0-9.]+ \+- unknown N s/m$", printed.out, re.MULTILINE)
    sim = Sim(drone=out, control="rotor_vel")
    sim.add(Residual())
    np.testing.assert_allclose(sim.data.plugins["residual"].output, np.full((6, 4), 1e-9), rtol=1e-3)
    assert load_airframe(out).value("rigid_body.mass") == load_airframe("cf21B_500").value("rigid_body.mass")
    assert re.search(r"^mass = .*source = \"given\"", out.read_text(), re.MULTILINE)
    np.testing.assert_allclose(load_airframe(out).value("rotors.lag"), [25, 0, 25, 0], rtol=0.05)


def scaled(**factors):
    return lambda log: log | {key: x * log[key] for key, x in factors.items()}


def with_order(**columns):
    return lambda log: log | {key: log[other] for key, other in columns.items()}


def without_velocities(log):
    return {key: x for key, x in log.items() if key[0] not in "vw"}


W_FIRST = {"qx": "qw", "qy": "qx", "qz": "qy", "qw": "qz"}
WRONG_LOGS = [
    (lambda x: {k: v for k, v in x.items() if k != "qw"}, "qw"),
    (lambda x: x | {"t": np.round(x["t"], 1)}, "a different time for each sample, got 21 times of 500"),
    (scaled(t=-1), "time increases"),
    (scaled(x=np.nan), "finite pos"),
    (scaled(qx=0, qy=0, qz=0, qw=0), "finite quat that is not zero"),
    (lambda x: x | {"x": x["x"][1:]}, "equal length, got t of 500, x of 499"),
    (lambda x: x | {"rpm1": x["rpm1"][:, None]}, r"one number a sample in column rpm1, got shape \(500, 1\)"),
    (scaled(t=1e3), "in ms: give seconds_per_unit=0.001"),
    (scaled(t=1e6), "in us: give seconds_per_unit=1e-06"),
    (scaled(x=1e3, y=1e3, z=1e3), "position seems to be in mm: give metres_per_unit=0.001"),
    (scaled(vx=1e3, vy=1e3, vz=1e3), "velocity seems to be in mm/s: give speed_per_unit=0.001"),
    (scaled(**dict.fromkeys(("wx", "wy", "wz"), 180 / np.pi)), "degrees per second: give rad_per_unit=0.0174533"),
    (scaled(vx=-1), "velocity fits as vel=-vx,vy,vz"),
    (scaled(wy=-1), "angular velocity fits as ang_vel=wx,-wy,wz, with"),
    (scaled(wx=180 / np.pi, wy=-180 / np.pi, wz=-180 / np.pi), "fits as ang_vel=wx,-wy,-wz and"),
    (scaled(z=-1, vz=-1), "pos=x,y,-z vel=vx,vy,-vz"),
    (scaled(**dict.fromkeys("y z vy vz qy qz wy wz".split(), -1)), "z seems to point down, in world and body"),
    (scaled(qx=-1, qy=-1, qz=-1), "world to body"),
    (with_order(**W_FIRST), "order w, x, y, z"),
    (lambda x: without_velocities(with_order(**W_FIRST)(x)), "order w, x, y, z"),
    (with_order(vx="vy", vy="vx"), "fits as vel=vy,vx,vz"),
    (lambda x: without_velocities(scaled(x=1e3, y=1e3, z=1e3)(x)), "position seems to be in mm"),
]
"""Functions that return columns of a wrong log, and words of the error, which names the remedy."""


@pytest.mark.parametrize(("change", "remedy"), WRONG_LOGS)
def test_wrong_logs_are_refused(flights, change, remedy):
    for flight in flights[:2]:
        with pytest.raises(ConfigError, match=remedy):
            read_log(change(flight))


UNFIT_LOGS = {
    "no rotor speeds": (lambda x: {k: v for k, v in x.items() if k[:3] != "rpm"}, {}, r"4 rotors, got 0\. Name their"),
    "other rotors": (lambda x: x | {"rpm1": x["rpm2"], "rpm2": x["rpm1"]}, {}, r"order \[2, 1, 3, 4\]"),
    "short": (lambda x: {k: v[:60] for k, v in x.items()}, {}, "Use longer logs"),
    "mass": (lambda x: x, {"mass": -0.03}, "expected mass to be positive"),
    "a rotor at rest": (scaled(rpm1=0), {}, "each rotor near"),
    "rad/s": (scaled(**{f"rpm{k}": 2 * np.pi / 60 for k in range(1, 5)}), {}, "rpm_per_unit"),
    "no body": (lambda x: x, {"mass": 0.75}, r"thrust factor 18\.\d, inertia x"),
}  # fmt: skip
"""Functions that return a log of a flight that cannot be fitted, settings, and words of the error."""


@pytest.mark.parametrize(("change", "settings", "message"), UNFIT_LOGS.values(), ids=UNFIT_LOGS)
def test_logs_that_no_airframe_explains_are_refused(flights, change, settings, message):
    with pytest.raises(ConfigError, match=message):
        identify([read_log(change(x)) for x in flights[:2]], **settings)


def test_time_that_goes_back_is_dropped(flights):
    log = {k: np.insert(x, 100, x[50]) for k, x in flights[0].items()}
    read = read_log(log)
    assert np.all(np.diff(read.t) > 0)
    assert "dropped 1 samples" in read.repairs[0]


def test_gaps_are_reported(flights):
    read = read_log({k: np.delete(x, np.arange(200, 230)) for k, x in flights[0].items()})
    assert read.gaps.tolist() == [200]
    assert "1 gap, the longest" in read.repairs[0]


def test_nan_is_interpolated(flights):
    x = flights[0]["x"].copy()
    x[10] = np.nan
    read = read_log(flights[0] | {"x": x})
    np.testing.assert_allclose(read.pos[10, 0], (x[9] + x[11]) / 2)
    assert "not finite" in read.repairs[0]


def test_offset_of_quaternions_is_found(flights):
    moved = flights[0] | {"qw": flights[0]["qw"] + 0.04, "qx": flights[0]["qx"] - 0.01}
    read = read_log(moved)
    np.testing.assert_allclose(read.quat[:, 0], flights[0]["qx"], atol=1e-3)
    assert "subtracted" in read.repairs[0]


def test_lost_values_are_gaps(flights):
    """0.08 s of NaN or of zero quaternions, as when motion capture loses the drone, are a gap; 0.008 s are filled."""
    for names, value in (("x",), np.nan), (("qx", "qy", "qz", "qw"), 0.0):
        log = {k: x.copy() for k, x in flights[0].items()}
        for name in names:
            log[name][[*range(2), 60, *range(200, 220)]] = value
        read = read_log(log)
        assert len(read.t) == len(log["t"]) - 22
        assert read.gaps.tolist() == [198]
        assert [x.split(" of")[0].split(",")[0] for x in read.repairs[:2]] == [
            "interpolated 1 samples",
            "dropped 22 samples",
        ]
        np.testing.assert_allclose(read.quat[58], [flights[0][k][60] for k in ("qx", "qy", "qz", "qw")], atol=1e-3)


def test_jumps_of_the_time_cost_their_samples_alone(flights):
    t = flights[0]["t"].copy()
    t[[0, 150, 300, -1]] = -1e9, 1e6, -5.0, 1e9
    read = read_log(flights[0] | {"t": t})
    assert len(read.t) == len(t) - 4
    assert "dropped 4 samples" in read.repairs[0]
    assert read.gaps.tolist() == [149, 298]  # the remaining intervals of 0.008 s


def test_factors_of_columns_are_applied(flights):
    """These are factors that the errors name."""
    log = {
        k: x * {"t": 1e3, "x": 1e3, "y": 1e3, "z": 1e3, "vx": 10, "vy": 10, "vz": 10}.get(k, 1)
        for k, x in flights[0].items()
    }
    read = read_log(log, Columns(seconds_per_unit=1e-3, metres_per_unit=1e-3, speed_per_unit=0.1))
    for key, name in (("t", "t"), ("pos", "x"), ("vel", "vx")):
        np.testing.assert_allclose(
            np.reshape(getattr(read, key), (len(read.t), -1))[:, 0], flights[0][name], atol=1e-12
        )


def test_columns_that_cannot_be_are_refused(capsys):
    for wrong, message in (
        ({"pos": "px,py,pz"}, "3 names of columns as pos, got 'px,py,pz'"),
        ({"quat": ("a", "b", "c")}, "4 names of columns as quat, got 3. Give x, y, z, w, in this order"),
        ({"rad_per_unit": 0}, "not zero as rad_per_unit, got 0"),
    ):
        with pytest.raises(ConfigError, match=message):
            Columns(**wrong)
    for text, message in (("pos", "got 'pos'"), ("place=a,b,c", "such as pos=px"), ("rad_per_unit=deg", "got 'deg'")):
        assert main(["identify", "log.csv", "--out", "none.toml", "--columns", text]) == 2
        assert message in capsys.readouterr().err


def test_angles_are_read_in_place_of_quaternions(flights):
    log, angles = read_log(flights[0]), [f"angle{k}" for k in range(3)]
    rpy = np.degrees(np.asarray(rotation.to_rpy(jnp.asarray(log.quat)), np.float64)) * [1, -1, 1]
    table = {k: x for k, x in flights[0].items() if k[0] != "q"} | dict(zip(angles, rpy.T, strict=True))
    columns = Columns(rpy=("angle0", "-angle1", "angle2"), rad_per_angle=np.pi / 180)
    # float32 of the conversions.
    np.testing.assert_allclose(np.abs(np.sum(read_log(table, columns).quat * log.quat, axis=-1)), 1, atol=1e-5)
    with pytest.raises(ConfigError, match=r"seem to be rpy=roll,-pitch,yaw, with names of your columns\."):
        read_log(table, replace(columns, rpy=tuple(angles)))
    degrees = table | {k: np.degrees(table[k]) for k in ("wx", "wy", "wz")}
    with pytest.raises(ConfigError, match=r"rpy=roll,-pitch,yaw.* and the angular velocity in degrees per second"):
        read_log(degrees, replace(columns, rpy=tuple(angles)))
    with pytest.raises(ConfigError, match=r"pitch of at most pi/2 rad.* rad_per_angle=0\.0174533"):
        read_log(table, replace(columns, rad_per_angle=1.0))
    with pytest.raises(ConfigError, match="expected columns angle3"):
        read_log(table, replace(columns, rpy=("angle0", "angle1", "angle3")))


def test_angles_that_wrap_are_interpolated_across_the_wrap(flights):
    yaw = np.degrees(np.linspace(0, 20, 500))
    streams = {
        "fast": Stream(0.004 * np.arange(500), {"x": yaw}),
        "slow": Stream(0.02 * np.arange(100), {"yaw": (yaw[::5] + 180) % 360 - 180}),
    }
    table = resample("log", streams, [], Columns(rpy=("r", "p", "-yaw"), rad_per_angle=np.pi / 180))
    np.testing.assert_allclose(table["yaw"], yaw[: len(table["t"])], atol=1e-9)


def concatenate_flights(flights):
    parts = range(3)
    return {k: np.concatenate([flights[i][k] + (2.0 * i if k == "t" else 0) for i in parts]) for k in flights[0]}


def test_time_on_the_ground_is_left_out(flights):
    """Three seconds before a flight of 6 s and two after it, with rotors at 0.3 of their speeds, and a spike."""
    flight, table = concatenate_flights(flights), {}
    for key, x in flight.items():
        rest = {"t": 0.004 * np.arange(1, 751), "qw": np.ones(750)}.get(key, np.zeros(750))
        before, after = (x[0] - rest[::-1], x[-1] + rest) if key == "t" else (rest, rest)
        if key in "xyz" or key.startswith("rpm"):
            before, after = ((0.3 if key not in "xyz" else 1) * x[k] + rest for k in (0, -1))
        table[key] = np.r_[before, x, after[:500]]
    table["rpm1"][100] = 1e6
    log = read_log(table)
    assert (log.t[0], log.t[-1]) == pytest.approx((1.0, 5.0), abs=0.15)  # a second next to the ground is left out, too
    assert "on the ground" in log.repairs[0]
    rotors = {k: (0 * x if k.startswith("rpm") else x) for k, x in table.items()}
    with pytest.raises(ConfigError, match="rotors at rest"):
        read_log(rotors)
    assert len(read_log(flights[0]).t) == 500


def test_a_part_of_a_log_is_read(flights):
    log = read_log(flights[0], between=(0.4, 1.2))
    np.testing.assert_allclose(log.t, flights[0]["t"][100:301])
    with pytest.raises(ConfigError, match=r"between 5 and 6 s, got 0 of a log of 2 s"):
        read_log(flights[0], between=(5.0, 6.0))


def test_drift_at_rest_is_no_wrong_unit(flights):
    """A drone on the ground, whose estimator drifts by centimetres and has another velocity."""
    log = {k: x for k, x in flights[0].items() if k[0] not in "rw"} | dict.fromkeys(("qx", "qy", "qz"), np.zeros(500))
    log |= {
        "qw": np.ones(500),
        "z": np.zeros(500),
        "x": 0.1 * np.sin(log["t"]),
        "vx": 1e3 * log["vx"],
        "y": np.zeros(500),
    }
    with pytest.raises(ConfigError, match=r"spans 0\.1 m: take a log of a flight"):
        read_log(log)


def test_a_gyroscope_that_fails_is_left_out(flights):
    """Of three flights of 2 s in a row, the last one has a roll rate that is wrong by 50 to 200 rad/s."""
    log = concatenate_flights(flights)
    log["wx"][1000:] += np.linspace(50, 200, 500)
    read = read_log(log)
    assert "without an angular velocity that turns the attitude" in read.repairs[0]
    assert read.t[-1] == pytest.approx(log["t"][999], abs=0.2)


def test_csv_files_with_few_faults_are_repaired(flights, tmp_path):
    """A byte order mark, a column of text, an empty cell and a torn last line."""
    rows = [[f"{x:.9g}" for x in row] for row in np.stack(list(flights[0].values()), -1)]
    rows[30][1] = ""
    lines = [",".join(["mode", *flights[0]]), *(",".join(["ANGLE", *row]) for row in rows)]
    lines[-1] = lines[-1][:30]
    (tmp_path / "log.csv").write_text("\ufeff" + "\n".join(lines), encoding="utf-8")
    read = read_log(tmp_path / "log.csv")
    assert len(read.t) == len(rows) - 1
    assert [" ".join(x.split()[:3]) for x in read.repairs] == ["dropped 1 rows", "interpolated 1 samples"]
    with pytest.raises(ConfigError, match="one number a sample in column mode, got ANGLE"):
        read_log(tmp_path / "log.csv", Columns(voltage=("mode",)))


@pytest.mark.long("compiles the gradient of a flight of 0.5 s, and trains")
@pytest.mark.parametrize(
    "n_hidden", [4, pytest.param(0, marks=pytest.mark.slow("with hidden units the linear terms are trained too"))]
)
def test_training_a_residual_finds_a_wrong_thrust(flights, result, n_hidden):
    """Rotor speeds that are 5% too high in the log: the residual takes a tenth of the thrust away."""
    logs = [read_log(x | {f"rpm{k}": 1.05 * x[f"rpm{k}"] for k in range(1, 5)}) for x in flights[:3]]
    steps = {"iterations": 12, "batch_size": 4, "learning_rate": 3e-2}
    trained = fit_residual(logs, result.model, n_hidden=n_hidden, validation=logs[:1], **steps)
    level, rest, p = jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.zeros(3), result.model.params
    inputs = residual_inputs(level, rest, rest, 1.05 * first_principles.hover_rotor_vel(p), p)
    force, _ = residual_wrench(inputs, trained.residual)
    np.testing.assert_allclose(force[2], -0.1 * 9.81 * p.mass[0], rtol=0.4)


@pytest.mark.parametrize("dynamics", ["first_principles", "so_rpy"])
def test_a_log_that_excites_nothing_is_refused(tmp_path, capsys, dynamics):
    n, zero, one = 500, np.zeros(500), np.ones(500)
    names = "x y z qx qy qz qw vx vy vz wx wy wz roll_command pitch_command yaw_command thrust_command".split()
    table = {"t": 0.01 * np.arange(n)} | dict.fromkeys(names, zero) | {"qw": one, "z": one, "thrust_command": 0.4 * one}
    np.savez(tmp_path / "hover.npz", **table, **{f"rpm{k}": 15000 * one for k in range(1, 5)})
    out = tmp_path / "out.toml"
    assert main(["identify", str(tmp_path / "hover.npz"), "--out", str(out), "--dynamics", dynamics]) == 2
    assert "expected a flight that turns about x and y, got body rates whose" in capsys.readouterr().err
    assert not out.exists()
