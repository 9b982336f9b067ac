"""The estimators by name."""

from collections.abc import Iterator, MutableMapping
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the command line offers the names before it imports JAX
    from ..estimate import AbstractEstimator
    from ..networks import TrainedNetwork


class Estimators(MutableMapping[str, "type[AbstractEstimator]"]):
    """Classes by name. A class given as `"module:Class"` is imported when it is first looked up."""

    def __init__(self, classes: "dict[str, type[AbstractEstimator] | str]"):
        self._classes = classes

    def __getitem__(self, name: str) -> "type[AbstractEstimator]":
        kind = self._classes[name]
        if isinstance(kind, str):
            module, _, attribute = kind.partition(":")
            kind = self._classes[name] = getattr(import_module(module, __package__), attribute)
        return kind

    def __setitem__(self, name: str, kind: "type[AbstractEstimator]") -> None:
        self._classes[name] = kind

    def __delitem__(self, name: str) -> None:
        del self._classes[name]

    def __contains__(self, name: object) -> bool:
        return name in self._classes

    def __iter__(self) -> Iterator[str]:
        return iter(self._classes)

    def __len__(self) -> int:
        return len(self._classes)


ESTIMATORS = Estimators(
    {
        "ibss": ".ibss:IBSS",
        "network": "..networks:TrainedNetwork",
        "hybrid": ".hybrid:Hybrid",
        "output-error": ".output_error:OutputError",
        "filter-error": ".filter_error:FilterError",
        "equation-error": ".equation_error:EquationError",
        "rls": ".recursive_least_squares:RecursiveLeastSquares",
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
