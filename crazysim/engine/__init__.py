"""The compiler: records with scopes and stages in, kernels out. It knows no drones.

A `PyTree` declares for each leaf which axes it has, a `stage` for whom it is written; a `Record` names the clock and
the population in lanes. `Step` runs stages on a record, and `explain` says how.
"""

from typing import TYPE_CHECKING

from crazysim.engine.pair_reductions import reduce_over_others
from crazysim.engine.pytree import Members, PyTree, leaf, leaf_indices, scopes, static
from crazysim.engine.record import Record, Roles
from crazysim.engine.sharding import shard, world_mesh
from crazysim.engine.stage import stage, vmap_drones
from crazysim.names import lazy_getattr

if TYPE_CHECKING:
    from crazysim.engine.plan import ENGINES
    from crazysim.engine.step import Step
    from crazysim.engine.tools.explain import explain

__all__ = [
    "ENGINES",
    "Members",
    "PyTree",
    "Record",
    "Roles",
    "Step",
    "explain",
    "leaf",
    "leaf_indices",
    "reduce_over_others",
    "scopes",
    "shard",
    "stage",
    "static",
    "vmap_drones",
    "world_mesh",
]

__getattr__ = lazy_getattr(__name__)
