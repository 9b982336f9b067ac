"""The runtime type checker of the tests sees every call, also of functions that are defined at each call of others."""

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float, TypeCheckError, jaxtyped
from typechecker import check


def differences(values, annotation):
    """An inner function with this annotation of its argument, defined anew at each call."""

    @jaxtyped(typechecker=check)
    def inner(x: annotation, y: Float[Array, " n"]) -> Float[Array, " n"]:
        return x - y

    return inner(values, jnp.zeros(3))


def test_inner_functions_are_checked_at_each_call():
    vector, anything = Float[Array, " n"], Float[Array, "..."]
    for _ in range(2):
        assert differences(jnp.ones(3), vector).shape == (3,)
        assert differences(jnp.ones((2, 1, 3))[0, 0], anything).shape == (3,)
        with pytest.raises(TypeCheckError, match="parameters"):
            differences(jnp.ones(4), vector)
        with pytest.raises(TypeCheckError, match="parameters"):
            differences(np.ones(3), vector)
        with pytest.raises(TypeCheckError, match="return value"):
            differences(jnp.ones((2, 3)), anything)


def test_functions_that_differ_in_a_default_keep_their_own():
    def made(default):
        @jaxtyped(typechecker=check)
        def inner(x: int = default) -> int:
            return x

        return inner

    assert [made(value)() for value in (1, 2)] == [1, 2]
    with pytest.raises(TypeCheckError):
        made(1)("1")
