"""How a command prepares JAX: precision, how loops compile, threads, garbage, where compiled programs are kept."""

import gc
import os
import stat
import tempfile
import warnings
from pathlib import Path

import typer

from .._xla import add_flags
from ..errors import in_words, printable

NO_CACHE = "JAXOS4_NO_CACHE"
"""The environment variable that switches off the cache of compiled programs."""


def prepare(*, batch: bool) -> None:
    """Prepares this process for JAX. A cache folder that was chosen before is kept, unless the cache is off.

    `batch`: whether the command computes many flights at once; those of a single one should compile quickly.
    """
    if not batch:
        add_flags(quick=True)
    # Matrices have at most some hundred columns: threads of OpenBLAS would wait for longer than they compute.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Tracing makes many objects and few cycles: to look for cycles took a tenth of a command's time.
    gc.set_threshold(200_000, 10, 10)

    import jax

    jax.config.update("jax_enable_x64", True)
    if os.environ.get(NO_CACHE):
        jax.config.update("jax_enable_compilation_cache", False)
        return
    if jax.config.values["jax_compilation_cache_dir"] is None:
        import platformdirs

        # JAX removes the oldest programs only from a folder that has had a limit since its first one.
        try:
            folder = platformdirs.user_cache_path("jaxos4", appauthor=False) / "compiled"
        except RuntimeError:  # there is no home folder
            return
        if not folder.is_absolute():
            return
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError:
            return
        if foreign := next(filter(_writable_by_others, (folder, folder.parent)), None):
            what = "others can write to it, so it keeps no programs; remove it, or their permission"
            typer.echo(f"jaxos4: {printable(str(foreign))}: {what}.", err=True)
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_compilation_cache_max_size", 1 << 30)  # 1 GB
    if jax.config.values["jax_persistent_cache_min_compile_time_secs"] == 1.0:  # JAX's default [s]
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # many small programs take long together
    # Another process may be writing the same program, or remove it: it is then compiled again.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")


def platform_fault() -> str:
    """Why JAX cannot compute on what the environment asks for, and what to do; empty if it can."""
    import jax

    asked = os.environ.get("JAX_PLATFORMS", "")
    try:
        jax.devices()
    except RuntimeError as error:
        return f"JAX_PLATFORMS={asked}: JAX finds no such device ({in_words(error)}); unset it, or set it to cpu."
    return ""


def _writable_by_others(folder: Path) -> bool:
    """Whether another user may write programs there, which JAX would run."""
    if os.name != "posix":
        return False
    found = folder.stat()
    return found.st_uid != os.getuid() or bool(found.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
