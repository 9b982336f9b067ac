"""A flight simulated at the answer of a fit, with all first derivatives: what every check of a fit is computed from.

The simulation is one compiled program, and NumPy computes the rest. The covariance of a fit is the Cramer-Rao bound,
or the sandwich covariance if residuals are coloured, or not as large as sigma says. `identifiability` says which
parameters the flight can identify, and for each of the others the reason why not.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Covariance, InitialStates, Parameters, as_float
from ..bracket import Bracket, is_identifiable
from ..linalg import covariance_of_shared, inverses
from ..models.state import CHANNELS
from ..results import NINETY_FIVE
from ..shooting import FASTEST, ShootingProblem, padded

Spread = Float[np.ndarray, "parameters parameters"]
PerParameter = Float[np.ndarray, " parameters"]


class Evaluation(NamedTuple):
    """A flight simulated at `parameters`, as NumPy arrays. Made by `jaxos4.evaluate`.

    - `problem`: its sigma gives the weights.
    - `measured`, `predicted`: what sensors measured (NaN: missing), and what noise-free sensors measure.
    - `slopes`: the derivative of `predicted` in the parameters, then in the initial state of the sample's window.
    - `torques`: roll, pitch and yaw torque [N m].
    - `nominal`: the parameters that the airframe implies.
    """

    problem: ShootingProblem
    parameters: Float[np.ndarray, " parameters"]
    measured: Float[np.ndarray, "samples columns"]
    predicted: Float[np.ndarray, "samples columns"]
    slopes: Float[np.ndarray, "unknowns samples columns"]
    torques: Float[np.ndarray, "samples 3"]
    nominal: Float[np.ndarray, " parameters"]

    @property
    def feasible(self) -> bool:
        """Whether what noise-free sensors measure is finite to its end, without a pitch angle of 90 degrees."""
        states = self.predicted[:, : self.problem.size]
        if not np.isfinite(states).all() or (np.abs(states[:, : CHANNELS["rates"]]) >= FASTEST).any():
            return False
        theta = states[:, 4:5]  # in cascade order; none if only rates are simulated
        return bool((np.abs(theta) < np.pi / 2).all())

    @property
    def sigma(self) -> Float[np.ndarray, " columns"]:
        """The standard deviation of the noise in each column."""
        return np.asarray(self.problem.sigma, dtype=np.float64)[self.problem.columns]

    @property
    def errors(self) -> Float[np.ndarray, "samples columns"]:
        """The weighted residuals; 0 for a missing measurement."""
        return np.where(np.isnan(self.measured), 0.0, (self.measured - self.predicted) / self.sigma)

    @property
    def cost(self) -> float:
        """1/2 |W (y - x)|^2; infinite if the trajectory is not feasible."""
        return float(np.square(self.errors).sum() / 2) if self.feasible else float("inf")

    @property
    def jacobian(self) -> Float[np.ndarray, "windows unknowns residuals"]:
        """The weighted `slopes` of each window; 0 for a missing measurement, and after the end of a shorter window."""
        index, within = self.problem.window_samples()
        weighted = np.where(np.isnan(self.measured), 0.0, self.slopes / self.sigma)
        cut = weighted[:, index] * within[:, :, None]
        return np.swapaxes(cut, 0, 1).reshape(len(index), len(weighted), -1)

    @property
    def information(self) -> Float[np.ndarray, "windows unknowns unknowns"]:
        """The Fisher information of each window, in the parameters and the window's own initial state."""
        jacobian = self.jacobian
        return jacobian @ np.swapaxes(jacobian, 1, 2)

    @property
    def fisher_information(self) -> Float[np.ndarray, "parameters parameters"]:
        """J^T W^2 J in the parameters, which all windows share; free initial states are eliminated."""
        information, count = self.information, self.parameters.size
        cross, own = information[:, count:, :count], information[:, count:, count:]
        left = (information[:, :count, :count] - np.swapaxes(cross, 1, 2) @ inverses(own) @ cross).sum(axis=0)
        return (left + left.T) / 2  # rounding makes the inverse asymmetric, and solvers read one half of a matrix

    @property
    def covariance(self) -> Spread:
        """The Cramer-Rao bound of the parameters; infinite if the trajectory is not feasible."""
        count = self.parameters.size
        return inverses(self.fisher_information) if self.feasible else np.full((count, count), np.inf)


def evaluate(
    problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates | None = None
) -> Evaluation:
    """Simulate a flight with all first derivatives; `initial_state`: by default as measured. Raises `ValueError`."""
    for name, value, length in (
        ("parameters", parameters, len(problem.model.parameter_names)),
        ("initial_state", initial_state, problem.windows * problem.size),
    ):
        if value is not None and np.shape(value) != (length,):
            raise ValueError(f"`{name}` must be of shape ({length},), got {np.shape(value)}.")
    parameters, samples = as_float(parameters), problem.flight.time.shape[0]
    flown = _fly(padded(problem), parameters, initial_state)
    # In double precision from here on: a difference of information matrices would lose the digits of single precision.
    predicted, slopes, torques, nominal = (np.asarray(x, dtype=np.float64) for x in flown)
    return Evaluation(
        problem=problem,
        parameters=np.asarray(parameters, dtype=np.float64),
        measured=problem.recorded().astype(np.float64),
        predicted=predicted[:samples],
        slopes=slopes[:, :samples],
        torques=torques[:samples],
        nominal=nominal,
    )


@eqx.filter_jit
def _fly(
    problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates | None
) -> tuple[Array, Float[Array, "unknowns samples columns"], Float[Array, "samples 3"], Parameters]:
    """`predicted`, `slopes`, `torques` and `nominal` of an `Evaluation`."""
    start = problem.first_state()[0] if initial_state is None else as_float(initial_state)
    count, free = parameters.shape[0], problem.free_size

    def outputs(step: Float[Array, " unknowns"]) -> Float[Array, "samples columns"]:
        # All initial states take the same step: a sample depends on the initial state of its own window only.
        starts = problem.split(start) + (step[count:] if free else 0.0)
        return problem.predict(parameters + step[:count], starts.ravel())

    here = jnp.zeros(count + free, dtype=parameters.dtype)

    def along(_, direction: Float[Array, " unknowns"]):
        return jax.jvp(outputs, (here,), (direction,))

    # One unknown after another, with a loop: one simulation is compiled, and the memory holds no copies of the flight.
    predicted, slopes = jax.lax.scan(along, jnp.zeros_like(problem.measured()), jnp.eye(count + free, dtype=here.dtype))
    return predicted, slopes, jnp.stack(problem.forcing(parameters)[:3], axis=1), problem.model.alpha


@eqx.filter_jit
def cramer_rao_bound(
    problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates | None = None
) -> Covariance:
    """The smallest covariance that an unbiased estimate can have: the inverse of the Fisher information J^T W^2 J.

    J is the Jacobian at `parameters` and a free `initial_state`, by default as measured, W the weights 1 / sigma. A
    parameter that is not excited has a huge variance, but not an infinite one.
    """
    start = problem.first_state()[0] if initial_state is None else as_float(initial_state)
    information = problem.local_model(problem.join(as_float(parameters), start)).information
    return covariance_of_shared(information, parameters.shape[0])


def robust_covariance(evaluation: Evaluation) -> Spread:
    """The covariance of fitted parameters, F^-1 (sum_t sum_s J_t^T R(t, s) J_s) F^-1, from the residuals of the fit.

    F is the Fisher information, J the Jacobian of the weighted residuals, and R their autocovariance, between channels
    too. The residuals are taken as the noise, and lack slow noise that the fit explained as motion: a flight must be
    many times longer than the noise's correlation time. The noise is assumed to be stationary. With 20 windows or more
    of at most 4,000 residuals each, it is assumed instead to have the same covariance in all windows.

    **Returns:** the covariance; infinite if the trajectory diverges or nothing was measured.

    Reference: Klein and Morelli, Aircraft System Identification, chapter 6. Coverage: `docs/measured.md`.
    """
    count, measured = evaluation.parameters.size, ~np.isnan(evaluation.measured)
    if not (evaluation.feasible and measured.any()):
        return np.full((count, count), np.inf)
    jacobian, information, shared = evaluation.jacobian, evaluation.information, evaluation.covariance
    cross, own = information[:, count:, :count], information[:, count:, count:]
    sensitivity = np.concatenate(
        [np.broadcast_to(shared, (len(cross), count, count)), -inverses(own) @ cross @ shared], 1
    )
    # The change of each estimated parameter with each weighted residual.
    moves = np.swapaxes(jacobian, 1, 2) @ sensitivity
    index, within = evaluation.problem.window_samples()
    errors, measured = (x[index] * within[:, :, None] for x in (evaluation.errors, measured.astype(float)))
    if len(index) >= 20 and moves.shape[1] <= 4000:
        return _window_by_window(errors.reshape(len(index), -1), measured.reshape(len(index), -1), moves)
    return _stationary(errors[within], measured[within], moves.reshape(*errors.shape, count)[within])


def _stationary(errors: np.ndarray, measured: np.ndarray, moves: np.ndarray) -> Spread:
    """The covariance for stationary noise, with Bartlett's weights for lags up to a tenth of the flight; time first."""
    samples, length = errors.shape[0], 2 * errors.shape[0]

    def products(x: Float[np.ndarray, "samples columns"]) -> Float[np.ndarray, "lags columns columns"]:
        """Sums over all pairs of samples at each lag."""
        transform = np.fft.rfft(x, length, axis=0)
        return np.fft.irfft(transform[:, :, None] * np.conj(transform[:, None, :]), length, axis=0)

    lag = np.minimum(np.arange(length), length - np.arange(length))
    pairs = np.maximum(np.round(products(measured)), 1) / (1 - np.minimum(lag, samples - 1) / samples)[:, None, None]
    weights = np.maximum(1 - lag / (0.1 * samples), 0.0)
    spectrum = np.fft.rfft(weights[:, None, None] * products(errors) / pairs, axis=0)
    slopes = np.fft.rfft(moves, length, axis=0)
    density = np.swapaxes(np.conj(slopes), 1, 2) @ spectrum @ slopes
    return np.fft.irfft(density, length, axis=0)[0]


def _window_by_window(errors: np.ndarray, measured: np.ndarray, moves: np.ndarray) -> Spread:
    """The covariance for many windows: the residuals of the windows are draws of one random vector.

    Residuals are not stationary: the initial state of a window absorbs slow noise, more at its ends.
    """

    def contribution(apart: int) -> Spread:
        """The contribution of all pairs of windows that are `apart` windows apart."""
        count = len(moves) - apart
        pairs = measured[:count].T @ measured[apart:]
        covariance = errors[:count].T @ errors[apart:] / np.maximum(pairs, 1)
        return np.tensordot(moves[:count], covariance @ moves[apart:], axes=((0, 1), (0, 1)))

    following = contribution(1)
    # Bartlett's weight of neighbours is one half.
    return contribution(0) + (following + following.T) / 2


_PARTNER = 0.2  # a parameter with this share of a weakly determined direction is named as a partner


class Identifiability(eqx.Module):
    """The information that a flight contains about each parameter, compared with its bracket.

    - `nominal`: the value of each parameter that the airframe implies.
    - `half_width`: half-widths of the bracket.
    - `std`: the Cramer-Rao bound, as standard deviations in the units of the parameters.
    - `std_alone`: the Cramer-Rao bound if all other parameters were known.
    - `eigenvalues`: of the information in half-widths, in increasing order. Below 1 the flight contains less
      information about that direction than the bracket.
    - `directions`: the eigenvectors in half-widths, one in each column.
    """

    nominal: PerParameter
    half_width: PerParameter
    std: PerParameter
    std_alone: PerParameter
    eigenvalues: PerParameter
    directions: Spread

    @property
    def identifiable(self) -> Bool[np.ndarray, " parameters"]:
        """Whether each parameter is identifiable, by the rule of `jaxos4.bracket.is_identifiable`."""
        return is_identifiable(self.std, self.half_width)  # pyright: ignore[reportReturnType]

    @property
    def excited(self) -> Bool[np.ndarray, " parameters"]:
        """Whether each parameter would be identifiable if all others were known."""
        return is_identifiable(self.std_alone, self.half_width)  # pyright: ignore[reportReturnType]

    @property
    def noise_limit(self) -> PerParameter:
        """The largest noise, in multiples of sigma, at which the 95 % interval of the nominal value excludes 0."""
        return np.abs(self.nominal) / (NINETY_FIVE * self.std)

    def notes(self, names: tuple[str, ...]) -> dict[str, str]:
        """A note for each parameter that is not identifiable or below the noise floor."""

        def note(i: int) -> str:
            if not np.isfinite(self.std[i]):
                return "not identifiable: the trajectory is not finite, or the bracket is not valid"
            if not self.excited[i]:
                return "not identifiable: not excited"
            if not self.identifiable[i]:
                vectors = self.directions / np.sqrt(np.maximum(self.eigenvalues, 1e-300))
                weakest = np.abs(vectors[:, np.argmax(np.abs(vectors[i]))])
                share = weakest / weakest.max()  # that changes together with least effect on the flight
                partners = np.flatnonzero((share > _PARTNER) & (np.arange(share.size) != i)).tolist()
                partners = partners or [int(np.argsort(share)[-2])]
                return f"not identifiable: only together with {', '.join(names[j] for j in partners)}"
            if self.noise_limit[i] < 1 and self.nominal[i] != 0:
                limit = f"{self.noise_limit[i]:.2g} times this noise"
                return f"below the noise floor: can be distinguished from 0 below {limit}"
            return ""

        return {name: text for i, name in enumerate(names) if (text := note(i))}


def identifiability(evaluation: Evaluation, bracket: Bracket) -> Identifiability:
    """Analyse which parameters of the problem's model its flight can identify, at the problem's sigma.

    - `evaluation`: the flight, evaluated where the information is computed.
    - `bracket`: its half-widths say how well each parameter is known without the flight.

    Standard deviations are infinite if the trajectory diverges or the bracket is not valid. Raises `ValueError` for a
    bracket of another length.
    """
    if bracket.lower.shape != evaluation.nominal.shape:
        raise ValueError(f"`bracket` must hold {evaluation.nominal.size} parameters, got {bracket.lower.shape[0]}.")
    nominal, half_width = evaluation.nominal, np.asarray(bracket.half_width)
    valid = bool(((half_width > 0) & np.isfinite(half_width)).all())
    feasible = valid and evaluation.feasible
    if not evaluation.feasible:
        evaluation = evaluate(evaluation.problem, as_float(nominal))
    half_width = half_width if valid else np.ones_like(nominal)
    information = evaluation.fisher_information
    scaled = np.nan_to_num(information * half_width[:, None] * half_width, posinf=0.0, neginf=0.0)
    eigenvalues, directions = np.linalg.eigh(scaled)
    diagonal = np.diagonal(information)
    with np.errstate(divide="ignore"):
        alone = np.where(diagonal > 0, 1 / np.sqrt(np.maximum(diagonal, 0.0)), np.inf)
    std = np.sqrt(np.diagonal(inverses(information)))
    if not feasible:
        std = alone = np.full_like(std, np.inf)
    return Identifiability(nominal, half_width, std, alone, np.maximum(eigenvalues, 0.0), directions)
