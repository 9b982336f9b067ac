"""The constants of a rigid body from a fit: Ix, Iy, Iz, J_R from alpha_1..8, and the place of the centre of mass."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from ..airframe import INVERSES, PITCH, ROLL, Airframe
from ..linalg import inverses, unit_eigen
from ..models.abstract import PARAMETER_NAMES, AbstractModel

# The definitions below Eq. (13): alpha_i = (_OFFSET + _NUMERATOR @ constants)_i / constants[_DENOMINATOR_i], with
# J_R in multiples of the model's gyroscopic factor.
_DENOMINATOR = np.array([0, 0, 0, 1, 1, 1, 2, 2])
_OFFSET = np.array([0, 0, 1.0, 0, 0, 1.0, 0, 1.0])
_NUMERATOR = np.zeros((8, 4))
_NUMERATOR[0, [1, 2]] = _NUMERATOR[3, [2, 0]] = _NUMERATOR[6, [0, 1]] = 1.0, -1.0
_NUMERATOR[[1, 4], 3] = 1.0
_TRIANGLE = np.ones((3, 3)) - 2 * np.eye(3)
# A coordinate of the centre of mass [m] is the slope of torque over thrust, divided by an alpha and the mass, with this
# sign.
_COORDINATES = (("x", "pitch_thrust", PITCH.inverse, 1.0), ("y", "roll_thrust", ROLL.inverse, -1.0))


class InertiaFit(eqx.Module):
    """The rigid body that explains eight alphas best; or one for each row of a batch.

    - `constants`: Ix, Iy, Iz, J_R [kg m^2].
    - `covariance`: covariance of the constants.
    - `mismatch`: (alpha - alpha(constants))^T C^-1 (alpha - alpha(constants)). If the alphas are those of a rigid body,
      it is chi-squared distributed with four degrees of freedom.
    - `p_value`: the probability that the alphas of a rigid body have this mismatch or a larger one.
    - `is_rigid_body`: whether Iy + Iz - Ix, Iz + Ix - Iy and Ix + Iy - Iz are positive within two standard deviations.
    """

    constants: Float[np.ndarray, "*batch 4"]
    covariance: Float[np.ndarray, "*batch 4 4"]
    mismatch: Float[np.ndarray, "*batch"]
    p_value: Float[np.ndarray, "*batch"]
    is_rigid_body: Bool[np.ndarray | np.bool_, "*batch"]

    @property
    def std(self) -> Float[np.ndarray, "*batch 4"]:
        """Standard deviation of each constant."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))


def fit_inertia(
    model: AbstractModel, alpha: Float[ArrayLike, "..."], covariance: Float[ArrayLike, "..."]
) -> InertiaFit:
    """Fit four constants to eight alphas by weighted least squares (Gauss-Newton).

    **Arguments:** a `model` with the parameters alpha_1..8, and `alpha`, `covariance` of an estimate or of a batch.

    **Returns:** the fit. If the inputs are not finite, or no positive inertias fit them: the constants of the airframe,
    with an infinite covariance and mismatch and a `p_value` of 0.

    **Raises:** `ValueError` for other shapes or another model.
    """
    if model.parameter_names != PARAMETER_NAMES:
        raise ValueError("`model` must have the parameters alpha_1..8: give PublishedOS4 or CorrectedOS4.")
    alpha, covariance = np.asarray(alpha, dtype=float), np.asarray(covariance, dtype=float)
    shapes = alpha.shape, covariance.shape
    if shapes[0][-1:] != (8,) or shapes[1][-2:] != (8, 8):
        raise ValueError("`alpha`, `covariance` must end in the shapes (8,), (8, 8), got {}, {}.".format(*shapes))
    usable = np.asarray(np.isfinite(alpha).all(axis=-1) & np.isfinite(covariance).all(axis=(-2, -1)))
    factor, inertia = float(model.gyroscopic_factor), np.asarray(model.airframe.inertia, dtype=float)
    airframe = np.append(inertia, float(model.airframe.rotor_inertia))
    alpha = np.where(usable[..., None], alpha, _alphas(airframe * [1, 1, 1, factor]))
    # W with W C W^T = 1; directions without variance count as known to rounding errors.
    scale, values, vectors = unit_eigen(np.where(usable[..., None, None], covariance, np.eye(8)))
    whiten = np.swapaxes(vectors, -1, -2) / np.sqrt(values)[..., :, None] / scale[..., None, :]
    with np.errstate(all="ignore"):
        constants, curvature, residuals = _gauss_newton(alpha, whiten, inertia)
        spread = inverses(curvature)
        mismatch = np.square(residuals).sum(axis=-1)
    fitted = usable & np.isfinite(spread).all(axis=(-2, -1)) & np.isfinite(mismatch) & (constants[..., :3] > 0).all(-1)
    in_factors = np.array([1, 1, 1, factor])
    constants = np.where(fitted[..., None], constants / in_factors, airframe)
    spread = np.where(fitted[..., None, None], spread / (in_factors[:, None] * in_factors), np.inf)
    mismatch = np.where(fitted, mismatch, np.inf)
    finite = np.where(fitted[..., None, None], spread, 0.0)[..., :3, :3]
    variance = np.einsum("ij,...jk,ik->...i", _TRIANGLE, finite, _TRIANGLE)
    room = np.where(fitted[..., None], 2 * np.sqrt(np.maximum(variance, 0.0)), np.inf)
    return InertiaFit(
        constants=constants,
        covariance=spread,
        mismatch=mismatch,
        # The chi-squared distribution with four degrees of freedom in closed form.
        p_value=np.where(fitted, np.exp(-mismatch / 2) * (1 + np.where(fitted, mismatch, 0.0) / 2), 0.0),
        is_rigid_body=(constants[..., :3] @ _TRIANGLE > -room).all(axis=-1),
    )


def _alphas(constants: np.ndarray) -> np.ndarray:
    return (constants @ _NUMERATOR.T + _OFFSET) / constants[..., _DENOMINATOR]


def _gauss_newton(alpha: np.ndarray, whiten: np.ndarray, inertia: np.ndarray) -> tuple[np.ndarray, ...]:
    """The constants, the curvature of the cost, and the weighted residuals, after 20 steps, which are enough.

    It starts at the reciprocals of alpha3, 6, 8 if they are within a factor of 100 of the airframe's inertia.
    """
    first = 1 / alpha[..., INVERSES]
    first = np.where((first > inertia / 100) & (first < 100 * inertia), first, inertia)
    rotor = (alpha[..., 1] * first[..., 0] + alpha[..., 4] * first[..., 1]) / 2
    constants = np.concatenate([first, rotor[..., None]], axis=-1)

    def linearised(constants: np.ndarray) -> tuple[np.ndarray, ...]:
        predicted = _alphas(constants)
        slopes = _NUMERATOR - predicted[..., None] * np.eye(4)[_DENOMINATOR]
        slopes = whiten @ (slopes / constants[..., _DENOMINATOR, None])
        residuals = (whiten @ (alpha - predicted)[..., None])[..., 0]
        return slopes, np.swapaxes(slopes, -1, -2) @ slopes, residuals

    for _ in range(20):
        slopes, curvature, residuals = linearised(constants)
        gradient = np.swapaxes(slopes, -1, -2) @ residuals[..., None]
        constants = constants + (inverses(curvature) @ gradient)[..., 0]
    return constants, *linearised(constants)[1:]


class CenterOfMass(NamedTuple):
    """A coordinate of the centre of mass, x forward or y left of the rotor positions' origin, and its `std` [m]."""

    axis: str
    value: float
    std: float


def center_of_mass(
    names: Sequence[str], parameters: Float[ArrayLike, " n"], covariance: Float[ArrayLike, "n n"], airframe: Airframe
) -> tuple[CenterOfMass, ...]:
    """The coordinates of the centre of mass whose parameters were estimated; none without the term `center_of_mass`.

    Rotors of unequal thrust cause the same torque: 5 % more thrust of the two left rotors is the same as a centre of
    mass that lies 2.5 % of their y to the right.

    **Arguments:** the names, values and covariance of the estimated parameters, and the airframe (its mass).
    """
    places, values, spread = list(names), np.asarray(parameters, dtype=float), np.asarray(covariance, dtype=float)
    found = []
    for axis, slope, inverse_inertia, sign in _COORDINATES:
        if {slope, inverse_inertia} <= set(places):
            both = [places.index(slope), places.index(inverse_inertia)]
            top, bottom = values[both]
            value = sign * top / (bottom * float(airframe.mass))
            gradient = np.array([sign / (bottom * float(airframe.mass)), -value / bottom])
            std = np.sqrt(gradient @ spread[np.ix_(both, both)] @ gradient)
            found.append(CenterOfMass(axis, float(value), float(std)))
    return tuple(found)
