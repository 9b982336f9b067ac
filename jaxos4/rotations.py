"""Rotations of the body by angles, quaternions and matrices; sine and cosine that vectorise over a batch of lanes.

The order of rotations is that of the paper: yaw, pitch, roll. See docs/measured.md for the polynomials of `sincos`.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float

from ._custom_types import Numeric
from .batching import computed_once

HALF_TURN = np.array([1.0, -1.0, -1.0])
"""About x: from x forward, y right, z down to x forward, y left, z up."""

_Samples = Float[Numeric, "*samples"]
Vector = tuple[_Samples, _Samples, _Samples]
Quaternion = tuple[_Samples, _Samples, _Samples, _Samples]
"""w, x, y, z. An attitude rotates from the axes of the body to the earth's."""


def rotation(angles: Float[Numeric, "3 *samples"]) -> Float[Numeric, "3 3 *samples"]:
    """R_z(psi) R_y(theta) R_x(phi) of the angles phi, theta, psi [rad]: from the axes of the body to the earth's."""
    xp = np if isinstance(angles, np.ndarray) else jnp
    (sx, cx), (sy, cy), (sz, cz) = zip(xp.sin(angles), xp.cos(angles), strict=True)
    rows = (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )
    return xp.stack([xp.stack(row) for row in rows])


def rotations_to_body(angles: Float[np.ndarray, "samples 3"]) -> Float[np.ndarray, "samples 3 3"]:
    """The rotations from the earth's axes to those of the body, of roll, pitch and yaw [rad]."""
    return np.asarray(rotation(angles.T)).T


def angles_of(matrix: Float[np.ndarray, "3 3"]) -> tuple[float, float, float]:
    """Roll, pitch and yaw [rad] of a rotation."""
    roll, yaw = math.atan2(matrix[2, 1], matrix[2, 2]), math.atan2(matrix[1, 0], matrix[0, 0])
    return roll, -math.asin(min(max(matrix[2, 0], -1.0), 1.0)), yaw


def attitude_quaternion(angles: Float[np.ndarray, "samples 3"]) -> Quaternion:
    """The attitude of roll, pitch and yaw [rad]."""
    half, zero = np.stack([np.cos(angles / 2), np.sin(angles / 2)]), np.zeros(len(angles))
    roll, pitch, yaw = ((half[0, :, i], *np.insert([zero, zero], i, half[1, :, i], axis=0)) for i in range(3))
    return quaternion_product(yaw, quaternion_product(pitch, roll))


def quaternion_product(a, b) -> Quaternion:
    """The quaternion of the rotation `b`, and then `a`. NumPy and JAX."""
    (w, x, y, z), (k, j, m, n) = a, b
    return (
        w * k - x * j - y * m - z * n,
        w * j + x * k + y * n - z * m,
        w * m - x * n + y * k + z * j,
        w * n + x * m - y * j + z * k,
    )


def conjugate(a) -> Quaternion:
    """The quaternion of the rotation back."""
    w, x, y, z = a
    return w, -x, -y, -z


def rotated(a, vector) -> Vector:
    """A vector turned by a quaternion: from the body's axes to the earth's, if that is the attitude."""
    w, *axis = a
    b = cross(axis, vector)
    x, y, z = (v + 2 * (w * c + d) for v, c, d in zip(vector, b, cross(axis, b), strict=True))
    return x, y, z


def cross(a, b) -> Vector:
    """The cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def deviation(a, b) -> Vector:
    """Twice the vector part of the rotation from attitude `a` to `b`, in the axes of `a`: [rad] if it is small."""
    w, *vector = quaternion_product(conjugate(a), b)
    x, y, z = (2 * x * (1 - 2 * (w < 0)) for x in vector)
    return x, y, z


def euler_angles(quaternion: Float[np.ndarray, "*samples 4"]) -> Float[np.ndarray, "*samples 3"]:
    """Roll, pitch, yaw [rad] of quaternions (w, x, y, z) of any length, without unwrapping; of zeros, NaN."""
    with np.errstate(all="ignore"):
        w, x, y, z = np.moveaxis(quaternion / np.sqrt((quaternion**2).sum(axis=-1, keepdims=True)), -1, 0)
    phi = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    theta = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.stack([phi, theta, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))], axis=-1)


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
    """Computes a batch in the same conditional: one that JAX batches would be none."""
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
