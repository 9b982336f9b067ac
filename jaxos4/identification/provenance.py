"""What an identification was made with: names, versions, devices."""

import importlib.metadata
from collections.abc import Mapping
from typing import Any

import jax

from ..airframe import PRESETS, Airframe
from ..errors import InputError
from ..estimate import AbstractEstimator
from ..estimators import ESTIMATORS
from ..shooting import ShootingProblem


def versions(problem: ShootingProblem) -> dict[str, Any]:
    """Versions, device and precision."""
    return {
        "version": importlib.metadata.version("jaxos4"),
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "precision": str(problem.flight.time.dtype),
    }


def airframe_name(airframe: Airframe) -> str:
    """The name of a preset, or "custom"."""
    return next((name for name, preset in PRESETS.items() if preset is airframe), "custom")


def class_name(instance: object, kinds: Mapping[str, type]) -> str:
    """The name of an object's class in a table of classes, or else the class's own name."""
    return next((name for name, kind in kinds.items() if type(instance) is kind), type(instance).__name__)


def name_and_class(estimator: str | AbstractEstimator) -> tuple[str, type[AbstractEstimator]]:
    """The name and the class of an estimator. Raises `InputError` for an unknown name."""
    if not isinstance(estimator, str):
        return class_name(estimator, ESTIMATORS), type(estimator)
    if estimator not in ESTIMATORS:
        raise InputError(f"`estimator`: must be one of {', '.join(ESTIMATORS)}, got {estimator!r}.")
    return estimator, ESTIMATORS[estimator]
