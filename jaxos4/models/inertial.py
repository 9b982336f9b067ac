"""A model whose parameters are moments of inertia."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Scalar
from ..airframe import Airframe, alpha_scalars
from ..flight import Inputs
from .abstract import PARAMETER_NAMES, AbstractModel, Parameter
from .state import Forcing, Rates, State


class InertialOS4(AbstractModel):
    """`PublishedOS4` or `CorrectedOS4` with the parameters Ix, Iy, Iz and J_R instead of the eight alphas.

    The eight alphas of a rigid body follow from these four constants (the definitions below Eq. (13)), so an estimate
    of the four is more precise.

    **Raises:** `ValueError` for another model.
    """

    model: AbstractModel

    def __init__(self, model: AbstractModel):
        if model.parameter_names != PARAMETER_NAMES:
            raise ValueError("`model` must have the parameters alpha_1..8: give PublishedOS4 or CorrectedOS4.")
        self.model = model

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Ix, Iy, Iz and J_R. The alphas are ratios of inertias, and proportional to J_R or independent of it."""
        inertias = (Parameter(name, "kg m^2", linear=False) for name in ("Ix", "Iy", "Iz"))
        return (*inertias, Parameter("J_R", "kg m^2"))

    @property
    def alpha(self) -> Float[Array, "4"]:
        """Ix, Iy, Iz, J_R of the airframe [kg m^2]."""
        return jnp.append(jnp.asarray(self.airframe.inertia), jnp.asarray(self.airframe.rotor_inertia))

    @property
    def half_width(self) -> Float[Array, "4"]:
        """30 % of each inertia, and for J_R the width that the inner bracket has for alpha2. It may exceed J_R."""
        inertia = jnp.asarray(self.airframe.inertia)
        return jnp.append(0.3 * inertia, self.model.half_width[1] * inertia[0] / self.model.gyroscopic_factor)

    def inner(self, parameters) -> tuple[Scalar, ...]:
        """alpha_1..8 of these constants."""
        ix, iy, iz, rotor = parameters
        return alpha_scalars(ix, iy, iz, rotor * self.gyroscopic_factor)

    @property
    def airframe(self) -> Airframe:  # pyright: ignore[reportIncompatibleVariableOverride]
        """See `AbstractModel`."""
        return self.model.airframe

    @property
    def gyroscopic_factor(self) -> Scalar:
        """See `AbstractModel`."""
        return self.model.gyroscopic_factor

    @property
    def force_axes(self) -> tuple[int, ...]:
        """See `AbstractModel`."""
        return self.model.force_axes

    @property
    def observes_states(self) -> bool:
        """See `AbstractModel`."""
        return self.model.observes_states

    def forcing(self, inputs: Inputs, parameters) -> Forcing:
        """See `AbstractModel`."""
        return self.model.forcing(inputs, jnp.stack(self.inner(tuple(parameters))))

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """See `AbstractModel`."""
        return self.model.angular_acceleration(rates, forcing, self.inner(parameters))

    def cascade(self, state: State, forcing: Forcing, parameters) -> State:
        """See `AbstractModel`."""
        return self.model.cascade(state, forcing, self.inner(parameters))

    def observe(self, state: State, forcing: Forcing, parameters) -> tuple[Scalar, ...]:
        """See `AbstractModel`."""
        return self.model.observe(state, forcing, self.inner(parameters))
