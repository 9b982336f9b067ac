"""Estimators: a `ShootingProblem` and a `Bracket` in, an `Estimate` out; one algorithm a file."""

from ._estimate import (
    WITH_PRIOR as WITH_PRIOR,
    AbstractEstimator as AbstractEstimator,
    Calibration as Calibration,
    Estimate as Estimate,
    fit_start as fit_start,
)
from .equation_error import EquationError as EquationError
from .hybrid import Hybrid as Hybrid
from .ibss import IBSS as IBSS
from .kalman import JointEKF as JointEKF
from .network import (
    APPROXIMATORS as APPROXIMATORS,
    NetworkEstimator as NetworkEstimator,
    TrainedNetwork as TrainedNetwork,
)
from .network_file import load_network as load_network, save_network as save_network
from .output_error import OutputError as OutputError
from .profile import Profile as Profile, profile_likelihood as profile_likelihood
from .recursive_least_squares import RecursiveLeastSquares as RecursiveLeastSquares
from .svsf import SVSF as SVSF

BASELINES: dict[str, type[AbstractEstimator]] = {
    "output-error": OutputError,
    "equation-error": EquationError,
    "rls": RecursiveLeastSquares,
    "svsf": SVSF,
    "kalman": JointEKF,
}
