"""The estimators by name."""

from collections import UserDict
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the command line offers the names before it imports JAX
    from ..estimate import AbstractEstimator
    from ..networks import TrainedNetwork


class Estimators(UserDict[str, "type[AbstractEstimator]"]):
    """Classes by name. A class given as `"module:Class"` is imported when it is first looked up."""

    def __init__(self, classes: "dict[str, type[AbstractEstimator] | str]"):
        super().__init__()
        self.data = classes  # pyright: ignore[reportAttributeAccessIssue]

    def __getitem__(self, name: str) -> "type[AbstractEstimator]":
        kind: Any = self.data[name]
        if isinstance(kind, str):
            module, _, attribute = kind.partition(":")
            kind = self.data[name] = getattr(import_module(module, __package__), attribute)
        return kind


ESTIMATORS = Estimators(
    {
        "ibss": ".ibss:IBSS",
        "network": "..networks:TrainedNetwork",
        "hybrid": ".hybrid:Hybrid",
        "output-error": ".newton:OutputError",
        "filter-error": ".newton:FilterError",
        "equation-error": ".equation_error:EquationError",
        "rls": ".equation_error:RecursiveLeastSquares",
        "svsf": ".svsf:SVSF",
        "kalman": ".kalman:JointEKF",
        "ant-colony": ".ant_colony:AntColony",
    }
)
"""The estimators by name: what the command line, studies and figures offer. A new estimator is one line here."""


def make_estimator(name: str, network: "TrainedNetwork | None" = None) -> "AbstractEstimator":
    """The estimator of that name, with its default settings, made from `network` if it needs one.

    **Raises:** `ValueError` for an unknown name, or if the estimator needs a network and there is none.
    """
    if name not in ESTIMATORS:
        raise ValueError(f"`name` must be one of {', '.join(ESTIMATORS)}, got {name!r}.")
    return ESTIMATORS[name].of(network)
