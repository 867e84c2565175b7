"""Estimators: filters that fuse the measurements of sensors, each a plugin that ``sim.add`` adds."""

from crazysim.errors import ConfigError
from crazysim.plugins.estimators.complementary import Complementary
from crazysim.plugins.estimators.eskf import ESKF
from crazysim.plugins.estimators.estimator import Estimator
from crazysim.plugins.estimators.kalman import Kalman

__all__ = ["ESKF", "Complementary", "Estimator", "Kalman", "find_estimator"]

ESTIMATORS: dict[str, type[Estimator]] = {"kalman": Kalman, "eskf": ESKF, "complementary": Complementary}
"""Estimators by the names that ``Sim(estimator=...)`` takes."""


def find_estimator(estimator: str | Estimator) -> Estimator:
    """Return an estimator; for a name, the estimator with its default sensors."""
    if isinstance(estimator, Estimator):
        return estimator
    if not isinstance(estimator, str) or estimator not in ESTIMATORS:
        raise ConfigError(
            f"expected an estimator as one of {', '.join(map(repr, ESTIMATORS))}, got {estimator!r}. Use a name, or an "
            f"estimator with its sensors, such as Kalman([IMU(), MotionCapture()])."
        )
    return ESTIMATORS[estimator].default()
