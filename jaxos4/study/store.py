"""The folder of a study: its specification, networks and finished cells.

Every file is complete or absent: it is written under another name and then renamed. A lock keeps a second run out; it
ends with its process, even if the process is killed.
"""

import contextlib
import dataclasses
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock
import jax
import msgspec
import numpy as np

from .._files import BROKEN, write_file
from .._version import __version__
from ..errors import InputError
from ..networks import TrainedNetwork, load_network
from .specification import Study

RESULTS_FILE = "results.nc"
_SPECIFICATION, _LOCK = "study.json", "lock"
# Names of files that were being written when a run was killed.
_UNFINISHED = ".*.part*"


@dataclasses.dataclass(frozen=True)
class Store:
    """A study's folder, made by `open_store`, or by `read_store` to read only."""

    directory: Path
    study: Study
    device: str

    def cell_file(self, index: int) -> Path:
        """The file of a cell."""
        return self.directory / "cells" / f"{index:08d}.npz"

    def network_file(self, number: int) -> Path:
        """The file of a network, by its place in `Study.jobs`."""
        return self.directory / "networks" / f"{number:04d}.net"

    def missing(self) -> list[int]:
        """The cells that are not finished."""
        finished = {path.name for path in (self.directory / "cells").glob("*.npz")}
        return [index for index in range(self.study.count) if self.cell_file(index).name not in finished]

    def read(self, index: int) -> dict[str, np.ndarray] | None:
        """The results of a cell, or `None` if it is not finished. Raises `InputError` if its file is damaged."""
        path = self.cell_file(index)
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
                return {name: file[name] for name in file.files}
        except FileNotFoundError:
            return None
        except BROKEN as error:
            what = " ".join(str(error).split())[:120]
            raise InputError(f"{path}: not a whole cell ({what}); delete it, and run the study again.") from None

    def read_network(self, number: int) -> TrainedNetwork | None:
        """A network, or `None` if it is not trained. Raises `InputError` if its file is damaged."""
        path = self.network_file(number)
        if not path.exists():
            return None
        try:
            with jax.enable_x64(True):
                return load_network(path)
        except InputError:
            raise InputError(f"{path}: not a whole network; delete it, and run the study again.") from None


@contextlib.contextmanager
def open_store(directory: Path, study: Study, device: str) -> Iterator[Store]:
    """Opens the folder of a study, new or to be resumed, and locks it until the block ends.

    `device`: the devices that compute, in words; a resumed study keeps those of its first run.

    **Raises:** `InputError` if the folder holds another study (with what differs), other files, or a study that another
    run is computing; `OSError` if it cannot be written to.
    """
    check_store(directory, study)
    directory.mkdir(parents=True, exist_ok=True)
    try:
        with filelock.FileLock(directory / _LOCK, timeout=0):
            store = check_store(directory, study, device)
            if not (directory / _SPECIFICATION).exists():
                header = {"version": __version__, "device": device, "study": study}
                data = msgspec.json.format(msgspec.json.encode(header), indent=2)
                write_file(directory / _SPECIFICATION, data + b"\n")
            for folder in (directory, directory / "cells", directory / "networks"):
                folder.mkdir(exist_ok=True)
                for unfinished in folder.glob(_UNFINISHED):
                    unfinished.unlink(missing_ok=True)
            yield store
    except filelock.Timeout:
        remedy = "wait for its end, or give another folder"
        raise InputError(f"{directory}: another run is at work on this study; {remedy}.") from None


def read_store(directory: Path) -> Store:
    """Opens the folder of a study to read. Raises `InputError` if it holds no study, or one of another version."""
    path = directory / _SPECIFICATION
    try:
        header = msgspec.json.decode(path.read_bytes())
        if (version := header["version"]) == __version__:
            return Store(directory, msgspec.convert(header["study"], Study), header["device"])
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{directory}: holds no study; `jaxos4 study` makes one.") from None
    except (*BROKEN, msgspec.MsgspecError) as error:
        what = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: not the specification of a study ({what}); give another folder.") from None
    raise InputError(f"{directory}: begun by jaxos4 {version}, and this is {__version__}; give another folder.")


def check_store(directory: Path, study: Study, device: str = "") -> Store:
    """The folder of a study as a run would find it; nothing is written. Raises `InputError` as `open_store` does."""
    if directory.exists() and not directory.is_dir():
        raise InputError(f"{directory}: is a file; give a folder for the study.")
    if not (directory / _SPECIFICATION).exists():
        names = {path.name for path in directory.glob("*")} - {path.name for path in directory.glob(_UNFINISHED)}
        if names - {_LOCK}:
            raise InputError(f"{directory}: holds {min(names)} and no study; give an empty or a new folder.")
        return Store(directory, study, device)
    store = read_store(directory)
    now, before = msgspec.to_builtins(study), msgspec.to_builtins(store.study)
    changed = [f"`{key}` was {_short(before[key])}, now {_short(now[key])}" for key in now if now[key] != before[key]]
    if changed:
        raise InputError(f"{directory}: holds another study: {'; '.join(changed)}; give another folder.")
    return store


def _short(value: Any) -> str:
    text = msgspec.json.encode(value).decode()
    return text if len(text) <= 60 else f"{text[:57]}..."
