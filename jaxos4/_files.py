"""Reads and writes files: written completely or not at all, read or refused in one line; and templates of files."""

import contextlib
import errno
import html
import json
import math
import os
import re
import secrets
import shutil
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .errors import InputError, in_words, printable, shortened


@contextlib.contextmanager
def reading(place: object, fault: str, remedy: str) -> Iterator[None]:
    """Raises an error of the block as an `InputError`, whatever a library raises for a damaged file."""
    try:
        yield
    except (InputError, ImportError, Warning):
        raise
    except Exception as error:  # noqa: BLE001
        raise InputError(f"{place}: {fault} ({in_words(error)}); {remedy}.") from None


_LARGEST_TEXT = 1 << 27  # bytes of a JSON or TOML file: a study with inputs of a million samples
_MOST_VALUES = {
    "JSON": 5_000_000,
    "TOML": 500_000,
}  # of such a study; TOML takes 6 us for one, and inputs are CSV files
# A key of TOML with 64 parts or more. The time and memory that `tomllib` takes grow with the square of their number.
_LONG_KEY = re.compile(rb"""(?:\.[ \t]*(?:"(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[\w-]+)[ \t]*){63}""")
_LARGEST = sys.float_info.max  # a larger integer cannot become a float, and Python refuses to print a long one


@contextlib.contextmanager
def write_atomically(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yields a temporary path beside `path`, with its suffix, and renames it to `path` when the block ends.

    If the block raises, an older `path` does not change. Links are followed, and the mode of an older file is kept. A
    pipe or a device is yielded itself. Raises `OSError` that names `path`, and `InputError` if nobody reads a pipe.
    """
    target = check_writable(path)
    if target.exists() and not target.is_file():
        try:
            with _with_a_reader(target):
                yield target
        except OSError as error:
            raise OSError(error.errno, error.strerror, os.fspath(path)) from None
        return
    temporary = target.with_name(f".{target.stem[:40]}.{secrets.token_hex(4)}.part{target.suffix}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, temporary)
        os.replace(temporary, target)
    except OSError as error:
        raise OSError(error.errno, error.strerror, os.fspath(path)) from None
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def _with_a_reader(target: Path) -> Iterator[None]:
    """Keeps a pipe open for the block. To open one that nobody reads would wait for ever."""
    if not target.is_fifo():
        yield
        return
    try:
        descriptor = os.open(target, os.O_WRONLY | os.O_NONBLOCK)
    except OSError as error:
        if error.errno != errno.ENXIO:
            raise
        raise InputError(f"{target}: nobody reads this pipe; start its reader first.") from None
    try:
        yield
    finally:
        os.close(descriptor)


def write_file(path: str | os.PathLike[str], content: str | bytes | memoryview) -> None:
    """Write a file completely or not at all. Text is written as UTF-8."""
    with write_atomically(path) as beside:
        beside.write_bytes(content.encode(errors="backslashreplace") if isinstance(content, str) else content)


def write_netcdf(path: str | os.PathLike[str], dataset: Any, level: int) -> None:
    """Write an xarray Dataset as netCDF, with its arrays of numbers compressed; completely or not at all."""
    numbers = [name for name, data in dataset.data_vars.items() if data.dtype.kind in "fi" and data.ndim]
    packed = dict.fromkeys(numbers, {"zlib": True, "complevel": level})
    write_file(path, dataset.to_netcdf(engine="h5netcdf", encoding=packed))  # in memory: HDF5 can crash on a full disk


def at_once(path: str, flags: int) -> int:
    """For `open(path, opener=at_once)`: a pipe without a writer is empty, where `open` would wait for ever."""
    descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    if hasattr(os, "O_NONBLOCK"):
        os.set_blocking(descriptor, True)
    return descriptor


def check_writable(path: str | os.PathLike[str]) -> Path:
    """`path` with links resolved. Raises `OSError` if it is a folder, or its folder is missing or not writable."""
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        return Path(path)  # a pipe or a device, to which a link may lead that is no path
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, "is a folder, not a file", os.fspath(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, "there is no such folder to write to", os.fspath(path))
    if not os.access(target.parent, os.W_OK):
        raise PermissionError(errno.EACCES, "its folder is not writable", os.fspath(path))
    return target


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The table in a TOML file. Errors are those of `read_json`."""

    def decode(content: bytes) -> dict[str, Any]:
        if _LONG_KEY.search(content):
            raise RecursionError
        return tomllib.loads(content.decode())

    return _read_text(path, decode, "TOML", "correct that place", _LARGEST)


def read_json(path: str | os.PathLike[str], remedy: str, largest: float = _LARGEST) -> Any:
    """The value in a JSON file. `largest`: a limit on the size of its numbers, which excludes infinity and NaN too.

    **Raises:** `InputError`, which ends with the remedy, if the file is not JSON, or if `check_plain` refuses the
    value; `OSError` if the file cannot be read.
    """
    return _read_text(path, json.loads, "JSON", remedy, largest)


def _read_text(
    path: str | os.PathLike[str], decode: Callable[[bytes], Any], kind: str, remedy: str, largest: float
) -> Any:
    with open(path, "rb", opener=at_once) as file:
        content = file.read(_LARGEST_TEXT + 1)
    if len(content) > _LARGEST_TEXT:
        raise InputError(f"{path}: has more than {_LARGEST_TEXT:,} bytes; {remedy}.")
    if sum(map(content.count, (b",", b"[", b"{", b":" if kind == "JSON" else b"="))) > _MOST_VALUES[kind]:
        raise InputError(f"{path}: has more than {_MOST_VALUES[kind]:,} values; {remedy}.")
    try:
        value = decode(content)
    except RecursionError:
        raise InputError(f"{path}: is nested too deeply; {remedy}.") from None
    except ValueError as error:
        reason = shortened(" ".join(str(error).split()), 200)
        raise InputError(f"{path}: not a {kind} file ({reason}); {remedy}.") from None
    check_plain(path, value, remedy, largest)
    return value


def check_plain(path: object, value: Any, remedy: str, largest: float = _LARGEST) -> None:
    """Refuse, at any depth, a text that is not one printable line, and a number beyond `largest`.

    Infinity and NaN are allowed with the default `largest`, and refused with another.
    """
    pending = [("", value)]
    while pending:
        place, each = pending.pop()
        if isinstance(each, dict):
            pending += ((f"{place}.{key}".strip("."), part) for key, part in each.items())
            pending += ((place, key) for key in each)
        elif isinstance(each, list | tuple):
            pending += ((place, part) for part in each if not (isinstance(part, int | float) and abs(part) <= largest))
        elif isinstance(each, str) and not each.isprintable():
            raise InputError(f"{path}: `{shortened(place, 80)}` is not one line of text; {remedy}.")
        elif isinstance(each, float) and not math.isfinite(each) and largest == _LARGEST:
            continue
        elif isinstance(each, int | float) and not abs(each) <= largest:
            raise InputError(f"{path}: `{shortened(place, 80)}` is beyond {largest:.3g}; {remedy}.")


def templates(package: str, escape: Callable[[str], str] | None = None) -> Any:
    """The templates in a package's folder, in which no text of a user becomes markup or code.

    `escape`: makes text harmless: `printable`, `in_xml`; by default as HTML.
    """
    import jinja2  # slow, and few need it
    from markupsafe import Markup

    def finalize(value: Any) -> Any:
        return value if escape is None or isinstance(value, Markup) else Markup(escape(str(value)))  # noqa: S704

    return jinja2.Environment(
        loader=jinja2.PackageLoader(package, "."),
        undefined=jinja2.StrictUndefined,
        autoescape=True,  # macros give markup, which is not escaped twice
        finalize=finalize,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=escape is not None,
    )


def in_xml(text: str) -> str:
    """The text in a comment, an attribute or an element of XML. A comment must not contain two hyphens in a row."""
    return re.sub("-(?=-)", "- ", html.escape(printable(text), quote=False).replace('"', "&quot;"))
