"""A model whose parameters are moments of inertia."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Scalar
from ..airframe import Airframe, alpha_scalars
from .abstract import PARAMETER_NAMES, AbstractModel
from .state import Attitude, Forcing, Rates


class InertialOS4(AbstractModel):
    """A model's equations with Ix, Iy, Iz and J_R as the parameters, in place of the eight alphas.

    A rigid body has no other alphas than those: four constants that are estimated know more than eight.

    **Arguments:**

    - `model`: `PublishedOS4` or `CorrectedOS4`; its alphas follow from the constants by the definitions below Eq. (13).
    """

    model: AbstractModel

    def __init__(self, model: AbstractModel):
        if not model.is_linear or len(model.parameter_names) != len(PARAMETER_NAMES):
            raise ValueError("`model` must be one in alpha_1..8: PublishedOS4 or CorrectedOS4.")
        self.model = model

    @property
    def airframe(self) -> Airframe:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The inner model's."""
        return self.model.airframe

    @property
    def alpha(self) -> Float[Array, "4"]:
        """Ix, Iy, Iz, J_R of the airframe [kg m^2]."""
        return jnp.append(jnp.asarray(self.airframe.inertia), jnp.asarray(self.airframe.rotor_inertia))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Ix, Iy, Iz, J_R."""
        return ("Ix", "Iy", "Iz", "J_R")

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """All in kg m^2."""
        return ("kg m^2",) * 4

    @property
    def half_width(self) -> Float[Array, "4"]:
        """30 % of each inertia. Of J_R as much as the inner bracket leaves to alpha2: more than itself if need be."""
        ix = jnp.asarray(self.airframe.inertia)[0]
        return jnp.append(
            0.3 * jnp.asarray(self.airframe.inertia), self.model.half_width[1] * ix / self.model.gyroscopic_factor
        )

    @property
    def gyroscopic_factor(self) -> Scalar:
        """The inner model's."""
        return self.model.gyroscopic_factor

    @property
    def is_linear(self) -> bool:
        """No: the alphas are ratios of the constants."""
        return False

    def alphas(self, parameters) -> tuple[Scalar, ...]:
        """alpha_1..8 that the constants imply."""
        ix, iy, iz, rotor = parameters
        return alpha_scalars(ix, iy, iz, rotor * self.gyroscopic_factor)

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """The inner model's, of the alphas."""
        return self.model.angular_acceleration(rates, forcing, self.alphas(parameters))

    def acceleration(self, attitude: Attitude, forcing: Forcing) -> tuple[Scalar, Scalar, Scalar]:
        """The inner model's."""
        return self.model.acceleration(attitude, forcing)
