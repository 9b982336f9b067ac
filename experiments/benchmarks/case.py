"""The flights that all contenders identify, in a file of plain arrays, and the cost by which their answers are judged.

This file needs NumPy alone. The equations of motion are written once, for NumPy, CasADi and jax.numpy: each library
has functions `sin`, `cos` and `tan`.
"""

import dataclasses
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

ALL, RATES = slice(None), [7, 9, 11]  # columns of the states


@dataclasses.dataclass(frozen=True)
class Case:
    """Noisy standard flights, and where each search begins.

    - `forcing`: torques of roll, pitch, yaw [N m] and thrust / mass [m/s^2] of each step, (steps, 4).
    - `omega`: rotor speeds [rad/s], (steps + 1, 4).
    - `measured`: states of each flight in the paper's order, (flights, steps + 1, 12).
    - `starts`: parameters at which each search begins, (flights, 8). They are the centre of its bracket.
    - `half_width`: of the bracket, (8,).
    - `sigma`: of the measurements, (12,).
    - `truth`: the parameters that made the flights, (8,).
    - `dt`: the sample time [s]; `gravity` [m/s^2].
    - `known`: whether the initial state is known: 0. It is estimated otherwise.
    """

    forcing: np.ndarray
    omega: np.ndarray
    measured: np.ndarray
    starts: np.ndarray
    half_width: np.ndarray
    sigma: np.ndarray
    truth: np.ndarray
    dt: float
    gravity: float
    known: bool

    def first(self, flights: int) -> "Case":
        """The case with its first flights only."""
        return dataclasses.replace(self, measured=self.measured[:flights], starts=self.starts[:flights])

    @property
    def flights(self) -> int:
        """The number of flights."""
        return len(self.measured)

    @property
    def begin(self) -> int:
        """The first sample that counts: a known initial state is no data."""
        return 1 if self.known else 0

    def first_states(self) -> np.ndarray:
        """Where each search for the initial state begins: 0 if it is known, else the first measurement."""
        return np.zeros_like(self.measured[:, 0]) if self.known else self.measured[:, 0]

    def answer(self, scaled: np.ndarray) -> dict[str, np.ndarray]:
        """Parameters and initial states of all flights from offsets of the starts in `half_width` and in `sigma`."""
        first = self.first_states() + (0 if self.known else scaled[:, 8:20] * self.sigma)
        return {"parameters": self.starts + scaled[:, :8] * self.half_width, "first": first}

    def save(self, path: Path) -> None:
        """Writes the case as `.npz`."""
        np.savez(path, **dataclasses.asdict(self))  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: Path) -> "Case":
        """Reads what `save` wrote."""
        with np.load(path) as data:
            found = {name: data[name] for name in data.files}
        scalars = {"dt": float(found["dt"]), "gravity": float(found["gravity"]), "known": bool(found["known"])}
        return cls(**{**found, **scalars})


def step(library: ModuleType, state: Any, forcing: Any, alpha: Any, dt: float, gravity: float) -> tuple:
    """One forward Euler step of the published model, Eqs. (1)-(9); each argument is a sequence of scalars or arrays."""
    x, vx, y, vy, z, vz, phi, p, theta, q, psi, r = state
    roll, pitch, yaw, thrust = forcing
    a1, a2, a3, a4, a5, a6, a7, a8 = alpha
    sin_phi, cos_phi = library.sin(phi), library.cos(phi)
    sin_theta, cos_theta = library.sin(theta), library.cos(theta)
    sin_psi, cos_psi = library.sin(psi), library.cos(psi)
    turning = q * sin_phi + r * cos_phi
    return (
        x + dt * vx,
        vx + dt * (sin_phi * cos_psi - sin_psi * sin_theta * cos_phi) * thrust,
        y + dt * vy,
        vy + dt * (-sin_psi * sin_phi - sin_theta * cos_phi * cos_psi) * thrust,
        z + dt * vz,
        vz + dt * (cos_theta * cos_phi * thrust - gravity),
        phi + dt * (p + sin_theta / cos_theta * turning),
        p + dt * (q * r * a1 - a2 * q + a3 * roll),
        theta + dt * (q * cos_phi - r * sin_phi),
        q + dt * (p * r * a4 + r * a5 + a6 * pitch),
        psi + dt * turning / cos_theta,
        r + dt * (p * q * a7 + a8 * yaw),
    )


def trajectories(case: Case, alphas: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The states of one shot for each row of `alphas` (shots, 8) and `first` (shots, 12): (shots, steps + 1, 12).

    Complex parameters or states give complex trajectories, for derivatives by complex steps.
    """
    kind = np.result_type(alphas, first)
    states = np.empty((len(case.forcing) + 1, 12, len(alphas)), dtype=kind)
    states[0], parameters = first.T, alphas.T
    with np.errstate(all="ignore"):  # a trajectory that diverges is found by its cost
        for k, forcing in enumerate(case.forcing):
            states[k + 1] = step(np, states[k], forcing, parameters, case.dt, case.gravity)
    return np.moveaxis(states, -1, 0)


def costs(case: Case, alphas: np.ndarray, first: np.ndarray, columns: slice | list[int] = ALL) -> np.ndarray:
    """1/2 |W (y - x)|^2 of each flight at its parameters (flights, 8) and initial state (flights, 12)."""
    with np.errstate(all="ignore"):
        errors = (case.measured - trajectories(case, alphas, first)) / case.sigma
        return 0.5 * np.square(errors[:, case.begin :, columns]).sum(axis=(1, 2))
