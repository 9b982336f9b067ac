"""A plain JAX stepper, the state as one vector, under `vmap`, with optimistix's Levenberg-Marquardt."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optimistix

from experiments.benchmarks.case import Case, step

jax.config.update("jax_enable_x64", True)


def trajectory(case: Case, alpha: jax.Array, first: jax.Array) -> jax.Array:
    """The states of one shot, (steps + 1, 12)."""

    def advance(state: jax.Array, forcing: jax.Array) -> tuple[jax.Array, jax.Array]:
        following = jnp.stack(step(jnp, state, forcing, alpha, case.dt, case.gravity))
        return following, following

    rest = jax.lax.scan(advance, first, jnp.asarray(case.forcing))[1]
    return jnp.concatenate([first[None], rest])


def errors(case: Case, alpha: jax.Array, first: jax.Array, measured: jax.Array) -> jax.Array:
    """W (x - y) of one flight."""
    return ((trajectory(case, alpha, first) - measured) / jnp.asarray(case.sigma))[case.begin :]


def levenberg_marquardt(case: Case) -> Callable[[], dict]:
    """All flights in one call."""
    solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    unknowns = 8 if case.known else 20

    @jax.jit
    @jax.vmap
    def identify(measured: jax.Array, start: jax.Array, begin: jax.Array) -> jax.Array:
        def split(scaled: jax.Array) -> tuple[jax.Array, jax.Array]:
            return start + scaled[:8] * case.half_width, begin if case.known else begin + scaled[8:] * case.sigma

        def residuals(scaled: jax.Array, args: None) -> jax.Array:
            return errors(case, *split(scaled), measured)

        return optimistix.least_squares(residuals, solver, jnp.zeros(unknowns), max_steps=100, throw=False).value

    arguments = tuple(map(jnp.asarray, (case.measured, case.starts, case.first_states())))
    compiled = identify.lower(*arguments).compile()
    return lambda: case.answer(np.asarray(compiled(*arguments)))


def shots(case: Case) -> Callable[[], dict]:
    """The cost of each flight at its start, all in one call."""

    @jax.jit
    @jax.vmap
    def shoot(measured: jax.Array, start: jax.Array, begin: jax.Array) -> jax.Array:
        return 0.5 * jnp.square(errors(case, start, begin, measured)).sum()

    arguments = tuple(map(jnp.asarray, (case.measured, case.starts, case.first_states())))
    compiled = shoot.lower(*arguments).compile()
    return lambda: {"costs": jax.block_until_ready(compiled(*arguments))}
