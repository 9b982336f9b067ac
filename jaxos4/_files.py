"""Output files that are either whole or as they were before; TOML files that are tables or an error in one line."""

import contextlib
import errno
import os
import secrets
import shutil
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .errors import InputError

# What a file of NumPy arrays that was cut, altered or never was one makes its readers raise.
BROKEN = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    RuntimeError,
    TypeError,
    ValueError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


@contextlib.contextmanager
def write_atomically(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A path beside `path` to write to, renamed to `path` once the block is done.

    Where the block raises, the file beside is removed and an older `path` stays as it was. The name beside keeps the
    suffix; a link is followed, an older file's mode is kept. A pipe or a device cannot be renamed onto: it is yielded
    itself.

        with write_atomically("flight.csv") as beside:
            beside.write_text(text)

    **Raises:** `OSError` that names `path` where its folder is missing or `path` is a folder.
    """
    target = check_writable(path)
    if target.exists() and not target.is_file():
        try:
            yield Path(path)
        except OSError as error:
            raise OSError(error.errno, error.strerror, os.fspath(path)) from None
        return
    beside = target.with_name(f".{target.stem[:40]}.{secrets.token_hex(4)}.part{target.suffix}")
    try:
        yield beside
        with open(beside, "rb+") as file:
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, beside)
        os.replace(beside, target)
    except OSError as error:
        raise OSError(error.errno, error.strerror, os.fspath(path)) from None
    finally:
        beside.unlink(missing_ok=True)


def check_writable(path: str | os.PathLike[str]) -> Path:
    """The file that `path` names, links followed: for asking before a long computation.

    **Raises:** `OSError` that names `path` where its folder is missing or not writable, or `path` is a folder.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, "is a folder, not a file", os.fspath(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, "there is no such folder to write to", os.fspath(path))
    if not os.access(target.parent, os.W_OK):
        raise PermissionError(errno.EACCES, "its folder is not writable", os.fspath(path))
    return target


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The table of a TOML file.

    **Raises:** `InputError` for what is not TOML; `OSError` where it cannot be read.
    """
    try:
        with open(path, "rb") as file:
            return tomllib.load(file)
    except RecursionError:
        raise InputError(f"{path}: nested too deeply for a TOML file of this kind; flatten it.") from None
    except ValueError as error:
        what = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: not a TOML file ({what}); correct it there.") from None
