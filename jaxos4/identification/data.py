"""`Data`: what is known of flights before a search."""

import dataclasses
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int

from ..recording.checks import Finding
from ..shooting import InnovationsProblem, ShootingProblem
from .provenance import Provenance

Progress = Callable[[str], None]
L = TypeVar("L", ShootingProblem, InnovationsProblem)


def silent(stage: str) -> None:
    """Tells nobody about a stage."""


class Clock(NamedTuple):
    """The number of the log of each sample, and the time of the sample in its log [s]."""

    log: Int[np.ndarray, " samples"] = np.zeros(0, int)
    time: Float[np.ndarray, " samples"] = np.zeros(0)


class HeldOut(NamedTuple):
    """Measurements that are not fitted.

    - `problem`: the flight and its model.
    - `recording`, `clock`: name and times of the other recording that it is; `None`: it is a part of the fitted ones.
    """

    problem: ShootingProblem
    recording: str | None = None
    clock: Clock = Clock()


@dataclasses.dataclass(frozen=True)
class Data(Generic[L]):
    """Flights as they are fitted, the measurements that test the answer, and what is known of both.

    - `likelihood`: with its bracket; that of a vehicle is padded.
    - `problem`: the flight and its model.
    - `clock`: of each sample of a vehicle's logs; empty for an OS4.
    - `provenance`: data, settings and versions. `seconds`: how long the fitted measurements of a vehicle last [s].
    - `held_out`: what is not fitted, if there is anything.
    - `findings`: what the logs show that concerns moments of inertia. `log_step`: the longest sample of the logs [s].
    """

    likelihood: L
    problem: ShootingProblem
    clock: Clock
    provenance: Provenance
    seconds: float = 0.0
    held_out: HeldOut | None = None
    findings: tuple[Finding, ...] = ()
    log_step: float = 0.0

    @property
    def room(self) -> int:
        """The number of samples of a padded flight: checks at all sample times share their programs."""
        return self.likelihood.flight.time.shape[0]
