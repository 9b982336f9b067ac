"""The folder of a study: its specification, networks, finished cells, and a log of what was computed when.

Every file is whole or absent: written beside and renamed. A lock, which ends with its process however that ends, keeps
a second run out.
"""

import contextlib
import importlib.metadata
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock
import jax
import msgspec
import numpy as np

from .._files import BROKEN, write_atomically
from ..errors import InputError
from ..networks.file import load_network
from ..networks.network import TrainedNetwork
from .cell import decode
from .specification import Study, differences

RESULTS_FILE = "results.nc"
_SPECIFICATION, _LOCK, _LOG = "study.json", "lock", "log.jsonl"
# What a kill leaves of a file that was being written.
_LEFT = ".*.part*"


class Store:
    """A study's folder; made by `open_store`, or read-only by `read_store`."""

    def __init__(self, directory: Path, study: Study, device: str, version: str):
        self.directory, self.study, self.device, self.version = directory, study, device, version

    def cell_file(self, index: int) -> Path:
        """Where the cell of that index is kept."""
        return self.directory / "cells" / f"{index:08d}.npz"

    def network_file(self, number: int) -> Path:
        """Where the network of that place among `jobs` is kept."""
        return self.directory / "networks" / f"{number:04d}.net"

    def missing(self) -> list[int]:
        """Cells that are not there yet."""
        there = {path.name for path in (self.directory / "cells").glob("*.npz")}
        return [index for index in range(self.study.count) if self.cell_file(index).name not in there]

    def read(self, index: int) -> dict[str, np.ndarray] | None:
        """The results of a cell, or `None` where it is not there. Raises `InputError` where its file was damaged."""
        path = self.cell_file(index)
        try:
            return decode(path.read_bytes())
        except FileNotFoundError:
            return None
        except BROKEN as error:
            what = " ".join(str(error).split())[:120]
            raise InputError(f"{path}: not a whole cell ({what}); delete it, and run the study again.") from None

    def write(self, path: Path, data: bytes, **entry: Any) -> None:
        """Keeps a file, and logs what it was."""
        with write_atomically(path) as beside:
            beside.write_bytes(data)
        self.log(**entry)

    def log(self, **entry: Any) -> None:
        """Adds a line to the log."""
        with open(self.directory / _LOG, "a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def end_line(self) -> None:
        """Ends the line that a kill, or a full disk, cut: the next is whole again."""
        with contextlib.suppress(FileNotFoundError), open(self.directory / _LOG, "rb+") as file:
            if file.seek(0, os.SEEK_END) and (file.seek(-1, os.SEEK_END), file.read(1))[1] != b"\n":
                file.write(b"\n")

    def read_log(self) -> list[dict[str, Any]]:
        """What was computed when, in its order; lines that a kill cut are left out."""
        entries = []
        with contextlib.suppress(FileNotFoundError):
            for line in (self.directory / _LOG).read_text(encoding="utf-8", errors="replace").splitlines():
                with contextlib.suppress(ValueError):
                    entries.append(json.loads(line))
        return entries

    def read_network(self, number: int) -> TrainedNetwork | None:
        """A network, or `None` where it was not trained yet."""
        path = self.network_file(number)
        if not path.exists():
            return None
        try:
            with jax.enable_x64(self.study.precision == "float64"):
                return load_network(path)
        except InputError:
            raise InputError(f"{path}: not a whole network; delete it, and run the study again.") from None


@contextlib.contextmanager
def open_store(directory: Path, study: Study, device: str) -> Iterator[Store]:
    """The folder of a study, new or to be resumed, kept from other runs until the block is done.

    **Arguments:**

    - `device`: what computes, in words; a study that is resumed keeps its first.

    **Raises:** `InputError` where the folder holds another study (with what differs), something else, or a run that is
    going on; `OSError` where it cannot be written to.
    """
    _check_folder(directory)
    specification = directory / _SPECIFICATION
    directory.mkdir(parents=True, exist_ok=True)
    lock = filelock.FileLock(directory / _LOCK, timeout=0)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise InputError(
            f"{directory}: another run is at work on it; wait for its end, or give another folder."
        ) from None
    try:
        if specification.exists():
            store = read_store(directory)
            _check_same(directory, study, store.study)
        else:
            store = Store(directory, study, device, importlib.metadata.version("jaxos4"))
            header = {"version": store.version, "device": device, "study": study}
            with write_atomically(specification) as beside:
                beside.write_bytes(msgspec.json.format(msgspec.json.encode(header), indent=2) + b"\n")
        for folder in (directory, directory / "cells", directory / "networks"):
            folder.mkdir(exist_ok=True)
            for beside in folder.glob(_LEFT):
                beside.unlink(missing_ok=True)
        store.end_line()
        yield store
    finally:
        lock.release()


def read_store(directory: Path) -> Store:
    """The folder of a study, to be read. Raises `InputError` where it holds none, or one of another version."""
    path = directory / _SPECIFICATION
    ours = importlib.metadata.version("jaxos4")
    try:
        data = path.read_bytes()
        version = msgspec.json.decode(data, type=_Version).version
        if version != ours:
            raise InputError(f"{directory}: begun by jaxos4 {version}, and this is {ours}; give another folder.")
        header = msgspec.json.decode(data, type=_Header)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{directory}: holds no study; `jaxos4 study` makes one.") from None
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        what = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: not the specification of a study ({what}); give another folder.") from None
    return Store(directory, header.study, header.device, header.version)


class _Version(msgspec.Struct):
    version: str


class _Header(_Version):
    device: str
    study: Study


def check_store(directory: Path, study: Study) -> list[int]:
    """The cells that a run would compute, with nothing written. Raises `InputError` as `open_store` does."""
    _check_folder(directory)
    if not (directory / _SPECIFICATION).exists():
        return list(range(study.count))
    store = read_store(directory)
    _check_same(directory, study, store.study)
    return store.missing()


def _check_folder(directory: Path) -> None:
    if not directory.exists():
        return
    if not directory.is_dir():
        raise InputError(f"{directory}: a file; give a folder for the study.")
    names = {path.name for path in directory.iterdir()} - {path.name for path in directory.glob(_LEFT)}
    if _SPECIFICATION not in names and names - {_LOCK}:
        raise InputError(f"{directory}: holds {min(names)} and no study; give an empty or a new folder.")


def _check_same(directory: Path, ours: Study, theirs: Study) -> None:
    changed = differences(ours, theirs)
    if changed:
        raise InputError(f"{directory}: holds another study: {'; '.join(changed)}; give another folder.")
