"""A batch of flights in lanes: how `jax.vmap` computes what takes long.

By itself, `jax.vmap` computes all flights of a batch together, with the batch along the first axis. Its loops then
take as long as the slowest flight, its arrays do not fit the cache, and the processor's vectors hold the unknowns of
one flight instead of one unknown of several flights.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool

# The most lanes of a block: two to four of the processor's vectors. In 64 lanes a flight takes up to twice as long.
_BLOCK = 16


def with_batch(function: Callable, of_batch: Callable[[int, Any, Any], Any], *arguments: Any) -> Any:
    """`function(*arguments)`, of which `jax.vmap` computes a batch by `of_batch`.

    `of_batch` receives the number of lanes, the arguments that differ between the lanes, with the lanes along their
    first axis, and the arguments that the lanes share. Each is `None` in the place of the other. It returns the results
    with the lanes along their first axis.
    """
    arrays, settings = eqx.partition(arguments, eqx.is_array)

    @custom_vmap
    def one(arrays: Any) -> Any:
        return function(*eqx.combine(arrays, settings))

    @one.def_vmap
    def batch(lanes: int, is_batched: list, arrays: Any) -> tuple[Any, Any]:
        many, shared = eqx.partition(arrays, is_batched[0])
        out = of_batch(lanes, many, eqx.combine(shared, settings))
        return out, jax.tree.map(lambda _: True, out)

    return one(arrays)


def in_blocks(function: Callable, *arguments: Any) -> Any:
    """`function(*arguments)`, of which `jax.vmap` computes a batch in blocks, one after the other.

    A slow flight then holds up its block only. The last lane is repeated until all blocks are full. An accelerator
    computes the whole batch at once. `function` may be a method; the arrays of its module are batched as arguments are.
    """
    arrays, settings = eqx.partition((function, *arguments), eqx.is_array)

    @jax.jit  # traced once, although a batch calls it twice
    def one(arrays: Any) -> Any:
        function, *arguments = eqx.combine(arrays, settings)
        return function(*arguments)

    blocked = custom_vmap(one)

    @blocked.def_vmap
    def batch(lanes: int, is_batched: list, arrays: Any) -> tuple[Any, Any]:
        many, shared = eqx.partition(arrays, is_batched[0])
        blocks = max(-(-lanes // _BLOCK), 1) if jax.default_backend() == "cpu" else 1
        size = -(-lanes // blocks)

        def block(many: Any) -> Any:
            return jax.vmap(lambda each: one(eqx.combine(each, shared)))(many)

        def cut(leaf: Array) -> Array:
            more = jnp.repeat(leaf[-1:], blocks * size - lanes, axis=0)
            return jnp.concatenate([leaf, more]).reshape(blocks, size, *leaf.shape[1:])

        if blocks == 1:
            out = block(many)
        else:
            out = jax.lax.map(block, jax.tree.map(cut, many))
            out = jax.tree.map(lambda leaf: leaf.reshape(blocks * size, *leaf.shape[2:])[:lanes], out)
        return out, jax.tree.map(lambda _: True, out)

    return blocked(arrays)


def computed_once(needed: Bool[Array, " lanes"], function: Callable[[], Any]) -> Any:
    """`function()` if any lane needs it, else zeros.

    XLA repeats elementwise operations wherever their result is used, so what is common to all unknowns would be
    computed for each of them. It does not repeat a conditional.
    """
    structure = None

    def leaves() -> list[Array]:
        nonlocal structure
        values, structure = jax.tree.flatten(function())
        return values

    zeros = [jnp.zeros(value.shape, value.dtype) for value in jax.eval_shape(leaves)]
    values = jax.lax.cond(needed.any(), leaves, lambda: zeros)
    return jax.tree.unflatten(structure, values)
