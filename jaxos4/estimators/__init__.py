"""Estimators: a `ShootingProblem` and a `Bracket` in, an `Estimate` out; one algorithm a file."""

from ._estimate import AbstractEstimator as AbstractEstimator
from ._estimate import Estimate as Estimate
from .ibss import IBSS as IBSS
