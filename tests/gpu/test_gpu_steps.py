"""Steps, their laws and queries on an accelerator, compared with the CPU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import INTEGRATORS, PAIRS, send, trees_equal, with_states
from on_devices import ACCELERATOR, LOADS, NAMES, agree, flying, on

from crazysim import (
    Battery,
    Bicycles,
    Cars,
    ContactLog,
    ContactResponse,
    Downwash,
    DroneCollisions,
    Follow,
    FreeBodies,
    GroundEffect,
    Hook,
    Kalman,
    Latency,
    MotorFailure,
    Radar,
    RangeFinder,
    RotorJet,
    SharedLoad,
    Sim,
    SlungLoad,
    Terrain,
    Wind,
    WindField,
)
from crazysim.plugins import vehicles
from crazysim.plugins.effects import Grid
from crazysim.trajectories import figure_eight

N_STEPS = 100
ROUNDING = 1e-4
"""Tolerance after 100 steps in float32: some 1,000 roundings of 1e-7, since errors in the speeds of rotors and in
angular velocities add up in attitudes and positions. Two engines of the CPU differ by 2e-5 at most."""

STEPS = [
    {"dynamics": dynamics, "control": control, "integrator": INTEGRATORS[i % 3]}
    for i, (dynamics, control) in enumerate(PAIRS)
]
STEPS += [{"control": "attitude", "integrator": integrator} for integrator in INTEGRATORS]
STEPS += [{"control": "state", "controller": name} for name in ("pid", "mellinger", "geometric", "indi", "lqr")]
"""Every dynamics and command level, every integrator, and controllers."""


def both(run):
    """Check that a function of a device returns arrays on that device, and the same on both."""
    expected, found = (on(name, run(name)) for name in NAMES)
    return found, expected


@pytest.mark.parametrize("settings", STEPS, ids=lambda s: "-".join(s.values()))
def test_steps_are_those_of_the_cpu(settings):
    def run(device):
        sim = flying(device, **settings)
        assert sim.explain().startswith("engine: fused\n")
        sim.step(N_STEPS)
        return sim.data

    agree(*both(run), ROUNDING)


@pytest.mark.parametrize("engine", ["fused", "lanes", "plain"])
@pytest.mark.parametrize("n_drones", [3, 33, 256])
def test_drones_that_act_on_each_other_fly_as_on_the_cpu(n_drones, engine):
    """Kernels exchange numbers within a warp, and within a block with fewer or all of its threads in use."""

    def run(device):
        sim = flying(device, 4, n_drones, [Downwash()], control="attitude", engine=engine)
        sim.step(20)
        return sim.data

    agree(*both(run), ROUNDING)


def test_steps_in_float64_are_those_of_the_cpu(x64):
    def run(device):
        sim = flying(device, control="state")
        sim.step(N_STEPS)
        return sim.data

    agree(*both(run), 1e-12)


hills = 0.5 * (1 + np.sin(np.arange(41) / 6)[:, None] * np.cos(np.arange(41) / 5))
field = Grid(np.arange(54).reshape(3, 3, 2, 3) % 7 - 3.0, (-1.0, -1.0, 0.0), (1.0, 1.0, 4.0))
PLUGINS = {
    "effects": (
        {"control": "attitude"},
        lambda: [
            Battery(0.25, 0.1),
            Downwash(),
            GroundEffect(),
            Latency(2),
            MotorFailure(0.9, rate=0.5),
            Wind((2.0, 1.0, 0.0), speed_20ft=7.7, roughness=0.05),
            WindField(field, spread=(0.5, 0.5, 0.0)),
        ],
    ),
    "follow": ({"control": "state"}, lambda: [Follow([figure_eight(2.0, 1.0, speed=1.0)], start=0.02)]),
    "load": (
        {"control": "attitude"},
        lambda: [
            SlungLoad(0.005, 0.3, cable=True, drag=0.01),
            RotorJet(),
            ContactResponse(),
        ],
    ),
    "shared": ({"control": "attitude", "integrator": "symplectic_euler"}, lambda: [SharedLoad(0.005)]),
    "hook": ({"control": "state", "drone": "bumblebee"}, lambda: [Hook.bumblebee(0.2), ContactLog()]),
    "vehicles": (
        {"control": "rotor_vel"},
        lambda: [
            Cars(2, path=figure_eight(6.0, 2.0, period=12.0), controller=vehicles.PathLQR(), trailer=True),
            Bicycles(pos=(0.0, 3.0)),
            Radar((0.0, 0.0, 0.5)),
        ],
    ),
    "terrain": (
        {"control": "attitude"},
        lambda: [Terrain(hills, (8.0, 8.0)), RangeFinder(drones=True), ContactLog()],
    ),
    "bodies": (
        {"control": "state"},
        lambda: [FreeBodies(3, size=(0.2, 0.2, 0.2), mass=0.2, pos=[(0, 0, 0.11), (0.02, 0, 0.35), (1, 0, 2.0)])],
    ),
}
"""Settings and plugins, each plugin once or more."""


@pytest.mark.parametrize("name", PLUGINS)
def test_plugins_do_what_they_do_on_the_cpu(name):
    settings, plugins = PLUGINS[name]

    def run(device):
        sim = flying(device, plugins=plugins(), **settings)
        lines = sim.explain().splitlines()
        assert lines[0] == "engine: fused"
        assert lines[-1].startswith("kernel: ")
        sim.step(N_STEPS)
        return sim.data

    agree(*both(run), LOADS if name in ("shared", "hook") else ROUNDING)


@pytest.mark.parametrize(
    ("plugin", "height", "tolerance"),
    [
        (DroneCollisions(), 1.0, ROUNDING),
        (ContactResponse(), 0.03, 0.02),
    ],  # a box on a floor touches with any corner
    ids=["drones", "floor"],
)
def test_impacts_are_those_of_the_cpu(plugin, height, tolerance):
    def run(device):
        sim = flying(device, plugins=[plugin], control="attitude")
        meeting = {"pos": [[0, 0, height], [0.12, 0.02, height + 0.01]], "vel": [[0.5, 0, -0.3], [-0.5, 0, -0.3]]}
        sim.data = with_states(sim.data, **{k: np.broadcast_to(x, (8, 2, 3)) for k, x in meeting.items()})
        sim.step(20)
        assert (np.asarray(sim.data.states.vel)[:, 0, 0] < 0.2).any()
        return sim.data.states.pos, sim.data.states.vel

    agree(*both(run), tolerance)


def test_law_01_many_worlds_on_wide_blocks_fly_as_few():
    """A kernel longer than the instruction cache has blocks of 256 threads from 65,536 drones on."""
    few, many = (
        Sim(n, control="state", device=ACCELERATOR, estimator=Kalman.default(), rng_key=4) for n in (40, 2**16 + 7)
    )
    assert "64 threads a block, 256 from 65,536 drones on" in many.explain()
    few.step(N_STEPS)
    many.step(N_STEPS)
    assert trees_equal(few.data.states, jax.tree.map(lambda x: x[:40], many.data.states))
    assert float(jnp.abs(many.data.states.pos - many.default_data.states.pos).max()) < 0.5


def test_law_01_one_world_flies_as_among_many():
    many = flying(ACCELERATOR, 100, control="state")
    start = many.data.states, many.data.controls.state.staged_cmd
    many.step(N_STEPS)
    one = flying(ACCELERATOR, 1, control="state")
    begin = one.data
    for world in (0, 37, 99):
        states, command = jax.tree.map(lambda x, w=world: x[w : w + 1], start)
        one.data = send(begin.replace(states=states), command)
        one.step(N_STEPS)
        assert trees_equal(one.data.states, jax.tree.map(lambda x, w=world: x[w : w + 1], many.data.states))


def test_law_07_a_world_that_is_not_finite_touches_no_other():
    sim = flying(ACCELERATOR, 100, plugins=[Downwash(), Wind(speed_20ft=7.7)], control="attitude")
    start = sim.data
    sim.step(N_STEPS)
    healthy = sim.data.states
    pos = start.states.pos.at[41, 1].set(jnp.nan)
    sim.data = start.replace(states=start.states.replace(pos=pos))
    sim.step(N_STEPS)
    assert np.flatnonzero(sim.data.core.nonfinite).tolist() == [41]
    others = np.arange(100) != 41
    assert trees_equal(*(jax.tree.map(lambda x: x[others], states) for states in (sim.data.states, healthy)))


def test_law_10_the_same_seed_gives_the_same_numbers():
    flights = [flying(ACCELERATOR, n, plugins=[Wind(speed_20ft=7.7)], control="attitude") for n in (100, 100, 7)]
    for sim in flights:
        sim.step(N_STEPS)
    first, again, few = (sim.data.plugins for sim in flights)
    assert trees_equal(first, again)
    agree(jax.tree.map(lambda x: x[:7], first["wind"].gust), few["wind"].gust, 0)


def test_queries_of_the_scene_are_those_of_the_cpu():
    def run(device):
        sim = flying(device, control="attitude")
        ball = sim.scene.add("sphere", pos=(0.0, 0.0, 1.5), radius=0.2)
        sim.scene.add("wall", pos=(3, 0, 0), length=20, height=20, mocap=False)
        sim.step(1)
        report, depth = sim.contact_report(), sim.depth(width=16, height=12)
        assert np.asarray(report.objects).any()
        sim.data = ball.set_pose(sim.data, pos=(0.0, 0.5, 1.5))
        moved = sim.contact_report(ball, floor=False)
        return report, depth, moved, sim.contacts()

    found, expected = both(run)
    seen = [np.isfinite(x[1]) for x in (found, expected)]
    agree(*seen, 0)
    agree(*(jax.tree.map(lambda x: jnp.where(jnp.isinf(x), 0, x), x) for x in (found, expected)), 1e-5)
