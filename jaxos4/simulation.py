"""Simulation of a flight from rotor speeds: forward Euler, Runge-Kutta 4, or diffrax's adaptive Tsit5."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from ._custom_types import Parameters, RotorSpeeds, Scalar, States, StateVector, as_float, setting
from .batching import in_blocks
from .errors import check_choice
from .flight import STATE_NAMES, Flight, Inputs
from .models.abstract import AbstractModel
from .models.state import CASCADE_ORDER, Forcing, State, stack, unstack
from .results import RESULTS

S = TypeVar("S")


Stepper = Callable[[AbstractModel, State, Forcing, Parameters | tuple[Scalar, ...], Scalar], State]


def euler_step(model: AbstractModel, state: State, forcing: Forcing, parameters, dt: Scalar) -> State:
    """The paper's discrete model x_{k+1} = x_k + T f(x_k, u_k), of order 1."""
    return along(state, model.cascade(state, forcing, parameters), dt)


def midpoint_step(model: AbstractModel, state: State, forcing: Forcing, parameters, dt: Scalar) -> State:
    """A step by the midpoint rule, of order 2."""
    middle = along(state, model.cascade(state, forcing, parameters), dt / 2)
    return along(state, model.cascade(middle, forcing, parameters), dt)


def rk4_step(model: AbstractModel, state: State, forcing: Forcing, parameters, dt: Scalar) -> State:
    """A step by the classical Runge-Kutta method, of order 4, with a constant forcing."""
    return runge_kutta(lambda state: model.cascade(state, forcing, parameters), state, dt)


def runge_kutta(derivative: Callable[[S], S], state: S, dt: Scalar) -> S:
    """The classical Runge-Kutta step, of order 4."""
    k1 = derivative(state)
    k2 = derivative(along(state, k1, dt / 2))
    k3 = derivative(along(state, k2, dt / 2))
    k4 = derivative(along(state, k3, dt))
    mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
    return along(state, mean, dt)


def along(state: S, derivative: S, dt: Scalar) -> S:
    """The state after `dt` at a constant derivative."""
    return jax.tree.map(lambda x, dx: x + dt * dx, state, derivative)


def _diffrax_step(model: AbstractModel, state: State, forcing: Forcing, parameters, dt: Scalar) -> State:
    with jax.ensure_compile_time_eval():  # here, because it is slow to import, and its constants must not be traced
        import diffrax

    # One solve for each sample holds the input exactly: a lookup by time would read the next sample at a step's end.
    eps = float(jnp.finfo(dt.dtype).eps)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: model.cascade(y, *args)),
        diffrax.Tsit5(),
        t0=0.0,
        t1=dt,
        dt0=dt,
        y0=state,
        args=(forcing, parameters),
        stepsize_controller=diffrax.PIDController(rtol=max(1e-10, 10 * eps), atol=max(1e-12, eps)),
        adjoint=diffrax.DirectAdjoint(),
        max_steps=256,
        throw=False,
    )
    failed = solution.result != diffrax.RESULTS.successful
    return jax.tree.map(lambda y: jnp.where(failed, jnp.nan, y[0]), solution.ys)


METHODS: dict[str, Stepper] = {"euler": euler_step, "rk4": rk4_step, "diffrax": _diffrax_step}


def simulate(
    model: AbstractModel,
    parameters: Parameters,
    omega: RotorSpeeds,
    *,
    dt: Float[ArrayLike, ""],
    initial_state: StateVector | None = None,
    method: str = "euler",
) -> Flight:
    """Simulate a flight of `model` with rotor speeds that are constant over each sample.

    **Arguments:**

    - `parameters`: in the order of `model.parameter_names`.
    - `omega`: rotor speeds of each sample [rad/s], of shape (samples, 4).
    - `dt`: the sample time [s].
    - `initial_state`: X at the first sample, in the order of `STATE_NAMES`; rest at the origin by default.
    - `method`: `"euler"` (the discrete model), `"rk4"`, or `"diffrax"` (continuous time: adaptive, slow, a reference).

    **Returns:** a `Flight`. Its `result` is `successful`, `attitude_singularity` if the pitch angle reached +-90
    degrees, or `nonfinite_trajectory` if a number overflowed. The states are NaN from the failure on.

    **Raises:** `ValueError` that names the argument.
    """
    check_choice("method", method, METHODS)
    start = jnp.zeros(12) if initial_state is None else initial_state
    if jnp.ndim(omega) != 2 or jnp.shape(omega)[1] != 4:
        raise ValueError(f"`omega` must have shape (samples, 4), got {jnp.shape(omega)}; use `vmap` for a batch.")
    for name, value, size in (("parameters", parameters, len(model.parameter_names)), ("initial_state", start, 12)):
        if jnp.shape(value) != (size,):
            raise ValueError(f"`{name}` must have shape ({size},), got {jnp.shape(value)}; use `vmap` for a batch.")
    dt = setting("dt", positive=True)(dt)
    return _in_one_program(_flown, model, as_float(parameters), as_float(omega), dt, as_float(start), method)


_in_one_program = eqx.filter_jit(in_blocks)


def _flown(
    model: AbstractModel, parameters: Parameters, omega: RotorSpeeds, dt: Scalar, start: StateVector, method: str
) -> Flight:
    states = trajectory(model, parameters, omega, dt, start, METHODS[method])
    valid, result = until_failure(states, states[:, STATE_NAMES.index("theta")])
    states = jnp.where(valid[:, None], states, jnp.nan)
    return Flight(time=dt * jnp.arange(omega.shape[0]), omega=omega, states=states, result=result)


def trajectory(
    model: AbstractModel, parameters: Parameters, omega: RotorSpeeds, dt: Scalar, start: StateVector, stepper: Stepper
) -> States:
    """The states of a flight, also after a failure: with derivatives everywhere."""
    scalars = tuple(parameters)

    def step(state: State, forcing: Forcing) -> tuple[State, State]:
        following = stepper(model, state, forcing, scalars, dt)
        return following, following

    first = unstack(start[CASCADE_ORDER])
    forcing = jax.tree.map(lambda leaf: leaf[:-1], model.forcing(Inputs(omega, dt), parameters))
    rest = jax.lax.scan(step, first, forcing)[1]
    return jnp.concatenate([stack(first)[None], stack(rest)])[:, CASCADE_ORDER.argsort()]


def until_failure(
    numbers: Float[Array, "samples columns"], theta: Float[Array, " samples"]
) -> tuple[Bool[Array, " samples"], RESULTS]:
    """The samples before the first whose numbers are not finite, or whose pitch angle is 90 degrees; and the result."""
    finite = jnp.isfinite(numbers).all(axis=1)
    valid = jnp.cumsum(~(finite & (jnp.abs(theta) < jnp.pi / 2))) == 0
    result = RESULTS.where(finite[jnp.argmin(valid)], RESULTS.attitude_singularity, RESULTS.nonfinite_trajectory)
    return valid, RESULTS.where(valid.all(), RESULTS.successful, result)
