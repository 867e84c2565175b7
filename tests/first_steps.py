"""First steps of a simulation in Python: many flights of tests are over sooner than a kernel is compiled.

Where the compiler is not the subject, simulations plan for the fused engine as ever, which refuses what has no kernel.
Their steps are interpreted until they have taken as long as compiling does, or one is traced: what XLA calls from then
on is a kernel of ``late_kernels``. Steps on several devices, steps with stages that are not fused, and engines chosen
by name do not begin so.
"""

import threading

import jax
import late_kernels
import numpy as np
import python_steps

from crazysim.engine import Step, fused, kernel, plan
from crazysim.jaxcompat import is_key

_planning = threading.local()


def install():
    """Let simulations that are planned while kernels may be late take their first steps in Python."""
    fused.build, plan.Planner._fast, Step._cache_size = build, fast, cache_size


BUILD, FAST, CACHE_SIZE = fused.build, plan.Planner._fast, Step._cache_size


def fast(planner, data, zeros):
    """Return what ``Planner._fast`` does; a plan of kernels begins in Python, and has not compiled them."""
    if planner.engine != "auto":
        with late_kernels.chosen_by_name():
            return FAST(planner, data, zeros)
    if not late_kernels.active:
        return FAST(planner, data, zeros)
    _planning.runs = runs = []
    try:
        made, problems = FAST(planner, data, zeros)
    finally:
        _planning.runs = None
    if made.engine == "fused" and runs and all(isinstance(run, Run) for run in runs) and not made.location.spread:
        made = made._replace(direct=FirstSteps(made, runs))
    return made, problems


def build(program, platform, devices=None):
    """Return what ``fused.build`` does; for a step that begins on the interpreter, a function that compiles later."""
    runs = getattr(_planning, "runs", None)
    if runs is None:
        return BUILD(program, platform, devices)
    run = Run(program, platform, devices) if platform == "cpu" and program.fused else BUILD(program, platform, devices)
    runs.append(run)
    return run


def cache_size(step):
    """Return what ``Step._cache_size`` does; a test that counts compilations must have some."""
    if late_kernels.active and any(isinstance(made.direct, FirstSteps) for made in step._plans.values()):
        raise RuntimeError("a test that counts compilations was not marked; mark it with pytest.mark.compiled")
    return CACHE_SIZE(step)


class Run:
    """Steps of a program: interpreted where nothing is traced, and a kernel that the first trace compiles."""

    def __init__(self, program, *target):
        """Take the arguments of ``fused.build``, and refuse what has no source."""
        kernel.write(program, "host")
        self.program, self.target, self.kernel = program, target, None

    def __call__(self, leaves, n_steps):
        """Return the written leaves after some steps, and the worlds that are flagged."""
        if not any(isinstance(x, jax.core.Tracer) for x in (n_steps, *leaves)):
            return self._interpreted(leaves, int(n_steps))
        self.kernel = self.kernel or BUILD(self.program, *self.target)
        return self.kernel(leaves, n_steps)

    def _interpreted(self, leaves, n_steps):
        numbers = [x if x is None else np.asarray(jax.random.key_data(x) if is_key(x) else x) for x in leaves]
        out, flagged = python_steps.steps(self.program, numbers, n_steps)
        keys = [is_key(self.program.leaves[i]) for i in self.program.written]
        return [jax.random.wrap_key_data(x) if key else x for x, key in zip(out, keys, strict=True)], flagged


class FirstSteps:
    """Steps outside of traces: interpreted as long as there are few of them."""

    def __init__(self, made, runs):
        """Take a plan, and the steps of its programs."""
        self.n_worlds = next(leaf.shape[0] for leaf in made.program.leaves if leaf.scope == "drone")
        self.plan, self.runs, self.interpreted = made, runs, plan._on_host(made.dynamic.__wrapped__)
        self.left = sum(map(python_steps.budget, made.programs))

    def __call__(self, values, n_steps):
        """Return the values after some steps."""
        programs = self.plan.programs
        self.left -= sum(python_steps.cost(p, self.n_worlds * p.n_drones, int(n_steps)) for p in programs)
        if late_kernels.active and self.left >= 0 and not any(run.kernel for run in self.runs):
            return self.interpreted(values, n_steps)
        compiled = self.plan.static if isinstance(n_steps, int) else self.plan.dynamic
        return compiled(values, n_steps)
