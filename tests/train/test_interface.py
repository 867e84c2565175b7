"""A policy keeps what it was trained to observe and command, and refuses everything else by name."""

import dataclasses
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from policies import save_steering, steer

from crazysim import ConfigError, envs, train
from crazysim.__main__ import main
from crazysim.envs import Observe, make
from crazysim.envs.statistics import RunningStats
from crazysim.envs.tasks.hover import Hover
from crazysim.lab.export.out_of_tree import to_out_of_tree
from crazysim.lab.live import PolicyPilot
from crazysim.lab.live.link import TrainedPolicy, fly_policy
from crazysim.train import checkpoint
from crazysim.train.export import describe, to_c
from crazysim.train.interface import Interface
from crazysim.train.networks import Policies, Policy, init_mlp
from crazysim.train.task_code import task_digest
from crazysim.train.training import POLICY_FILE, load_policy


@pytest.fixture(scope="module")
def env():
    return make("hover", 2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return save_steering(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def loaded(folder):
    return load_policy(folder)


SETTINGS = {"level": "body_rate", "freq": 100, "task": "recover"}
"""Another value of each setting that has to be the training's."""


@st.composite
def changes(draw):
    """Draw sizes of observations, changed ones, changed settings, and what the error has to name."""
    names = draw(st.lists(st.sampled_from("abcdefgh"), min_size=2, max_size=5, unique=True))
    sizes = {name: draw(st.integers(1, 4)) for name in sorted(names)}
    changed, named = dict(sizes), []
    kind = draw(st.sampled_from(["rename", "swap", "merge", "split", "missing", "extra", "reorder"]))
    first, second = draw(st.permutations(sorted(names)))[:2]
    if kind == "rename":
        changed["z" + first] = changed.pop(first)
        named = [f"no {first} ", f"z{first} "]
    elif kind == "swap" and sizes[first] != sizes[second]:
        changed[first], changed[second] = sizes[second], sizes[first]
        named = [f"{first} {sizes[second]} in place of {sizes[first]}", f"{second} {sizes[first]} in place of"]
    elif kind == "merge":
        changed[first + second] = changed.pop(first) + changed.pop(second)
        named = [f"no {first} ", f"no {second} ", f"{first}{second} "]
    elif kind == "split" and sizes[first] > 1:
        changed |= {first: 1, "z": sizes[first] - 1}
        named = [f"{first} 1 in place of {sizes[first]}", "z "]
    elif kind == "missing":
        del changed[first]
        named = [f"no {first} "]
    elif kind == "extra":
        changed["z"] = 2
        named = ["z 2 in addition"]
    settings = draw(st.sets(st.sampled_from(sorted(SETTINGS))))
    order = draw(st.permutations(list(changed)))
    return sizes, {name: changed[name] for name in order}, {name: SETTINGS[name] for name in settings}, named


@given(changes(), st.integers(0, 2**31))
def test_a_policy_takes_its_own_observations_in_any_order_and_no_others(change, seed):
    """Of any names, also if their numbers are as many; for its own ones, the action is that without the check."""
    sizes, changed, settings, named = change
    rng, n = np.random.default_rng(seed), sum(sizes.values())
    interface = Interface(tuple(sizes.items()), (), "attitude", ((0.0, 1.0),) * 4, 50, "hover", "code")
    policy = Policy(RunningStats.create(n), init_mlp(jax.random.key(0), (n, 4), 1.0))
    checked = policy.replace(interface=interface)
    obs = {name: rng.normal(size=(3, k)).astype(np.float32) for name, k in changed.items()}
    if named:
        with pytest.raises(ConfigError) as error:
            checked(obs)
        assert all(text in str(error.value) for text in named)
        with pytest.raises(ConfigError):
            Policies(jax.tree.map(lambda x: x[None], checked))({name: x[:, None] for name, x in obs.items()})
    else:
        np.testing.assert_array_equal(checked(obs), policy(obs))
    other = dataclasses.replace(interface, observations=tuple(sorted(changed.items())), **settings)
    if named or settings:
        with pytest.raises(ConfigError) as error:
            interface.require(other, "an environment")
        mentioned = [*named, *(f"{SETTINGS[name]}" for name in settings)]
        assert all(text in str(error.value) for text in mentioned)
    else:
        interface.require(other, "an environment")


def without_vel(obs, _):
    return {name: x for name, x in obs.items() if name != "vel"}


@pytest.mark.parametrize(
    ("other", "difference"),
    [
        (lambda: make("hover", 2, control="body_rate"), "body_rate commands in place of attitude commands"),
        (lambda: make("hover", 2, freq=100), "100 Hz in place of 50 Hz"),
        (lambda: make("recover", 2), "task 'recover' in place of task 'hover'"),
        (lambda: Observe(make("hover", 2), without_vel), "no vel 3"),
        (lambda: Observe(make("hover", 2), lambda obs, _: obs | {"wind": obs["vel"]}), "wind 3 in addition"),
        (lambda: Observe(make("hover", 2), lambda obs, _: {"vector": envs.flatten(obs)}), "no ang_vel 3, .*vector 21"),
    ],
    ids=["level", "rate", "task", "missing", "extra", "merged"],
)
def test_evaluations_films_plots_and_live_flights_refuse_other_environments(loaded, tmp_path, other, difference):
    policy, other_env = loaded[0], other()
    for use in (
        lambda: train.evaluate(other_env, policy),
        lambda: train.film(other_env, policy, tmp_path / "film.gif"),
        lambda: train.plot_episode(other_env, policy, tmp_path / "plot.png"),
        lambda: PolicyPilot(other_env, policy),
        lambda: to_c(policy, tmp_path / "policy.h", describe(other_env)),
        lambda: TrainedPolicy(policy, describe(other_env)),
    ):
        with pytest.raises(ConfigError, match=difference):
            use()
    assert not list(tmp_path.iterdir())


def test_a_policy_flies_its_task_a_derived_one_and_functions_fly_any(env, loaded):
    policy, config, meta = loaded
    assert policy.interface == Interface.read(meta) == Interface.read(describe(config.make_env(2)))
    state = env.reset(jax.random.key(0))
    np.testing.assert_array_equal(policy(state.obs), policy.replace(interface=None)(state.obs))

    class Derived(Hover):
        """Hover under another name; its code is longer."""

        name = "derived"

    with pytest.warns(UserWarning, match="the code of the task differs"):
        PolicyPilot(make(Derived()), policy)
    with pytest.warns(UserWarning, match="other ranges .*another drone"):
        PolicyPilot(make("hover", drone="cf2x_L250"), policy)
    PolicyPilot(make("recover"), steer)


def test_flights_at_another_rate_or_level_are_refused(env, loaded, tmp_path):
    policy, _, meta = loaded
    pilot = PolicyPilot(env, policy)
    with pytest.raises(ConfigError, match="loop at the rate of the environment, 50 Hz, got 100 Hz"):
        pilot.add_to(SimpleNamespace(control_freq=100))
    link = SimpleNamespace()
    for settings, text in (
        ({"freq": 100}, "at 100 Hz"),
        ({"freq": 50, "level": "body_rate"}, "got body_rate commands"),
    ):
        with pytest.raises(ConfigError, match=text):
            fly_policy(link, TrainedPolicy(policy, meta), 1.0, **settings)
    with pytest.raises(ConfigError, match="rate of the training, 50 Hz, got 100 Hz"):
        to_out_of_tree(policy, tmp_path, meta, env.sim.airframes[0], 100)


TASK = '''"""A task in a file."""
from dataclasses import dataclass
from crazysim.envs.tasks.hover import Hover

UNIT = 1.0  # m/s

def scaled(x):
    """Return velocities in the unit."""
    return UNIT * x

class Mine(Hover):
    """Hover."""

    name = "mine"

    def observe(self, data):
        obs = super().observe(data)
        return obs | {"vel": scaled(obs["vel"])}
'''


@pytest.mark.parametrize(
    ("old", "new", "is_other"),
    [
        ("# m/s", "# metres per second", False),
        ("Return velocities in the unit.", "Velocities.", False),
        ("    return UNIT * x", "    return (UNIT *\n        x)", False),
        ("UNIT = 1.0", "UNIT = 100.0", True),
        ("UNIT * x", "UNIT * x + 1.0", True),
        ('scaled(obs["vel"])', 'obs["vel"]', True),
    ],
)
def test_the_hash_of_a_task_follows_what_its_observations_use(tmp_path, old, new, is_other):
    digests = []
    for i, text in enumerate((TASK, TASK.replace(old, new))):
        path = tmp_path / f"{i}.py"
        path.write_text(text)
        digests.append(task_digest(type(make(f"{path}:Mine").task)))
    assert None not in digests
    assert (digests[0] != digests[1]) == is_other
    assert task_digest(Hover) != task_digest(type(make("recover").task))


def rewrite(folder, source, **changes):
    """Copy a policy to a folder with a changed description; None removes an entry."""
    arrays, meta = checkpoint.read(source / POLICY_FILE)
    meta = {name: x for name, x in (meta | changes).items() if x is not None}
    np.savez(folder / POLICY_FILE, meta=np.array(json.dumps(meta)), **arrays)
    return folder


def test_changed_code_and_unknown_code_are_said_in_one_line(folder, env, loaded, tmp_path):
    changed, _, _ = load_policy(rewrite(tmp_path, folder, task_code="0" * 64))
    with pytest.warns(UserWarning, match="the code of the task differs .* other units or contents"):
        PolicyPilot(env, changed)
    old, _, _ = load_policy(rewrite(tmp_path, folder, task_code=None, task=None))
    PolicyPilot(env, old)
    obs = env.reset(jax.random.key(0)).obs
    np.testing.assert_array_equal(old(obs), loaded[0](obs))
    with pytest.raises(ConfigError, match="no vel 3"):
        old({name: x for name, x in obs.items() if name != "vel"})


def test_exports_say_task_and_rate(loaded, tmp_path):
    policy, _, meta = loaded
    assert "Policy of the task hover, 50 actions per second." in to_c(policy, tmp_path / "policy.h", meta).read_text()
    onnx = pytest.importorskip("onnx")
    from crazysim.train.export import to_onnx

    model = onnx.load(to_onnx(policy, tmp_path / "policy.onnx", meta))
    properties = {entry.key: entry.value for entry in model.metadata_props}
    assert (properties["task"], properties["freq"]) == ("hover", "50")
    assert properties["task_code"] == meta["task_code"]


WITHOUT = """
def without(obs):
    return {name: x for name, x in obs.items() if name != "vel"}
"""


@pytest.mark.long("trains")
def test_a_trained_policy_and_its_checkpoint_keep_the_interface(tmp_path):
    """A run whose task has other observations since, of as many numbers, is not resumed."""
    path, settings = tmp_path / "mine.py", {"log": lambda _: None, "evaluation_worlds": 4, "film": False}
    settings |= {"n_worlds": 4, "options": {"seconds": 0.2}, "progress": False}
    path.write_text(TASK)
    config = {"iterations": 1, "n_steps": 2, "minibatches": 1, "epochs": 1, "hidden": (4,)}
    result = train.run(f"{path}:Mine", tmp_path / "run", config=config, **settings)
    policy, loaded_config, _ = load_policy(tmp_path / "run")
    assert result.policy.interface == policy.interface
    assert (policy.interface.task, policy.interface.freq) == ("mine", 50)
    policy.interface.require(Interface.read(describe(loaded_config.make_env(4))), "the environment of the run")
    assert train.evaluate(result.env, policy) == train.evaluate(result.env, result.policy)
    path.write_text(TASK.replace('obs | {"vel"', 'without(obs) | {"velocity"') + WITHOUT)
    with pytest.raises(ConfigError, match=r"arrays of this task .*'vel'.*'velocity'"):
        train.run(f"{path}:Mine", tmp_path / "run", config=config | {"iterations": 2}, resume=True, **settings)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env, policy: load_policy(5), "path of a file or folder, got 5. Use"),
        (lambda env, policy: train.run("hover", 5), "path of a file or folder, got 5. Use"),
        (lambda env, policy: train.run_many("hover", 5.0), "path of a file or folder, got 5.0. Use"),
        (lambda env, policy: train.evaluate(env, None), "policy, got None. Use .* load_policy"),
        (lambda env, policy: train.evaluate(5, policy), r"Env, got 5. Use .*make\('hover'"),
        (lambda env, policy: train.evaluate(env, policy, "key"), "random key, got 'key'. Use"),
        (lambda env, policy: train.film(env, "out/hover", "film.gif"), "policy, got 'out/hover'"),
        (lambda env, policy: train.plot_episode(env, None, "plot.png"), "policy, got None"),
        (lambda env, policy: train.plot_episode(env, policy, "p.png", 5), "random key, got 5. Use"),
        (lambda env, policy: train.plot_episode(env, policy, 5), "path of a file or folder, got 5"),
        (lambda env, policy: PolicyPilot(env, None), "policy, got None"),
        *(
            (lambda env, policy, obs=obs: policy(obs), "observations as a dict of arrays .*, got .*Use state.obs")
            for obs in (None, jnp.zeros((2, 1, 21)), {"pos": 1.0})
        ),
        (lambda env, policy: policy.replace(interface=None)({"pos": np.zeros(3)}), "observations of 21 numb"),
        (lambda env, policy: policy.act(env.reset(jax.random.key(0)).obs, 5), "memory of shapes .*, got 5"),
        (lambda env, policy: to_c(None, "p.h", describe(env)), "Policy, got None. Use the first"),
        (lambda env, policy: to_c(policy, 5, describe(env)), "path of a file or folder, got 5"),
        (lambda env, policy: to_c(policy, "p.h", None), "description of a policy, got None. Use"),
        (lambda env, policy: to_c(policy, "p.h", {"observations": {"pos": 3}}), "description of a policy"),
        (lambda env, policy: to_c(policy, "p.h", describe(env), 5), "name of a C function, got 5"),
        (lambda env, policy: TrainedPolicy(policy, None), "description of a policy, got None. Use"),
        (lambda env, policy: TrainedPolicy(policy, describe(env), "up"), "goal .*got 'up'. Use"),
        (lambda env, policy: to_out_of_tree(None, "x", describe(env), None, 50), "Policy, got None. Use"),
        (lambda env, policy: to_out_of_tree(policy, "x", describe(env), None, 50), "Airframe, got None. Use"),
        (lambda env, policy: to_out_of_tree(policy, 5, describe(env), env.sim.airframes[0], 50), "path"),
        (lambda env, policy: describe(None), "Env, got None. Use"),
        (lambda env, policy: train.TrainConfig.create("hover", []), r"algorithm of .*, got \[\]"),
        (lambda env, policy: train.imitate(env, steer, seed=1.5), "integer as seed, got 1.5. Use"),
        (lambda env, policy: train.imitate(env, steer, observe=5), "observe as a function or None, got 5"),
        (lambda env, policy: train.imitate(env, steer, on_iteration=5), "on_iteration as a function or None"),
        (lambda env, policy: train.imitate(env, steer, {"minibatches": 1}, observe=lambda data: 5), "observations"),
    ],
)
def test_wrong_arguments_are_errors_with_a_remedy(env, loaded, call, message):
    with pytest.raises(ConfigError, match=message):
        call(env, loaded[0])


def test_the_export_command_says_what_is_wrong(folder, tmp_path, capsys):
    (tmp_path / "file").touch()
    for arguments in (
        [str(tmp_path / "none"), "--c", str(tmp_path / "p.h")],
        [str(tmp_path), "--c", str(tmp_path / "p.h")],
        [str(folder), "--c", str(tmp_path / "none" / "p.h")],
        [str(folder), "--c", str(tmp_path)],
        [str(folder), "--out-of-tree", str(tmp_path / "none")],
        [str(folder), "--out-of-tree", str(tmp_path / "file")],
        [str(folder), "--c", ""],
    ):
        assert main(["export", *arguments]) == 2
        message = capsys.readouterr().err
        assert "expected " in message
        assert ", got " in message
