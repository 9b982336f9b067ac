"""Estimators: a `ShootingProblem` and a `Bracket` in, an `Estimate` out; one algorithm a file."""

from ._estimate import AbstractEstimator as AbstractEstimator, Estimate as Estimate
from .ibss import IBSS as IBSS
