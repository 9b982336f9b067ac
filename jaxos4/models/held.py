"""A model with some parameters held at known values."""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Parameters, Scalar, as_float
from .abstract import AbstractModel, Parameter
from .reparametrised import AbstractReparametrised


class HeldParameters(AbstractReparametrised):
    """A model with some of its parameters held at known values. `hold` makes one.

    - `model`: the inner model.
    - `held`, `values`: the positions of the held parameters in `model.parameter_names`, and their values.
    """

    model: AbstractModel
    held: tuple[int, ...] = eqx.field(static=True)
    values: Float[Array, " held"]

    def __init__(self, model: AbstractModel, *, held: tuple[int, ...], values: Float[Array, " held"]):
        self.model, self.held, self.values = model, held, as_float(values)

    @property
    def free(self) -> Int[np.ndarray, " free"]:
        """The positions of the remaining parameters in `model.parameter_names`."""
        return np.delete(np.arange(len(self.model.parameters)), list(self.held))

    def without(self, values: Float[Array, " all"]) -> Float[Array, " free"]:
        """The values of the remaining parameters, from one value for each inner parameter."""
        return values[self.free]

    def complete(self, parameters: Float[Array, " free"]) -> Float[Array, " all"]:
        """The inner parameters, from the remaining ones and the held values."""
        return jnp.stack(self.inner(tuple(parameters)))

    def inner(self, parameters) -> tuple[Scalar, ...]:
        """See `AbstractReparametrised`."""
        values = dict(zip(self.free.tolist(), parameters, strict=True))
        values.update(zip(self.held, self.values, strict=True))
        return tuple(values[i] for i in range(len(values)))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The remaining parameters."""
        table = self.model.parameters
        return tuple(table[i] for i in self.free)

    @property
    def alpha(self) -> Parameters:
        """The values of the remaining parameters in the inner model."""
        return self.without(self.model.alpha)

    @property
    def half_width(self) -> Parameters:
        """The widths of the remaining parameters in the inner model."""
        return self.without(self.model.half_width)


def hold(model: AbstractModel, values: Mapping[str, Float[Array, ""] | float]) -> HeldParameters:
    """The model without the parameters named in `values`: `hold(FlightModel(airframe), {"rotor_lag": 0.06})`.

    **Raises:** `ValueError` for a name that the model does not have, or if no parameter remains.
    """
    names = model.parameter_names
    unknown = [name for name in values if name not in names]
    if unknown:
        raise ValueError(f"`values`: the model has no parameter {unknown[0]}; its parameters are {', '.join(names)}.")
    if len(values) == len(names):
        raise ValueError("`values` holds all parameters of the model; leave at least one to estimate.")
    held = tuple(i for i, name in enumerate(names) if name in values)
    known = [as_float(values[names[i]]) for i in held]
    return HeldParameters(model, held=held, values=jnp.stack(known) if known else jnp.zeros(0))
