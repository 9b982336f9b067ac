"""The constants Ix, Iy, Iz, J_R of a rigid body, fitted to alpha_1..8 and their covariance."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._custom_types import Covariance, Parameters, Scalar, as_float
from ..airframe import inertia_from_alpha
from ..linalg import cholesky, invert, invert_factor
from ..models.abstract import AbstractModel
from ..models.inertial import InertialOS4

# Gauss-Newton steps. They converge fast, because the alphas are nearly linear in the constants over their errors.
_STEPS = 20
# The fit starts at the reciprocals of alpha3, 6, 8 if they are within this factor of the airframe's inertia.
_FAR = 100.0


class InertiaFit(eqx.Module):
    """The rigid body that explains eight alphas best.

    - `constants`: Ix, Iy, Iz, J_R [kg m^2].
    - `covariance`: of the constants.
    - `mismatch`: (alpha - alpha(constants))^T C^-1 (alpha - alpha(constants)). If the alphas are those of a rigid body,
      it is chi-squared distributed with four degrees of freedom.
    - `p_value`: the probability that the alphas of a rigid body have this mismatch or a larger one.
    - `triangle`: Iy + Iz - Ix, Iz + Ix - Iy, Ix + Iy - Iz [kg m^2]. No rigid body has a negative one.
    - `triangle_std`: the standard deviations of `triangle`.
    """

    constants: Float[Array, "4"]
    covariance: Float[Array, "4 4"]
    mismatch: Scalar
    p_value: Scalar
    triangle: Float[Array, "3"]
    triangle_std: Float[Array, "3"]

    @property
    def std(self) -> Float[Array, "*batch 4"]:
        """Standard deviation of each constant."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))

    @property
    def is_rigid_body(self) -> Bool[Array, "*batch"]:
        """Whether every triangle inequality holds within two standard deviations."""
        return (self.triangle > -2 * self.triangle_std).all(axis=-1)


@eqx.filter_jit
def fit_inertia(model: AbstractModel, alpha: Parameters, covariance: Covariance) -> InertiaFit:
    """Fit four constants to eight alphas by weighted least squares (Gauss-Newton).

    **Arguments:** a `model` with the parameters alpha_1..8, and `alpha`, `covariance` of an estimate.

    **Returns:** the fit. If the inputs are not finite, or no positive inertias fit them: the constants of the airframe,
    with an infinite covariance and mismatch and a `p_value` of 0.

    **Raises:** `ValueError` for other shapes or another model.
    """
    inertial, alpha, covariance = InertialOS4(model), as_float(alpha), as_float(covariance)
    if alpha.shape != (8,) or covariance.shape != (8, 8):
        raise ValueError(
            f"`alpha`, `covariance` must be of shapes (8,), (8, 8), got {alpha.shape}, {covariance.shape}."
        )
    whiten = invert_factor(cholesky(covariance))
    nominal = jnp.asarray(model.airframe.inertia)
    first, gyroscopic = inertia_from_alpha(alpha)
    first = jnp.where((first > nominal / _FAR) & (first < _FAR * nominal), first, nominal)
    begin = jnp.append(first, gyroscopic / model.gyroscopic_factor)
    scale = jnp.append(first, jnp.sqrt(covariance[1, 1]) * first[0] / model.gyroscopic_factor)

    def residuals(u: Float[Array, "4"]) -> Float[Array, "8"]:
        return whiten @ (alpha - jnp.stack(inertial.inner(tuple(u * scale))))

    def step(u: Float[Array, "4"], _) -> tuple[Float[Array, "4"], None]:
        jacobian = jax.jacfwd(residuals)(u)
        return u - invert(jacobian.T @ jacobian) @ (jacobian.T @ residuals(u)), None

    u, _ = jax.lax.scan(step, begin / scale, length=_STEPS)
    jacobian = jax.jacfwd(residuals)(u)
    spread = invert(jacobian.T @ jacobian) * scale[:, None] * scale[None, :]
    mismatch = jnp.square(residuals(u)).sum()
    constants = u * scale
    fitted = jnp.isfinite(spread).all() & jnp.isfinite(mismatch) & (constants[:3] > 0).all()
    constants = jnp.where(fitted, constants, inertial.alpha)
    spread, mismatch = jnp.where(fitted, spread, jnp.inf), jnp.where(fitted, mismatch, jnp.inf)
    sums = jnp.ones((3, 3)) - 2 * jnp.eye(3)
    return InertiaFit(
        constants=constants,
        covariance=spread,
        mismatch=mismatch,
        p_value=jnp.where(fitted, jax.scipy.special.gammaincc(2.0, mismatch / 2), 0.0),
        triangle=sums @ constants[:3],
        triangle_std=jnp.where(fitted, jnp.sqrt(jnp.diagonal(sums @ spread[:3, :3] @ sums.T)), jnp.inf),
    )
