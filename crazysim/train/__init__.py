"""Training policies: environments in, policies out."""

from typing import TYPE_CHECKING

from crazysim.lazy import lazy

if TYPE_CHECKING:
    from crazysim.train.run import TrainConfig, load_policy, train

__all__ = ["TrainConfig", "load_policy", "train"]

__getattr__ = lazy(__name__, dict.fromkeys(__all__, "crazysim.train.run"))
