"""How a computation ended, as a value: one result for every lane of a batch, and no exception inside it."""

import equinox as eqx
import numpy as np

NINETY_FIVE = 1.959963984540054
"""So many standard deviations to either side hold 95 % of a Gaussian."""


class RESULTS(eqx.Enumeration):
    """How a simulation or an estimate ended. Codes are for this process only: store names (`result_names`)."""

    successful = ""
    at_bound = "a parameter lies at the limit around its bracket, or beyond: widen the bracket or fix the model"
    unidentifiable = "the flight tells less about a parameter than its bracket already did"
    nonfinite_trajectory = "the trajectory does not stay finite to its end, or the input is not finite"
    attitude_singularity = "the pitch angle passed +-90 degrees, where Euler angles end"
    bracket_invalid = "a bracket's lower end is not below its upper end, or its width is not finite"
    network_mismatch = "the network was trained for other inputs, sampling or start, or for less noise and fewer gaps"
    max_sweeps = "the brackets still moved after the largest number of sweeps"


NAMES = (
    "successful",
    "at_bound",
    "unidentifiable",
    "nonfinite_trajectory",
    "attitude_singularity",
    "bracket_invalid",
    "network_mismatch",
    "max_sweeps",
)


def result_names(result: RESULTS) -> np.ndarray:
    """The names of a result or of a batch of them, as an array of strings of the batch's shape."""
    conditions = [np.asarray(result == getattr(RESULTS, name)) for name in NAMES]
    return np.select(conditions, NAMES, default="")
