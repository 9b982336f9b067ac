"""Preparation of JAX for a command: double precision, and a cache of compiled programs for the next command."""

import gc
import os
import tempfile
import warnings
from pathlib import Path

from .._programs import keep_programs

NO_CACHE = "JAXOS4_NO_CACHE"
"""The environment variable that switches off the cache of compiled programs."""

_MOST_BYTES = 1 << 30


def prepare() -> None:
    """Prepares this process for JAX. A cache folder that was chosen before is kept, unless the cache is off."""
    collect_rarely()

    import jax

    jax.config.update("jax_enable_x64", True)
    if os.environ.get(NO_CACHE):
        jax.config.update("jax_enable_compilation_cache", False)
        return
    if jax.config.values["jax_compilation_cache_dir"] is None:
        folder = _usable_folder()
        if folder is None:
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
    if jax.config.values["jax_persistent_cache_min_compile_time_secs"] == 1.0:  # JAX's default [s]
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # many small programs take long together
    # Another process may be writing the same program, or remove it: it is then compiled again.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
    keep_programs()


def collect_rarely() -> None:
    """Makes garbage collection rare: tracing makes millions of small objects that stay."""
    gc.set_threshold(100_000, 20, 100)


def _usable_folder() -> Path | None:
    """The folder of compiled programs, not larger than its limit; `None` if it cannot be written."""
    import platformdirs

    folder = platformdirs.user_cache_path("jaxos4", appauthor=False) / "programs"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        _remove_oldest(folder, _MOST_BYTES)
        return folder
    except OSError:
        return None


def _remove_oldest(folder: Path, most_bytes: int) -> None:
    """If the programs take more than `most_bytes`, removes those that were not used last, until half is left."""
    files = [(path.stat(), path) for path in folder.iterdir() if path.is_file()]
    size = sum(status.st_size for status, _ in files)
    most = most_bytes if size <= most_bytes else most_bytes / 2
    for status, path in sorted(files, key=lambda file: max(file[0].st_atime, file[0].st_mtime)):
        if size > most:
            path.unlink(missing_ok=True)  # another process may remove the same one
            size -= status.st_size
