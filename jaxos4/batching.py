"""A batch of flights in lanes: how `jax.vmap` computes what takes long.

By itself, `jax.vmap` has the batch along the first axis: its loops take as long as the slowest flight, its arrays do
not fit the cache, and vectors hold the unknowns of one flight instead of one unknown of several.
"""

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool

P = ParamSpec("P")
R = TypeVar("R")

# The most lanes of a block: two to four of the processor's vectors. In 64 lanes a flight takes up to twice as long.
_BLOCK = 16
# The flights of one thread's call. It does not depend on the number of cores, and so the results do not.
_CHUNK = 4 * _BLOCK


def with_batch(function: Callable, of_batch: Callable[[int, Any, Any], Any], *first: Any) -> Callable:
    """`function` with its `first` arguments, as a function of the others: arrays. `jax.vmap` calls `of_batch` instead.

    `of_batch` takes the number of lanes and two trees of all arguments. The first holds those that differ between
    lanes, with the lanes first; the second holds those that all lanes share. In each, the others are `None`. It returns
    the results with the lanes first. Derivatives are those of `function`, of a batch too.
    """
    arrays, settings = eqx.partition(first, eqx.is_array)

    @custom_vmap
    def one(arrays: Any, *others: Any) -> Any:
        # The context in which a batch is traced, so that JAX finds again what `jax.jit` has traced here.
        with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
            return function(*eqx.combine(arrays, settings), *others)

    # Traced once, although JAX asks several times for the batch of what stands in a loop.
    @functools.partial(jax.jit, static_argnums=0, inline=True)
    def together(lanes: int, many: Any, shared: Any) -> Any:
        (own, *others), (same, *common) = many, shared
        return of_batch(lanes, (*own, *others), (*eqx.combine(same, settings), *common))

    differentiable = jax.custom_jvp(one)

    @functools.partial(differentiable.defjvp, symbolic_zeros=True)
    def derivative(primals: Any, tangents: Any) -> Any:
        moves = jax.tree.map(lambda slope: not isinstance(slope, SymbolicZero), tangents)
        moving, fixed = eqx.partition(primals, moves)

        def of_moving(moving: Any) -> Any:
            arrays, *others = eqx.combine(moving, fixed)
            return function(*eqx.combine(arrays, settings), *others)

        return jax.jvp(of_moving, (moving,), (eqx.filter(tangents, moves),))

    @one.def_vmap
    def batch(lanes: int, is_batched: list, *arguments: Any) -> tuple[Any, Any]:
        out = together(lanes, *eqx.partition(arguments, tuple(is_batched)))
        return out, jax.tree.map(lambda _: True, out)

    return functools.partial(differentiable, arrays)


def in_blocks(function: Callable, *arguments: Any) -> Any:
    """`function(*arguments)`. On a CPU, `jax.vmap` of it computes a batch in blocks, one after the other.

    A slow flight then holds up its block only. `function` may be a method; its module's arrays are batched too.
    """
    arrays, settings = eqx.partition((function, *arguments), eqx.is_array)

    @jax.jit  # traced once, although a batch calls it twice
    def one(arrays: Any) -> Any:
        function, *arguments = eqx.combine(arrays, settings)
        return function(*arguments)

    def of_batch(lanes: int, many: Any, shared: Any) -> Any:
        blocks = max(-(-lanes // _BLOCK), 1) if jax.default_backend() == "cpu" else 1
        size = -(-lanes // blocks)

        def block(many: Any) -> Any:
            return jax.vmap(lambda each: one(*eqx.combine(each, shared)))(many)

        def cut(leaf: Array) -> Array:
            more = jnp.repeat(leaf[-1:], blocks * size - lanes, axis=0)
            return jnp.concatenate([leaf, more]).reshape(blocks, size, *leaf.shape[1:])

        if blocks == 1:
            return block(many)
        out = jax.lax.map(block, jax.tree.map(cut, many))
        return jax.tree.map(lambda leaf: leaf.reshape(blocks * size, *leaf.shape[2:])[:lanes], out)

    return with_batch(one, of_batch, arrays)()


def where_needed(needed: Bool[Array, ""], function: Callable[..., R], otherwise: R, *arguments: Any) -> R:
    """`function(*arguments)` if `needed`, else `otherwise`. A batch computes the function if any lane needs it.

    A batch of `jax.lax.cond` always computes both branches; here, only a batch of batches always computes the function.
    The function must not close over arrays that differ between lanes.
    """

    def one(needed: Bool[Array, ""], otherwise: R, *arguments: Any) -> R:
        return jax.lax.cond(needed, function, lambda *_: otherwise, *arguments)

    def of_batch(lanes: int, many: Any, shared: Any) -> R:
        def each_lane(lane: Callable) -> R:
            return jax.vmap(lambda own: lane(*eqx.combine(own, shared)), axis_size=lanes)(many)

        def chosen(needed: Bool[Array, ""], otherwise: R, *arguments: Any) -> R:
            return jax.tree.map(functools.partial(jnp.where, needed), function(*arguments), otherwise)

        any_needed = eqx.combine(many, shared)[0].any()
        return jax.lax.cond(
            any_needed, lambda: each_lane(chosen), lambda: each_lane(lambda _, otherwise, *__: otherwise)
        )

    return with_batch(one, of_batch)(needed, otherwise, *arguments)


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


def cores() -> int:
    """The number of cores that this process may use, or as many as `JAX_NUM_CPU_DEVICES` says."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return int(os.environ.get("JAX_NUM_CPU_DEVICES") or usable)


def for_threads(function: Callable[P, R]) -> Callable[P, R]:
    """`function` for other threads, with the precision and the device of this one: JAX has them for each thread."""
    settings = jax.config.values
    double, device = settings["jax_enable_x64"], settings["jax_default_device"]

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.enable_x64(double), jax.default_device(device):
            return function(*args, **kwargs)

    return call


def on_all_cores(function: Callable) -> Callable:
    """A batch on all cores of a CPU: threads run one compiled program. Results are the same on any number of cores.

    The returned function takes a batch of `function`'s first argument, with the flights along the first axis of all
    arrays, and the other arguments as they are.
    """

    @eqx.filter_jit
    def chunk(many: Any, first: Array, size: int, shared: Any) -> Any:
        arrays, others = eqx.partition(many, eqx.is_array)
        arrays = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, size), arrays)
        part = eqx.combine(arrays, others)
        return eqx.filter_vmap(lambda one: function(one, *shared))(part)

    compiled = set()

    def batch(many: Any, *shared: Any) -> Any:
        leaves, structure = jax.tree.flatten(eqx.filter((many, shared), eqx.is_array))
        lanes = leaves[0].shape[0]
        if not lanes:
            raise ValueError("`many` must hold at least one lane.")
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return chunk(many, jnp.asarray(0), lanes, shared)
        size = min(lanes, _CHUNK) if jax.default_backend() == "cpu" else lanes

        @for_threads
        def run(first: int) -> Any:
            return jax.block_until_ready(chunk(many, jnp.asarray(first), size, shared))

        # All chunks are full: the last begins with flights of the one before it.
        firsts, found = [min(first, lanes - size) for first in range(0, lanes, size)], []
        key = structure, size, jax.config.values["jax_enable_x64"], *map(jnp.shape, leaves)
        if key not in compiled:
            found.append(run(firsts.pop(0)))
            compiled.add(key)
        with ThreadPoolExecutor(cores()) as pool:
            found += pool.map(run, firsts)
        found[-1] = jax.tree.map(lambda leaf: leaf[-lanes % size :], found[-1])
        return jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)

    return batch
