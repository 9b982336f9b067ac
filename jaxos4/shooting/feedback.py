"""The feedback of a filter: gains of innovations and of input innovations, and their derivatives.

Arrays have the axes (time, channels, segments). A segment is one part of the flight.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .gains import Channels, Gains, Step, basis
from .sums import PerSegment


class InputGains(NamedTuple):
    """The change of the estimates at the end of a sample for a unit of each input innovation, by feedthrough.

    - `driven`: to the rate [rad/s], or to the force besides the model's [m/s^2].
    - `disturbance`: to the disturbance [rad/s^2], or [m/s^2].
    """

    driven: tuple[Float[Array, " channels *segments"], ...]
    disturbance: tuple[Float[Array, " channels *segments"], ...]


class Feedback(NamedTuple):
    """The parts of a filter that depend on the noise, by channel: its `Gains`, `InputGains`, and fields of `Step`."""

    driven: tuple[PerSegment, ...]
    driven_later: tuple[PerSegment, ...]
    disturbance_later: tuple[PerSegment, ...]
    driven_seen: tuple[PerSegment, ...]
    seen: tuple[PerSegment, ...]
    kept: tuple[PerSegment, ...]
    driven_kept: tuple[PerSegment, ...]
    reach: tuple[PerSegment, ...]
    by_input: InputGains

    @classmethod
    def of(cls, gains: Gains, step: Step, by_input: InputGains) -> "Feedback":
        """The feedback by these gains, over one step."""
        fields = gains.driven, gains.driven_later, gains.disturbance_later, step.driven_seen, step.seen
        return cls(*map(tuple, (*fields, *step.transition)), by_input=by_input)


def by_inputs(gains: tuple[Array, ...], inputs: Float[Array, "feedthroughs channels segments"]) -> Channels:
    """The change of an estimate by input innovations, by channel."""
    each = (v * (k if k.ndim > 1 else k[:, None]) for k, v in zip(gains, inputs, strict=True))
    return sum(each, jnp.zeros(inputs.shape[1:], dtype=float))


def feedback_slopes(gains: Gains, steps: Step, by_input: InputGains, count: int) -> Feedback:
    """The derivatives of the feedback: 0 in `count` parameters, then in the noise and in the gains of inputs."""
    levels, units = gains.variance.shape[0], basis(by_input)
    of_noise = jax.tree.map(lambda leaf: jnp.zeros((levels, *leaf.shape[1:]), leaf.dtype), units)
    some, more = jax.vmap(Feedback.of)(gains, steps, of_noise), len(jax.tree.leaves(by_input))

    def padded(before: int, after: int, tree: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.pad(leaf, ((before, after), *((0, 0),) * (leaf.ndim - 1))), tree)

    inputs = padded(count, 0, jax.tree.map(lambda a, b: jnp.concatenate([a, b]), of_noise, units))
    return padded(count, more, some)._replace(by_input=inputs)
