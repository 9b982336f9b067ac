"""Sine and cosine in one polynomial evaluation that vectorises over a batch of lanes (see docs/measured.md)."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float

from .batching import computed_once

# pi/2 in short parts: k * part is exact for |k| < 2**20 (2**13 in single precision). Reference: Cody and Waite.
_HALF_PI_DOUBLE = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_HALF_PI_SINGLE = (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8)
# Taylor coefficients in r^2: for |r| <= pi/4 the truncation error is below half an ulp of double precision.
_SIN = tuple((-1) ** i / math.factorial(2 * i + 1) for i in range(8))
_COS = tuple((-1) ** i / math.factorial(2 * i) for i in range(9))


@jax.jit  # traced once for all its calls in a program
def sincos(x: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """`(sin(x), cos(x))` to about one ulp, for angles x [rad] of less than a million turns; NaN if x is not finite."""
    return _sincos(x)


@jax.custom_jvp
def _sincos(x: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    return _once(x) if jax.default_backend() == "cpu" else _polynomials(x)


@custom_vmap
def _once(x: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    number = x.ravel()[:1]
    always = (number == number) | (number != number)  # unknown to XLA, as a number may be NaN
    return computed_once(always, lambda: _polynomials(x))


@_once.def_vmap
def _once_for_batch(lanes: int, is_batched: list[bool], x: Float[Array, "..."]) -> tuple[Any, Any]:
    """The same, because a conditional that JAX batches is none."""
    del lanes, is_batched
    return _once(x), (True, True)


def _polynomials(x: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    quarter = jnp.round(x * (2 / math.pi))
    r = x
    for part in _HALF_PI_SINGLE if x.dtype == jnp.float32 else _HALF_PI_DOUBLE:
        r = r - quarter * part
    squared = r * r
    sin = r * _horner(_SIN, squared)
    cos = _horner(_COS, squared)
    quadrant = quarter - 4 * jnp.floor(quarter / 4)
    odd = (quadrant == 1) | (quadrant == 3)
    sin, cos = jnp.where(odd, cos, sin), jnp.where(odd, sin, cos)
    return jnp.where(quadrant >= 2, -sin, sin), jnp.where((quadrant == 1) | (quadrant == 2), -cos, cos)


@_sincos.defjvp
def _sincos_jvp(primals, tangents):
    sin, cos = _sincos(*primals)
    (dx,) = tangents
    return (sin, cos), (cos * dx, -sin * dx)


def _horner(coefficients: tuple[float, ...], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """The polynomial with these coefficients, lowest power first."""
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total
