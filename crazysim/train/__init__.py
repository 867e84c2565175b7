"""Training, evaluation and plots of policies."""

from typing import TYPE_CHECKING

from crazysim.startup import lazy_getattr

if TYPE_CHECKING:
    from crazysim.train.config import TrainConfig
    from crazysim.train.dagger import imitate
    from crazysim.train.evaluation import evaluate
    from crazysim.train.networks import Network
    from crazysim.train.runs import run, run_many
    from crazysim.train.show import film, plot_episode
    from crazysim.train.training import load_policy

__all__ = [
    "Network",
    "TrainConfig",
    "evaluate",
    "film",
    "imitate",
    "load_policy",
    "plot_episode",
    "run",
    "run_many",
]

__getattr__ = lazy_getattr(
    __name__,
    {
        "Network": "crazysim.train.networks",
        "TrainConfig": "crazysim.train.config",
        "evaluate": "crazysim.train.evaluation",
        "film": "crazysim.train.show",
        "imitate": "crazysim.train.dagger",
        "load_policy": "crazysim.train.training",
        "plot_episode": "crazysim.train.show",
        "run": "crazysim.train.runs",
        "run_many": "crazysim.train.runs",
    },
)
