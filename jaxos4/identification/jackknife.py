"""The jackknife: do parts of a flight give the same answer? If not, the model lacks something, and intervals widen."""

import numpy as np
from jaxtyping import Float, Int

# The most parts of a flight that are compared, and the fewest that can show a disagreement.
_MOST, _FEWEST = 20, 4
# The chance that parts of a flight that the model explains are taken to disagree.
_CHANCE = 0.05


def parts_of(lanes: int, recording: Int[np.ndarray, " lanes"]) -> list[Int[np.ndarray, " lanes"]]:
    """The ways to divide lanes into parts: into blocks of neighbours, and into recordings if there are enough."""
    ways = [np.arange(lanes) * min(lanes, _MOST) // lanes]
    if np.unique(recording).size >= _FEWEST:
        ways.append(recording)
    return [way for way in ways if np.unique(way).size >= _FEWEST]


def disagreement(
    gradient: Float[np.ndarray, "lanes unknowns"],
    information: Float[np.ndarray, "lanes unknowns unknowns"],
    prior: Float[np.ndarray, "unknowns unknowns"],
    part: Int[np.ndarray, " lanes"],
) -> Float[np.ndarray, " unknowns"]:
    """By how much parts disagree: the jackknife's standard error over the likelihood's; at least 1.

    The standard errors of a likelihood assume that the model is right. If it is not, parts of a flight give different
    answers. The jackknife leaves out one part at a time; each answer follows from one Gauss-Newton step, because the
    search has computed the gradient and the information of each part. 1 if the disagreement could be chance: it happens
    by chance to one parameter in twenty.

    **Arguments:**

    - `gradient`, `information`: of the negative log-likelihood of each lane, at the estimate from all lanes.
    - `prior`: the information of the prior.
    - `part`: the number of the part of each lane.

    Reference: Efron and Tibshirani 1993, An Introduction to the Bootstrap, ch. 11.
    """
    from scipy.special import chdtri  # slow to import

    numbers = np.unique(part)
    whole = information.sum(axis=0) + prior
    scale = np.sqrt(np.diagonal(whole))
    moved = []
    for number in numbers:
        left_out = part == number
        rest = (whole - information[left_out].sum(axis=0)) / np.outer(scale, scale)
        slope = gradient[left_out].sum(axis=0) / scale
        moved.append(np.linalg.lstsq(rest, slope, rcond=1e-12)[0] / scale)
    moved = np.stack(moved)
    variance = (numbers.size - 1) / numbers.size * np.square(moved - moved.mean(axis=0)).sum(axis=0)
    likelihood = np.diagonal(np.linalg.inv(whole / np.outer(scale, scale))) / scale**2
    ratio = variance / likelihood
    freedom = numbers.size - 1
    return np.sqrt(np.where(ratio > chdtri(freedom, _CHANCE) / freedom, np.maximum(ratio, 1.0), 1.0))
