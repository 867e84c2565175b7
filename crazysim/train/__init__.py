"""Training, evaluation and plots of policies."""

from typing import TYPE_CHECKING

from crazysim.names import lazy_getattr

if TYPE_CHECKING:
    from crazysim.train.check import check_task as check_task
    from crazysim.train.config import TrainConfig
    from crazysim.train.dagger import imitate
    from crazysim.train.evaluation import evaluate, evaluate_each
    from crazysim.train.networks import Network
    from crazysim.train.policies import MultiPolicy
    from crazysim.train.runs import run, run_many
    from crazysim.train.search import tune
    from crazysim.train.show import film, plot_episode
    from crazysim.train.training import load_policy

__all__ = [
    "MultiPolicy",
    "Network",
    "TrainConfig",
    "check_task",
    "evaluate",
    "evaluate_each",
    "film",
    "imitate",
    "load_policy",
    "plot_episode",
    "run",
    "run_many",
    "tune",
]

__getattr__ = lazy_getattr(__name__)
