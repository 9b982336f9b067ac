"""The folder of a study, with its specification, networks and finished cells; and the Dataset of their results.

Every file is complete or absent: it is written under another name and then renamed. A lock keeps a second run out; it
ends with its process, even if the process is killed. A Dataset is read with checks that it holds what a report needs.
"""

import contextlib
import dataclasses
import io
import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock
import jax
import msgspec
import numpy as np
import tomlkit
import xarray as xr

from .._files import check_plain, read_json, reading, write_file
from .._version import __version__
from ..errors import InputError, shortened
from ..models import MODELS
from ..networks import TrainedNetwork, load_network
from .cell import LEVELS, OUTCOMES, fly, setup_of
from .metrics import SCENARIO
from .specification import AXES, Study

# All arrays of a study's Dataset: dimensions, type as of NumPy (`U`: texts), unit, and description. First its axes.
COORDINATES: dict[str, tuple[tuple[str, ...], str, str, str]] = {
    "model": (("model",), "U", "1", "equations that are fitted, and flown"),
    "airframe": (("airframe",), "U", "1", "airframe that is flown"),
    "excitation": (("excitation",), "U", "1", "rotor speeds that are flown"),
    "duration": (("duration",), "f8", "s", "length of a flight"),
    "method": (("method",), "U", "1", "how true flights are simulated"),
    "noise": (("noise",), "U", "1", "kind of sensor noise"),
    "scale": (("scale",), "f8", "1", "noise in multiples of the standard sensors'"),
    "width": (("width",), "f8", "1", "bracket in multiples of the default half-width"),
    "channels": (("channels",), "U", "1", "what was measured"),
    "estimator": (("estimator",), "U", "1", "estimator"),
    "flight": (("flight",), "i8", "1", "number of the flight: the same draws in all scenarios"),
    "parameter": (("parameter",), "U", "1", "parameter"),
    "level": (("level",), "f8", "1", "share of intervals that should hold the truth"),
}
_FLIGHTS, _WIDE = (*SCENARIO, "flight"), ("model", "airframe", "width", "parameter")
_VALUES = (*_FLIGHTS, "parameter")
# What the file of a cell has. The truth is the same for all estimators.
OF_CELLS: dict[str, tuple[tuple[str, ...], str, str, str]] = {
    "truth": ((*SCENARIO[:-1], "flight", "parameter"), "f8", "unit", "true parameter"),
    "estimate": (_VALUES, "f8", "unit", "estimated parameter; missing where `result` says that there is none"),
    "std": (_VALUES, "f8", "unit", "standard deviation that the estimator gives"),
    "half_width": ((*_VALUES, "level"), "f8", "unit", "half the interval that claims to hold the truth at `level`"),
    "bound": (_VALUES, "f8", "unit", "Cramer-Rao standard deviation, white noise, of the channels `seen`"),
    "result": (_FLIGHTS, "i1", "1", "how the estimate ended"),
    "rollouts": (_FLIGHTS, "i4", "1", "simulated flights that the estimate took"),
    "cost": (_FLIGHTS, "f8", "1", "1/2 |W (y - x)|^2 at the estimate, of the channels `seen`"),
    "hit": (_FLIGHTS, "i1", "1", "whether the hybrid's seed bracket held the truth; -1 for other estimators"),
}
SCHEMA = COORDINATES | OF_CELLS
SCHEMA |= {
    "unit": (("parameter",), "U", "1", "unit of the parameter"),
    "center": (_WIDE, "f8", "unit", "middle of the bracket"),
    "bracket_half_width": (_WIDE, "f8", "unit", "half the width of the bracket"),
    "seen": (("channels", "estimator"), "U", "1", "channels that the estimator looks at"),
}

RESULTS_FILE = "results.nc"
_SPECIFICATION, _LOCK = "study.json", "lock"
_RUN_AGAIN = "delete it, and run the study again"
_UNFINISHED = ".*.part*"  # files that were being written when a run was killed


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
        if not path.exists():
            return None
        content = io.BytesIO(path.read_bytes())
        with reading(path, "not a whole cell", _RUN_AGAIN), np.load(content, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}

    def read_network(self, number: int) -> TrainedNetwork | None:
        """A network, or `None` if it is not trained. Raises `InputError` if its file is damaged."""
        path = self.network_file(number)
        try:
            with jax.enable_x64(True):
                return load_network(path)
        except FileNotFoundError:
            return None
        except InputError:
            raise InputError(f"{path}: not a whole network; {_RUN_AGAIN}.") from None


@contextlib.contextmanager
def open_store(directory: Path, study: Study, device: str) -> Iterator[Store]:
    """Opens the folder of a study, new or to be resumed, and locks it until the block ends.

    `device`: the devices that compute, in words; a resumed study keeps those of its first run. Raises `InputError` if
    the folder holds another study (with what differs), other files, or one that is being computed; `OSError`.
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
    if not path.exists():
        raise InputError(f"{directory}: holds no study; `jaxos4 study` makes one.")
    header = read_json(path, "give another folder")
    with reading(path, "not the specification of a study", "give another folder"):
        if (version := header["version"]) == __version__:
            return Store(directory, msgspec.convert(header["study"], Study), header["device"])
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
    return shortened(msgspec.json.encode(value).decode(), 60)


def assemble(store: Store) -> xr.Dataset:
    """The Dataset of a study's finished cells; the result of all others is `not_run`. Raises `InputError`.

    Its dimensions are all axes of the grid, `flight`, `parameter` and `level`.
    """
    study, coordinates, failures = store.study, _coordinates(store.study), []
    blank = {"result": OUTCOMES.index("not_run"), "rollouts": 0, "hit": -1}
    arrays = {
        name: np.full([len(coordinates[dim]) for dim in dims], blank.get(name, np.nan), kind)
        for name, (dims, kind, *_) in OF_CELLS.items()
    }
    for cell in map(study.cell, range(study.count)):
        if (results := store.read(cell.number)) is None:
            continue
        flights = slice(cell.first, min(cell.first + study.batch, study.flights))
        own, shared = (*cell.place, flights), (*cell.place[:-1], flights)
        if "failed" in results:
            arrays["result"][own] = OUTCOMES.index("failed")
            # Another estimator that has run has stored the same truths, bit for bit.
            if np.isnan(arrays["truth"][shared]).all():
                truth, *_ = fly(study, setup_of(study, cell.scenario), cell)
                arrays["truth"][shared] = np.asarray(truth)[: flights.stop - flights.start]
            where = dict(zip(SCENARIO, cell.scenario, strict=True))
            failures.append({"cell": cell.number, "first": cell.first, **where, "message": str(results["failed"])})
            continue
        with reading(store.cell_file(cell.number), "not a cell of this study", _RUN_AGAIN):
            for name, (_, kind, *_) in OF_CELLS.items():
                found = results[name].astype(kind, casting="same_kind")
                arrays[name][shared if name == "truth" else own] = found
            if not np.isin(results["result"], np.arange(len(OUTCOMES))).all():
                raise ValueError("unknown result")
    command = {"command": "jaxos4 study specification.toml --out .", "failures": json.dumps(failures)}
    attributes = provenance(study, store.device) | command
    return xr.Dataset(described(arrays | _brackets(study)), described(coordinates), attributes)


def _coordinates(study: Study) -> dict[str, Any]:
    model = MODELS[study.models[0]](study.vehicle(study.airframes[0]))
    values = [list(getattr(study, axis)) for axis in AXES]
    values += [np.arange(study.flights), list(model.parameter_names), list(LEVELS)]
    return dict(zip(COORDINATES, values, strict=True)) | {"unit": list(model.parameter_units)}


def described(arrays: dict[str, Any]) -> dict[str, tuple[tuple[str, ...], Any, dict[str, Any]]]:
    """Arrays of a study's Dataset as xarray takes them, with their dimensions and attributes by `SCHEMA`."""
    flags = {"flag_values": np.arange(len(OUTCOMES), dtype=np.int8), "flag_meanings": " ".join(OUTCOMES)}
    found = {}
    for name, values in arrays.items():
        dims, _, units, about = SCHEMA[name]
        found[name] = dims, values, {"long_name": about, "units": units} | (flags if name == "result" else {})
    return found


def provenance(study: Study, device: str) -> dict[str, str | int]:
    """The attributes of a Dataset that say where it comes from; `device`: the devices that computed it, in words."""
    return {
        "title": study.title,
        "specification": tomlkit.dumps(msgspec.to_builtins(study)),
        "version": __version__,
        "jax": jax.__version__,
        "precision": "float64",
        "device": device,
        "seed": study.seed,
    }


def _brackets(study: Study) -> dict[str, Any]:
    """The brackets of all searches and networks, by model, airframe and width, and the channels that are seen."""
    first = study.cell(0).scenario
    brackets = [
        setup_of(study, first._replace(model=model, airframe=airframe, width=width)).bracket
        for model, airframe, width in itertools.product(study.models, study.airframes, study.widths)
    ]
    shape = [len(study.models), len(study.airframes), len(study.widths), -1]
    center, half = (np.stack([getattr(b, name) for b in brackets]).reshape(shape) for name in ("center", "half_width"))
    seen = [[first._replace(channels=c, estimator=e).seen for e in study.estimators] for c in study.channels]
    return {"center": center, "bracket_half_width": half, "seen": seen}


# HDF5 can loop for ever or crash on a damaged file, so another process reads all of it first.
_PROBE = """
import signal, sys, h5py
path, seconds, most = sys.argv[1], *map(int, sys.argv[2:])
if hasattr(signal, "alarm"):
    signal.alarm(seconds)
def read(_, node):
    global most
    dict(node.attrs)
    if isinstance(node, h5py.Group):
        if not all(isinstance(node.get(name, getlink=True), h5py.HardLink) for name in node):
            sys.exit("it has a link to another place")
    elif isinstance(node, h5py.Dataset):
        if node.external or node.is_virtual:
            sys.exit("its arrays are in another file")
        most -= node.nbytes
        if most < 0:
            sys.exit("it announces more than it holds")
        node[()]
with h5py.File(path) as file:
    read("", file)
    file.visititems(read)
"""
_REMEDY = "give a folder that `jaxos4 study` wrote"


def read_results(directory: Path) -> xr.Dataset:
    """Reads the Dataset in a study's folder. Raises `InputError` if it is missing, or no study wrote it."""
    path = directory / RESULTS_FILE
    if not directory.is_dir():
        raise InputError(f"{directory}: no such folder; {_REMEDY}.")
    if not path.is_file():
        raise InputError(f"{directory}: holds no {RESULTS_FILE}; {_REMEDY}.")
    with reading(path, "not a netCDF file that can be read", "run the study again"):
        _probe(path)
        with xr.open_dataset(path, engine="h5netcdf", phony_dims="sort") as opened:
            dataset = opened.load()
    if fault := _fault(dataset):
        raise InputError(f"{path}: not the results of a study: {shortened(fault, 200)}; {_REMEDY}.")
    _check_texts(path, dataset)
    return dataset


def _probe(path: Path) -> None:
    """Raises `ValueError` if HDF5 cannot read the whole file, or takes longer than a sound one needs.

    A sound file takes less than 4 s, and 1 s more for every 10 MB. A byte of it holds at most 1,030 bytes of arrays.
    """
    size = path.stat().st_size
    limits = str(4 + size // 10_000_000), str(1030 * size + (1 << 20))
    line = [sys.executable, "-P", "-c", _PROBE, os.path.abspath(path), *limits]
    done = subprocess.run(line, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode:
        raise ValueError((done.stderr.splitlines() or ["HDF5 cannot end"])[-1])


def _fault(dataset: xr.Dataset) -> str:
    """Why a Dataset is no study's; empty if it is one."""
    if missing := ", ".join(sorted(SCHEMA.keys() - dataset.variables.keys())):
        return f"no {missing}"
    kinds = {"U": "UO", "f": "fiu", "i": "iu"}  # whole numbers can be numbers, and texts objects
    for name, (dims, kind, *_) in SCHEMA.items():
        found = dataset[name]
        if found.dims != dims or found.dtype.kind not in kinds[kind[0]] or not found.size:
            return f"{name} is of another kind or shape"
        if name in COORDINATES and (
            len(set(found.values.tolist())) < found.size or found.isin([np.nan, np.inf, -np.inf]).any()
        ):
            return f"{name} has equal values, or one that is not finite"
    level, about = dataset["level"].values, dataset["result"].attrs
    if not ((level > 0) & (level < 1)).all():
        return "level is not between 0 and 1"
    names, codes = str(about.get("flag_meanings")).split(), np.atleast_1d(about.get("flag_values", ()))
    if not len(names) == len(set(names)) == codes.size or not {"failed", "not_run"} <= set(names):
        return "result has no names of its codes"
    return "" if dataset["result"].isin(codes).all() else "result has an unknown code"


def _check_texts(path: Path, dataset: xr.Dataset) -> None:
    """Refuse texts of many lines, and cells that failed without saying which."""
    texts: dict[str, Any] = {name: dataset[name].values.ravel().tolist() for name in (*COORDINATES, "seen", "unit")}
    check_plain(path, texts | {name: str(each).splitlines() for name, each in dataset.attrs.items()}, _REMEDY)
    with reading(path, "`failures` is not a list of cells that failed", _REMEDY):
        failures = json.loads(dataset.attrs.get("failures", "[]"))
        if not all({"cell", "message", *SCENARIO} <= each.keys() for each in failures):
            raise ValueError("a cell has no name or message")
    check_plain(path, failures, _REMEDY)
