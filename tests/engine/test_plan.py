"""Planning a step reports everything that an engine does not support, once, and hides no bug."""

import dataclasses
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import needs_compiler, shared_sim
from waiting import wait_for

from crazysim import ConfigError, Sim
from crazysim.core.pipeline import append_fn, insert_fn_before
from crazysim.engine import Step, explain
from crazysim.engine.backends import lanes, native
from crazysim.engine.lowering import tracing
from crazysim.engine.lowering.jaxprs import RULES
from crazysim.engine.stage import Stage, stage
from crazysim.errors import EngineWarning


@stage("drone")
def sway(data):
    """Push with the sine of the position; no other stage of a pipeline for rotor commands uses ``sin``."""
    return data.replace(states=data.states.replace(force=1e-3 * jnp.sin(data.states.pos)))


@stage("drone")
def roll(data):
    return data.replace(states=data.states.replace(torque=1e-6 * jnp.sin(data.states.ang_vel)))


@pytest.fixture
def sim():
    return shared_sim(n_worlds=3, n_drones=2, control="rotor_vel")


def make_pipeline(sim, *stages):
    return {s.__name__: s for s in stages} | dict(sim.step_pipeline)


def assert_steps_like_plain(sim, step, stages):
    """Assert that a step that fell back to a slower engine computes the same as ``plain``."""
    data = sim.data.replace(states=sim.data.states.replace(pos=sim.data.states.pos + 1.0))
    result, expected = step(data, jnp.int32(3)), Step(make_pipeline(sim, *stages), "plain")(data, jnp.int32(3))
    for name in ("pos", "vel", "force", "torque"):
        np.testing.assert_allclose(getattr(result.states, name), getattr(expected.states, name), rtol=1e-5, atol=1e-7)
    assert float(jnp.abs(result.states.force).max()) > 1e-4


def test_a_stage_without_a_rule_is_named_in_one_warning(sim, monkeypatch):
    monkeypatch.delitem(RULES, "sin")
    step = Step(make_pipeline(sim, sway, roll))
    with pytest.warns(EngineWarning) as caught:
        plan = step.plan(sim.data)
    assert len(caught) == 1
    text = str(caught[0].message)
    for words in ("stage 'sway'", "stage 'roll'", "'sin'", f"JAX {jax.__version__}", "strict=True"):
        assert words in text
    assert plan.engine in ("fused", "lanes")  # the rest of the step stays fast
    assert_steps_like_plain(sim, step, (sway, roll))
    step.plan(sim.data.replace(params=sim.data.params.replace(mass=jnp.full((3, 2, 1), 0.03))))  # no second warning


@pytest.mark.parametrize("rule, words", [
    (lambda r, eqn, args: eqn.params["old_name"], "no parameter 'old_name'"),
    (lambda r, eqn, args: eqn.params["accuracy"] or r.missing, None),
])  # fmt: skip
def test_a_parameter_that_jax_renamed_is_unsupported_and_a_wrong_rule_is_a_bug(sim, monkeypatch, rule, words):
    monkeypatch.setitem(RULES, "sin", rule)
    step = Step(make_pipeline(sim, sway))
    with pytest.warns(EngineWarning, match=words or "This is a bug of crazysim") as caught:
        plan = step.plan(sim.data)
    assert "stage 'sway'" in str(caught[0].message)
    assert (plan.engine == "plain") == (words is None)
    assert_steps_like_plain(sim, step, (sway,))


def test_strict_raises_an_error_for_unsupported_stages(sim, monkeypatch):
    monkeypatch.delitem(RULES, "sin")
    with pytest.raises(ConfigError, match=r"stage 'sway' is not fused: .*'sin'"):
        Step(make_pipeline(sim, sway), strict=True).plan(sim.data)
    strict = Sim(control="rotor_vel", strict=True)
    insert_fn_before(strict.step_pipeline, "integration", sway)
    strict.build_step_fn()
    with pytest.raises(ConfigError, match="'sin'"):
        strict.step()


def raise_error(*args):
    raise ZeroDivisionError("a slip")


@pytest.mark.parametrize("settings", [{"strict": True}, {"engine": "lanes"}])
def test_a_bug_is_raised_if_the_step_is_strict_or_its_engine_is_named(sim, monkeypatch, settings):
    monkeypatch.setitem(RULES, "sin", raise_error)
    with pytest.raises(ZeroDivisionError, match="a slip"):
        Step(make_pipeline(sim, sway), **settings).plan(sim.data)


def test_a_bug_in_tracing_is_found_at_planning(sim, monkeypatch):
    """Planning traces the program, so no error first shows in the first call."""
    monkeypatch.setattr(native, "compiler", lambda: None)
    monkeypatch.setattr(lanes, "run_steps", raise_error)
    with pytest.warns(EngineWarning, match="a slip"):
        assert Step(sim.step_pipeline).plan(sim.data).engine == "plain"


def test_an_error_of_a_stage_is_raised_unchanged(sim):
    """No engine could run the stage, so its error is raised unchanged, without a warning."""

    @stage("drone")
    def mine(data):
        raise KeyError("of the user")

    with pytest.raises(KeyError, match="of the user"):
        Step(make_pipeline(sim, mine)).plan(sim.data)


def test_documented_limits_are_explained_and_warn_of_nothing(sim, monkeypatch):
    """The limits are an undeclared stage, a large swarm, and a machine without a compiler."""

    def everything(data):
        return data.replace(states=data.states.replace(force=0 * data.states.force))

    @stage("world")
    def crowd(data):
        return data.replace(states=data.states.replace(force=0 * data.states.pos))

    swarm = Sim(n_drones=9, control="rotor_vel")
    assert "it is not declared" in explain(Step(make_pipeline(sim, everything)), sim.data)
    assert "drones" in explain(Step(make_pipeline(swarm, crowd)), swarm.data)
    monkeypatch.setattr(native, "compiler", lambda: None)
    for strict in (False, True):
        assert "no C++ compiler" in explain(Step(sim.step_pipeline, strict=strict), sim.data)


# Kernels -------------------------------------------------------------------------------------------------------------


def use_compiler(monkeypatch, folder, script):
    path = folder / "compiler"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    monkeypatch.setattr(native, "compiler", lambda: str(path))


@pytest.mark.parametrize("script, words", [
    ("echo 'error: no such register' >&2; exit 1", "error: no such register"),
    ("exit 0", "left no library"),
    ('while [ "$1" != -o ]; do shift; done 2>/dev/null; echo junk > "$2"; exit 0', "cannot be loaded"),
])  # fmt: skip
def test_a_compiler_that_fails_costs_speed_and_says_so(sim, monkeypatch, tmp_path, script, words):
    monkeypatch.delenv("CXX", raising=False)  # a compiler that is named must accept its options
    use_compiler(monkeypatch, tmp_path, f'case "$*" in *fsyntax-only*) exit 0;; esac; {script}')
    step = Step(make_pipeline(sim, sway))
    with pytest.warns(EngineWarning, match=re.escape(words)) as caught:
        plan = step.plan(sim.data)
    assert plan.engine == "lanes"
    assert words in plan.engine_reason
    assert "sway, " in str(caught[0].message)
    assert_steps_like_plain(sim, step, (sway,))
    with pytest.raises(ConfigError, match=re.escape(words)):
        Step(make_pipeline(sim, sway), strict=True).plan(sim.data)
    with pytest.raises(ConfigError, match=r"engine 'fused' cannot run this pipeline.*Use 'lanes' or 'auto'"):
        Step(make_pipeline(sim, sway), "fused").plan(sim.data)


def test_a_compiler_that_hangs_is_ended(sim, monkeypatch, tmp_path):
    """Its child processes end too, since a compiler runs other programs."""
    child = tmp_path / "pid"
    use_compiler(
        monkeypatch, tmp_path, f'case "$*" in *fsyntax-only*) exit 0;; esac; sleep 1000 & echo $! > {child}; wait'
    )
    monkeypatch.setenv("CRAZYSIM_COMPILE_TIMEOUT", "0.5")
    with pytest.warns(EngineWarning, match="took longer than 0.5 s; set CRAZYSIM_COMPILE_TIMEOUT"):
        assert Step(sim.step_pipeline).plan(sim.data).engine == "lanes"
    wait_for(lambda: not is_running(int(child.read_text())))


def is_running(pid):
    """Return whether a process runs; one that has ended may still be listed."""
    status = Path(f"/proc/{pid}/stat")
    try:
        return status.read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@stage("drone")
def count(data):
    """Add 100 to the counts, which overflow."""
    record = data.plugins["bytes"]
    counts = record.counts + record.counts.dtype.type(100)
    return data.replace(plugins={"bytes": record.replace(counts=counts)})


@needs_compiler
def test_the_kernel_is_compiled_when_the_step_is_planned(sim, monkeypatch):
    seen = []
    monkeypatch.setattr(native, "register_kernel", lambda k, real=native.register_kernel: seen.append(k) or real(k))
    step = Step(make_pipeline(sim, sway))
    plan = step.plan(sim.data)
    assert (plan.engine, len(seen)) == ("fused", 1)
    step(sim.data, jnp.int32(1))
    step(sim.data, 2)
    assert len(seen) == 1


# Explaining ----------------------------------------------------------------------------------------------------------


def undeclared_stage(data):
    return data.replace(states=data.states.replace(torque=1e-6 * jnp.mean(data.states.pos) + 0 * data.states.torque))


def test_explaining_runs_nothing_unless_asked_to_measure():
    sim = Sim(n_worlds=2, control="rotor_vel")
    append_fn(sim.step_pipeline, undeclared_stage)
    step = sim.build_step_fn()
    text = sim.explain()
    assert "'undeclared_stage' is not fused" in text
    assert "cost of the split" not in text
    assert step._cache_size() == 0
    assert "cost of the split, measured: a step takes" in sim.explain(measure=True)
    assert step._cache_size() == 1


@dataclasses.dataclass
class Push:
    force: float

    def __call__(self, data):
        return data.replace(states=data.states.replace(force=self.force + 0 * data.states.pos))


@stage("drone")
def lift(data):
    return data.replace(states=data.states.replace(force=data.states.force + jnp.asarray([0.0, 0.0, 1e-3])))


drop = Stage(lambda data: data.replace(states=data.states.replace(force=0 * data.states.force)), "drone", batched=True)
"""Set the forces to zero, in a stage that accepts leading axes."""


def test_stages_of_the_package_are_traced_once_in_a_process(sim, monkeypatch, tmp_path):
    """One trace serves any number of worlds. Stages of users are traced for every simulation, since they may change."""
    traced = []

    class Counted(tracing.TracedStage):
        def __init__(self, stage, *args):
            traced.append(stage.__name__)
            super().__init__(stage, *args)

    monkeypatch.setattr(tracing, "TracedStage", Counted)
    plans = []
    for n_worlds in (3, 4):
        monkeypatch.setenv("CRAZYSIM_DUMP", str(tmp_path / str(n_worlds)))
        data = shared_sim(n_worlds=n_worlds, n_drones=2, control="rotor_vel").data
        plans.append(Step(make_pipeline(sim, lift) | {"drop": drop}, "lanes").plan(data))
    stages = {name for segment in plans[1].program.segments for name in segment.stages}
    assert {"lift", "drop", "integration", "clip_floor_pos"} <= stages
    assert traced.count("lift") == traced.count("drop") == 2
    assert traced.count("integration") <= 1
    dumps = [{path.name.split("-")[-1] for path in (tmp_path / n).glob("*.jaxpr")} for n in ("3", "4")]
    assert dumps[0] == dumps[1] == {f"{name}.jaxpr" for name in stages}
