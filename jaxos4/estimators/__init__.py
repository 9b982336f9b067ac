"""Estimators: a `ShootingProblem` and a `Bracket` in, an `Estimate` out; one algorithm a file."""

from ._estimate import AbstractEstimator as AbstractEstimator, Calibration as Calibration, Estimate as Estimate
from .hybrid import Hybrid as Hybrid
from .ibss import IBSS as IBSS
from .network import (
    APPROXIMATORS as APPROXIMATORS,
    NetworkEstimator as NetworkEstimator,
    TrainedNetwork as TrainedNetwork,
)
from .network_file import load_network as load_network, save_network as save_network
from .output_error import OutputError as OutputError
from .profile import Profile as Profile, profile_likelihood as profile_likelihood
