"""TensorFlow Lite files, read by the interpreter of microcontrollers, which PX4's mc_nn_control runs."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from policies import save_steering

from crazysim import ConfigError, Sim, rotation
from crazysim.__main__ import main
from crazysim.envs import make
from crazysim.train.export import to_mc_nn_control, to_tflite


@pytest.fixture(scope="module")
def layers():
    rng = np.random.default_rng(0)
    pairs = itertools.pairwise((15, 64, 32, 4))
    return [(rng.normal(size=(n, m)) / np.sqrt(n), rng.normal(size=m)) for n, m in pairs]


def test_the_interpreter_computes_the_network_in_the_memory_of_mc_nn_control(tmp_path, layers):
    runtime = pytest.importorskip("tflite_micro.python.tflite_micro.runtime")
    path = to_tflite(layers, tmp_path / "control_net.tflite")
    interpreter = runtime.Interpreter.from_file(str(path), arena_size=10 * 1024)
    x = np.random.default_rng(1).normal(size=(50, 15)).astype(np.float32)
    outputs = []
    for row in x:
        interpreter.set_input(row[None], 0)
        interpreter.invoke()
        outputs.append(interpreter.get_output(0)[0])
    for weight, bias in layers[:-1]:
        x = np.maximum(x @ weight + bias, 0)
    np.testing.assert_allclose(outputs, x @ layers[-1][0] + layers[-1][1], atol=1e-5)


def test_a_file_has_dense_layers_only_and_aligned_weights(tmp_path, layers):
    schema = pytest.importorskip("tflite_micro.tensorflow.lite.micro.python.schema_py_generated")
    content = to_tflite(layers, tmp_path / "control_net.tflite").read_bytes()
    assert content[4:8] == b"TFL3"
    model = schema.Model.GetRootAsModel(content, 0)
    graph = model.Subgraphs(0)
    assert (model.Version(), model.SubgraphsLength(), model.OperatorCodesLength()) == (3, 1, 1)
    assert model.OperatorCodes(0).BuiltinCode() == schema.BuiltinOperator.FULLY_CONNECTED
    assert (graph.Inputs(0), graph.Outputs(0)) == (0, graph.TensorsLength() - 1)
    assert [graph.Tensors(i).ShapeAsNumpy().tolist() for i in (0, graph.TensorsLength() - 1)] == [[1, 15], [1, 4]]
    for weight, bias in layers:
        for x in (weight.T, bias):
            assert content.index(x.astype("<f4").tobytes()) % 16 == 0


def test_layers_that_do_not_fit_and_nan_are_refused(tmp_path, layers):
    with pytest.raises(ConfigError, match="that fit one another"):
        to_tflite([layers[0], layers[2]], tmp_path / "net.tflite")
    with pytest.raises(ConfigError, match="train again"):
        to_tflite([(np.full((15, 4), np.nan), np.zeros(4))], tmp_path / "net.tflite")


def hold_goal(env):
    """Return a controller of rotor speeds, which turns the heading to zero."""
    x, y, _ = np.sign(env.sim.airframe.value("rotors.position")).T
    yaw = env.sim.airframe.value("rotors.yaw_torque_sign")

    def act(obs):
        rot, ang_vel = obs["rot"].reshape(*obs["rot"].shape[:-1], 3, 3), obs["ang_vel"]
        acc = jnp.clip(2 * obs["difference_to_goal"], -2, 2) - 2 * obs["vel"]
        ahead, left, _ = jnp.moveaxis(jnp.einsum("...ij,...i->...j", rot, acc), -1, 0)
        roll = -0.8 * (0.1 * left + rot[..., 2, 1]) - 0.08 * ang_vel[..., 0]
        pitch = 0.8 * (0.1 * ahead + rot[..., 2, 0]) - 0.08 * ang_vel[..., 1]
        turn = -0.3 * jnp.arctan2(rot[..., 1, 0], rot[..., 0, 0]) - 0.15 * ang_vel[..., 2]
        up, roll, pitch, turn = (v[..., None] for v in (0.15 * acc[..., 2], roll, pitch, turn))
        return jnp.clip(up + y * roll - x * pitch + yaw * turn, -1, 1)

    return act


@pytest.mark.long("trains a student")
def test_a_distilled_policy_flies_from_its_file_with_the_inputs_and_outputs_of_mc_nn_control(tmp_path):
    runtime = pytest.importorskip("tflite_micro.python.tflite_micro.runtime")
    env, path = make("hover", 64, control="rotor_vel", freq=100), tmp_path / "control_net.tflite"
    _, parameters = to_mc_nn_control(hold_goal(env), env, path, iterations=100)
    interpreter, sim = runtime.Interpreter.from_file(str(path), arena_size=10 * 1024), Sim(control="rotor_vel")
    quadrants = [tuple(x > 0) for x in sim.airframe.value("rotors.position")[:, :2]]
    order = [quadrants.index(x) for x in ((True, False), (False, True), (True, True), (False, False))]
    goal, rotor_vel = np.array([0.5, -0.8, 1.3]), np.zeros((1, 1, 4))
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos + np.float32([0, 0, 1])))
    for _ in range(600):
        pos, quat, vel, ang_vel = (np.array(x)[0, 0] for x in (states.pos, states.quat, states.vel, states.ang_vel))
        inputs = np.concatenate([goal - pos, np.asarray(rotation.matrix(quat))[:2].ravel(), vel, ang_vel])
        interpreter.set_input(inputs[None].astype(np.float32), 0)
        interpreter.invoke()
        thrust = np.clip(interpreter.get_output(0)[0], -1, 1) + 1
        rotor_vel[..., order] = 60 * np.sqrt(thrust / (parameters["MC_NN_THRST_COEF"] / 1e5))
        sim.rotor_vel_control(rotor_vel)
        sim.step(sim.freq // 100)
        states = sim.data.states
    np.testing.assert_allclose(states.pos[0, 0], goal, atol=0.1)  # a student has no integral
    assert np.max(rotor_vel) <= parameters["MC_NN_MAX_RPM"] * (1 + 1e-4)


def test_policies_that_command_no_rotors_are_not_distilled(tmp_path):
    with pytest.raises(ConfigError, match="got one of level attitude"):
        to_mc_nn_control(lambda obs: obs["pos"], make("hover", 4), tmp_path / "net.tflite")
    with pytest.raises(ConfigError, match="got no difference_to_goal"):
        to_mc_nn_control(lambda obs: obs["pos"], make("reach_vel", 4, control="rotor_vel"), tmp_path / "net.tflite")


@pytest.mark.long("distils and evaluates a policy")
def test_the_command_distils_a_run_and_prints_the_parameters_of_the_file(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("crazysim.commands.training.DISTILLATION_WORLDS", 4)
    folder, path = save_steering(tmp_path, control="rotor_vel"), tmp_path / "control_net.tflite"
    assert main(["export", str(folder), "--tflite", str(path)]) == 0
    *_, student, parameters, written = capsys.readouterr().out.splitlines()
    assert student.startswith("student: success ")
    # The largest speed of cf21B_500 is 21,661 rpm, at which the coefficient 2e5 (60 / 21,661)^2 is a thrust of 2.
    assert parameters.endswith("MC_NN_THRST_COEF 1.5346, MC_NN_MAX_RPM 21661, MC_NN_MIN_RPM 0, THR_MDL_FAC 0.8")
    assert written == f"wrote {path}"
    assert path.read_bytes()[4:8] == b"TFL3"
    assert main(["export", "any", "--tflite", str(path)]) == 2
    assert "got --tflite" in " ".join(capsys.readouterr().err.split())
