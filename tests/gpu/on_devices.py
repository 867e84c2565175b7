"""The devices that are compared."""

import os

import jax

from crazysim import Sim

ACCELERATOR = os.environ.get("CRAZYSIM_ACCELERATOR", "gpu")
"""Device that is compared with the CPU. With ``cpu:1`` the tests run on any machine."""
NAMES = ("cpu", ACCELERATOR)
"""Names of the two devices that are compared."""
DEVICES = {name: Sim(device=name).device for name in NAMES}


def require_device(device, tree):
    assert {x.device for x in jax.tree.leaves(tree)} == {DEVICES[device]}
    return tree
