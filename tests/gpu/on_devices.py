"""Simulations on the CPU and on the accelerator, and what their results have in common."""

import os

import jax
import numpy as np
from cases import as_numbers, hover_command, send, with_states

from crazysim import Sim

ACCELERATOR = os.environ.get("CRAZYSIM_ACCELERATOR", "gpu")
"""Device that is compared with the CPU. With ``cpu:1`` the tests run anywhere, to be tested themselves."""
NAMES = ("cpu", ACCELERATOR)
DEVICES = {name: Sim(device=name).device for name in NAMES}
LOADS = 1e-3
"""Tolerance of flights with loads, as slack cables and friction enlarge roundings.

Two engines of the CPU differ by 8e-5 with cables. Kernels of GPUs divide to 2 units in the last place; with exact
division a hook agrees to 1e-4. The task ``deliver`` needs no more than other tasks: after 20 steps two engines of the
CPU differ by 2e-6, and each from float64 by 4e-6.
"""
NOISE = {
    "state": [0.2, 0.2, 0.2, *[0.0] * 13],
    "attitude": [0.2, 0.2, 0.2, 0.0],
    "body_rate": [0.5, 0.5, 0.5, 0.0],
    "force_torque": [0.0, 1e-6, 1e-6, 1e-6],
    "rotor_vel": [0.0] * 4,
}
"""Largest differences of commands from those in hover, besides 2% of each number."""


def flying(device, n_worlds=8, n_drones=2, plugins=(), **settings):
    """Return a simulation whose drones differ in states and commands; those of world k are always the same."""
    sim = Sim(n_worlds, n_drones, device=device, rng_key=4, **settings)
    rng = np.random.default_rng(3)

    def draw(size, k):
        return size * rng.uniform(-1, 1, (100, n_drones, k))[:n_worlds]

    quat = np.append(draw(0.1, 3), np.ones((n_worlds, n_drones, 1)), axis=-1)
    sim.data = with_states(
        sim.data,
        pos=draw(0.1, 3) + np.stack(np.broadcast_arrays(0.0, 0.5 * np.arange(n_drones), 1.5), axis=-1),
        quat=quat / np.linalg.norm(quat, axis=-1, keepdims=True),
        vel=draw(0.5, 3),
        ang_vel=draw(1.0, 3),
    )
    for plugin in plugins:
        sim.add(plugin)
    hover = hover_command(sim.data, (0, 0, 1.5))
    command = hover * (1 + draw(0.02, len(hover))) + draw(1.0, len(hover)) * NOISE[sim.control.value]
    sim.data = send(sim.data, command)
    return sim


def agree(found, expected, tolerance):
    """Check that flags and integers are equal, and other numbers but for rounding.

    Differences of large numbers carry their errors, so the tolerance is relative to the largest number of an array, or
    to 1.
    """
    leaves, rest = jax.tree_util.tree_flatten_with_path(found)
    assert rest == jax.tree.structure(expected)
    for (path, x), y in zip(leaves, jax.tree.leaves(expected), strict=True):
        x, y, name = as_numbers(x), as_numbers(y), jax.tree_util.keystr(path)
        if np.issubdtype(y.dtype, np.floating):
            size = np.abs(y[np.isfinite(y)]).max(initial=1.0)
            np.testing.assert_allclose(x, y, rtol=0, atol=tolerance * size, err_msg=name)
        else:
            np.testing.assert_array_equal(x, y, err_msg=name)


def on(device, tree):
    """Return a tree, all of which must be on a device."""
    assert {x.device for x in jax.tree.leaves(tree)} == {DEVICES[device]}
    return tree
