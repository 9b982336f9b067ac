"""The result of a computation as a value: one for each lane of a batch, and no exception inside the batch."""

import equinox as eqx
import jax
import numpy as np

NINETY_FIVE = 1.959963984540054
"""Half the width of a 95 % interval of a Gaussian, in standard deviations."""


class RESULTS(eqx.Enumeration):
    """The result of a simulation or estimate. Codes are valid in this process; files store names (`result_names`)."""

    successful = ""
    at_bound = "a parameter reached the limit of the search around its bracket: widen the bracket or correct the model"
    unidentifiable = "the flight contains less information about a parameter than its bracket: fly with more excitation"
    nonfinite_trajectory = "the simulated trajectory or its input is not finite: check the input and the bracket"
    attitude_singularity = "the pitch angle passed +-90 degrees, where Euler angles are singular: fly no loops"
    bracket_invalid = "a bracket is not finite, or its lower end is not below its upper end: correct the bracket"
    network_mismatch = (
        "the flight differs from the network's training in inputs, sampling or start, or has more noise or gaps: "
        "train a network for this flight"
    )
    implausible = (
        "physics, the airframe file or the data contradict the estimate: correct what is named, and do not use "
        "contradicted numbers"
    )
    no_skill = (
        "the fit predicts measurements that were not fitted no better than constant rates: fly with more excitation, "
        "or correct the airframe"
    )
    max_sweeps = (
        "the search did not converge within the largest number of sweeps: fly with more excitation, or use another "
        "estimator"
    )


NAMES = (
    "successful",
    "at_bound",
    "unidentifiable",
    "nonfinite_trajectory",
    "attitude_singularity",
    "bracket_invalid",
    "network_mismatch",
    "implausible",
    "no_skill",
    "max_sweeps",
)
NO_ANSWER = ("nonfinite_trajectory", "bracket_invalid", "network_mismatch")
"""The results without an estimate."""


def has_answer(result: RESULTS) -> bool:
    """Whether there is an estimate at all, trustworthy or not."""
    return str(result_names(result)) not in NO_ANSWER


def meaning(name: str) -> str:
    """The message of a result, by its name; empty if it is `"successful"`."""
    return str(RESULTS[getattr(RESULTS, name)])


def result_names(result: RESULTS) -> np.ndarray:
    """The name of each result in a batch, as an array of strings of the batch's shape."""
    code = _code(result)
    return np.select([code == _code(getattr(RESULTS, name)) for name in NAMES], NAMES, default="")


def _code(result: RESULTS) -> np.ndarray:
    """The number in a result. Results themselves are compared by compiled programs."""
    (code,) = jax.tree.leaves(result)
    return np.asarray(code)
