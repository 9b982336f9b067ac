"""Traced programs are kept in files, so that the next command does not trace them again.

JAX keeps compiled programs, and finds one by its traced program. To trace takes longer than to read what is compiled.
So the traced program is exported to the same folder. The name of its file is a digest of the function, the shapes and
static values of its arguments, the sources of `jaxos4`, the installed packages and JAX's settings. This is enough for a
command, which runs no other code. It is not enough for a program of the user, who may add a term to a table, or switch
a setting in a part of the program: so only the command line keeps programs, see `keep_programs`. To read a file runs
its code: none is read from or written to a folder or a file that another user owns, or can write to.
"""

import contextlib
import hashlib
import io
import os
import pickle  # noqa: TID251 - nobody else can write what it reads
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ._files import write_atomically

# Packages whose code the digest knows. A program that depends on a class or function of another package is not kept.
_KNOWN = {"jaxos4", "jax", "jaxlib", "equinox", "diffrax", "optimistix", "optax", "numpy", "builtins"}

_programs: dict[str, Callable[..., Any] | None] = {}
_surroundings: list[bytes] = []  # what every program of this process depends on; empty: nothing is kept


def keep_programs() -> None:
    """Keeps traced programs from now on, if JAX keeps compiled ones. Call it when all settings of JAX are chosen.

    Nothing is kept if JAX looks for errors in each operation, which a kept program does not show.
    """
    import jax

    settings = jax.config.values
    if settings["jax_enable_compilation_cache"] and not (settings["jax_disable_jit"] or settings["jax_debug_nans"]):
        # A source is known by size and time, as in Python's own cache; a package by the name of its folder.
        sources = [(str(path), path.stat()) for path in sorted(Path(__file__).parent.rglob("*.py"))]
        sizes = [(path, status.st_size, status.st_mtime_ns) for path, status in sources]
        packages = sorted(os.listdir(Path(jax.__file__).parents[1]))
        _surroundings[:] = [repr((sizes, packages, sorted(settings.items()))).encode()]


def keep_none() -> None:
    """Keeps no traced program any more in this process: for code that the digest does not know."""
    _surroundings.clear()


def kept_program(
    function: Callable[..., Any], options: dict[str, Any], args: tuple[Any, ...], kwargs: dict[str, Any]
) -> Callable[..., Any] | None:
    """The compiled program of a function for such arguments, to be called with them. `None` if it cannot be kept."""
    if not _surroundings:
        return None
    import equinox as eqx
    import jax

    folder = jax.config.values["jax_compilation_cache_dir"]
    if not folder or not _is_private(folder) or jax.device_count() > 1 or not _is_known(function):
        return None
    leaves, tree = jax.tree.flatten((args, kwargs))
    shapes = [(x.shape, str(x.dtype), getattr(x, "weak_type", False)) if eqx.is_array(x) else x for x in leaves]
    described = io.BytesIO()
    pickler = _Pickler(described)
    pickler.fast = True  # equal values have equal bytes, whether or not their parts are one object
    try:
        pickler.dump((function.__module__, function.__qualname__, options, shapes, tree))
    except (pickle.PicklingError, AttributeError, TypeError, ValueError):
        return None
    name = hashlib.sha256(_surroundings[0] + described.getvalue()).hexdigest()
    if name not in _programs:
        path, arrays = Path(folder) / f"jaxos4-{name}", [leaf for leaf in leaves if eqx.is_array(leaf)]
        content = _read(path) or _write(path, function, args, kwargs)
        _programs[name] = content and _compiled(*content, options, arrays)
    return _programs[name]


def _compiled(traced: Any, results: Any, options: dict[str, Any], arrays: list[Any]) -> Callable[..., Any]:
    """A program of arrays, with the arguments and the results of the function that it was traced from."""
    import equinox as eqx
    import jax

    of_arrays = jax.jit(traced.call, compiler_options=options).lower(*arrays).compile()
    tree = jax.tree.structure(results)

    def call(*args: Any, **kwargs: Any) -> Any:
        leaves = (leaf for leaf in jax.tree.leaves((args, kwargs)) if eqx.is_array(leaf))
        return jax.block_until_ready(jax.tree.unflatten(tree, of_arrays(*leaves)))

    return call


def _is_known(code: Any) -> bool:
    """Whether a class or function has a name in a package that the digest knows."""
    return "<" not in code.__qualname__ and code.__module__.partition(".")[0] in _KNOWN


class _Pickler(pickle.Pickler):
    """Writes classes and functions by name, and refuses those whose code is not known."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type | types.FunctionType) and not _is_known(obj):
            raise pickle.PicklingError(f"the code of {obj} is not known")
        return NotImplemented


def _is_private(place: str | Path | int) -> bool:
    """Whether a file or folder is this user's, and nobody else can write to it. Without POSIX: if it exists."""
    with contextlib.suppress(OSError):
        status = os.stat(place)
        return not hasattr(os, "getuid") or (status.st_uid == os.getuid() and not status.st_mode & 0o022)
    return False


def _read(path: Path) -> tuple[Any, Any] | None:
    """The traced program of a file, and its results; `None` if there is none, or if it is damaged or not private."""
    import jax.export

    content = b""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        content = file.read() if _is_private(file.fileno()) else b""
    if hashlib.sha256(content[32:]).digest() != content[:32]:
        return None
    results, traced = pickle.loads(content[32:])  # noqa: S301
    return jax.export.deserialize(bytearray(traced)), results


def _write(path: Path, function: Callable[..., Any], args: Any, kwargs: Any) -> tuple[Any, Any] | None:
    """Traces a program and writes its file; `None` if it cannot be exported, or if a result is no array."""
    import equinox as eqx
    import jax.export

    arrays, static = eqx.partition((args, kwargs), eqx.is_array)
    leaves, tree = jax.tree.flatten(arrays)
    results: list[Any] = []

    def of_arrays(*leaves: Any) -> list[Any]:
        args, kwargs = eqx.combine(jax.tree.unflatten(tree, leaves), static)
        values, shape = jax.tree.flatten(function(*args, **kwargs))
        if not all(map(eqx.is_array, values)):
            raise TypeError("a result is no array")
        results.append(jax.tree.unflatten(shape, range(len(values))))
        return values

    of_arrays.__name__ = function.__name__  # in profiles and logs
    try:
        traced = jax.export.export(jax.jit(of_arrays))(*leaves)
        content = pickle.dumps((results[0], bytes(traced.serialize())))
    except (NotImplementedError, ValueError, TypeError, pickle.PicklingError, AttributeError):
        return None
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)  # damaged, or not private: its mode would be kept
        with write_atomically(path) as beside:
            beside.touch(0o600)
            beside.write_bytes(hashlib.sha256(content).digest() + content)
    return traced, results[0]
