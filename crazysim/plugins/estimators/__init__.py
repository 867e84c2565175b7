"""Estimators: filters that fuse the measurements of sensors, each a plugin that ``sim.add`` adds."""

import sys
from typing import TYPE_CHECKING

from crazysim.errors import ConfigError
from crazysim.names import lazy_getattr
from crazysim.plugins.estimators.estimator import Estimator
from crazysim.plugins.estimators.kalman import Kalman

if TYPE_CHECKING:
    from crazysim.lab.estimators.complementary import Complementary
    from crazysim.lab.estimators.eskf import ESKF

__all__ = ["ESKF", "Complementary", "Estimator", "Kalman", "find_estimator"]

__getattr__ = lazy_getattr(__name__)

ESTIMATORS = {"kalman": "Kalman", "eskf": "ESKF", "complementary": "Complementary"}
"""Classes of estimators by the names that ``Sim(estimator=...)`` takes."""


def find_estimator(estimator: str | Estimator) -> Estimator:
    """Return an estimator; for a name, the estimator with its default sensors."""
    if isinstance(estimator, Estimator):
        return estimator
    if not isinstance(estimator, str) or estimator not in ESTIMATORS:
        raise ConfigError(
            f"expected an estimator as one of {', '.join(map(repr, ESTIMATORS))}, got {estimator!r}. Use a name, or an "
            f"estimator with its sensors, such as Kalman([IMU(), MotionCapture()])."
        )
    return getattr(sys.modules[__name__], ESTIMATORS[estimator]).default()
