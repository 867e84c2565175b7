"""Demonstrations: ``crazysim demo NAME`` runs the module of that name.

A demonstration is a module with ``run(n_worlds, n_drones, seconds, device, out, film)``, all of which have defaults. It
prints figures and writes files into the folder ``out``.
"""

DEMOS = {
    "flight": "fly figure eights around poles in many worlds; print figures, write a plot and a film",
    "load": "carry a swinging load on a hook in hover; print how it comes to rest, write a film",
    "pick": "pick up a load, carry it along a figure eight, set it down on a pad; print how many succeed, write a film",
    "mixed": "fly two kinds of drones, one with a load, over cars on hills; print distances and errors, write a film",
}
"""Names of the demonstrations, and what they show."""
