"""Estimators: from a `ShootingProblem` and a `Bracket` to an `Estimate`. Each algorithm has its own file."""

from ..estimate import AbstractEstimator
from ..networks import TrainedNetwork
from .equation_error import EquationError as EquationError
from .hybrid import Hybrid as Hybrid
from .ibss import IBSS as IBSS
from .kalman import JointEKF as JointEKF
from .output_error import OutputError as OutputError
from .profile import Profile as Profile, profile_likelihood as profile_likelihood
from .recursive_least_squares import RecursiveLeastSquares as RecursiveLeastSquares
from .svsf import SVSF as SVSF

ESTIMATORS: dict[str, type[AbstractEstimator]] = {
    "ibss": IBSS,
    "network": TrainedNetwork,
    "hybrid": Hybrid,
    "output-error": OutputError,
    "equation-error": EquationError,
    "rls": RecursiveLeastSquares,
    "svsf": SVSF,
    "kalman": JointEKF,
}
"""The estimators by name: what the command line, studies and figures offer. A new estimator is one line here."""


def make_estimator(name: str, network: TrainedNetwork | None = None) -> AbstractEstimator:
    """The estimator of that name, with its default settings, made from `network` if it needs one.

    **Raises:** `ValueError` for an unknown name, or if the estimator needs a network and there is none.
    """
    if name not in ESTIMATORS:
        raise ValueError(f"`name` must be one of {', '.join(ESTIMATORS)}, got {name!r}.")
    return ESTIMATORS[name].of(network)
