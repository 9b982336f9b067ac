"""Output files that are either whole or as they were before."""

import contextlib
import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path


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
        yield Path(path)
        return
    beside = target.with_name(f".{target.stem[:40]}.{secrets.token_hex(4)}.part{target.suffix}")
    try:
        yield beside
        with open(beside, "rb+") as file:
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, beside)
        os.replace(beside, target)
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
