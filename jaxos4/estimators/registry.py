"""The estimators by name."""

from typing import TYPE_CHECKING

from .._registry import Registry
from ..errors import check_choice

if TYPE_CHECKING:  # the command line offers the names before it imports JAX
    from ..estimate import AbstractEstimator
    from ..networks import TrainedNetwork


ESTIMATORS: "Registry[type[AbstractEstimator]]" = Registry(
    "jaxos4.estimators",
    {
        "ibss": "estimators.ibss:IBSS",
        "network": "networks:TrainedNetwork",
        "hybrid": "estimators.hybrid:Hybrid",
        "output-error": "estimators.output_and_filter_error:OutputError",
        "filter-error": "estimators.output_and_filter_error:FilterError",
        "equation-error": "estimators.equation_error:EquationError",
        "rls": "estimators.equation_error:RecursiveLeastSquares",
        "svsf": "estimators.svsf:SVSF",
        "kalman": "estimators.kalman:JointEKF",
        "ant-colony": "estimators.ant_colony:AntColony",
    },
)
"""The estimators by name, as command line, studies and figures offer them. A new estimator is one line here
(and in `__init__.pyi`, if its class is to be public), or an entry point of another package in the group
`jaxos4.estimators` that gives the class. For a vehicle, the name of an estimator that needs a network means the
hybrid."""


def make_estimator(name: str, network: "TrainedNetwork | None" = None) -> "AbstractEstimator":
    """The estimator of this name with default settings. If it needs a network, it uses `network`, or is `network`.

    Raises `ValueError` for an unknown name, or if the estimator needs a network and there is none.
    """
    check_choice("name", name, ESTIMATORS)
    kind = ESTIMATORS[name]
    if not kind.needs_network:
        return kind()
    if network is None:
        raise ValueError(f"`network` must be a trained network for {kind.__name__}, got None.")
    return network if isinstance(network, kind) else kind(**{"network": network})
