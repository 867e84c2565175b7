"""First steps of a simulation on the interpreter: many flights of tests are over sooner than a kernel is compiled.

Where the compiler is not the subject, simulations plan for the fused engine as ever, which refuses what has no kernel.
Their steps are interpreted until they have taken as long as compiling does, or one is traced. From then on the kernel
takes all of them. Steps on several devices, steps with stages that are not fused, and engines chosen by name are left
alone.
"""

import threading

import jax

from crazysim.engine import Step, fused, interpret, kernel, plan

BUDGET = 250
"""Operations that are interpreted in half the time in which g++ and XLA compile one."""
CALL = 500
"""Operations that take as long as a call does besides its steps."""
LANES = 5000
"""Drones in all worlds that double the time of an operation."""
ITERATIONS = {"loop": "length", "over_others": "n_members"}
"""Operations that repeat their block, and the parameter that says how often."""
WHILE = 10
"""Iterations of a loop that ends by a condition, as a guess."""

active = False
"""True while a test runs whose subject is not the compiler."""
_planning = threading.local()


def install():
    """Let simulations that are planned while ``active`` take their first steps on the interpreter."""
    fused.build, plan.Planner._fast, Step._cache_size = build, fast, cache_size


BUILD, FAST, CACHE_SIZE = fused.build, plan.Planner._fast, Step._cache_size


def fast(planner, data, zeros):
    """Return what ``Planner._fast`` does; a plan of kernels begins on the interpreter, and has not compiled them."""
    if not (active and planner.engine == "auto"):
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
    if active and any(isinstance(made.direct, FirstSteps) for made in step._plans.values()):
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
            return interpret.steps(self.program, leaves, n_steps)
        self.kernel = self.kernel or BUILD(self.program, *self.target)
        return self.kernel(leaves, n_steps)


class FirstSteps:
    """Steps outside of traces: on the interpreter as long as there are few of them."""

    def __init__(self, made, runs):
        """Take a plan, and the steps of its programs."""
        blocks = [segment.block for program in made.programs for segment in program.fused_segments]
        n_worlds = next(leaf.shape[0] for leaf in made.program.leaves if leaf.scope == "drone")
        slower = 1 + n_worlds * made.program.n_drones / LANES
        self.plan, self.runs, self.interpreted = made, runs, plan._on_host(made.dynamic.__wrapped__)
        self.per_step = slower * sum(n_operations(block, repeated=True) for block in blocks)
        self.left = BUDGET * sum(n_operations(block, repeated=False) for block in blocks)

    def __call__(self, values, n_steps):
        """Return the values after some steps."""
        self.left -= CALL + int(n_steps) * self.per_step
        if active and self.left >= 0 and not any(run.kernel for run in self.runs):
            return self.interpreted(values, n_steps)
        compiled = self.plan.static if isinstance(n_steps, int) else self.plan.dynamic
        return compiled(values, n_steps)


def n_operations(block, repeated):
    """Return the number of operations of a block: as they are written, or as often as they are executed."""

    def inner(op):
        times = WHILE if op.name == "while" else op.param(ITERATIONS[op.name]) if op.name in ITERATIONS else 1
        return (times if repeated else 1) * sum(n_operations(b, repeated) for b in op.blocks)

    return sum(1 + inner(op) for op in block.operations)
