"""Reads the Dataset of a study, and checks that `results.nc` holds what a report needs."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from .._files import BROKEN, check_plain, reading
from ..errors import InputError, shortened
from .dataset import COORDINATES, RESULTS_FILE, SCHEMA
from .metrics import SCENARIO

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
    """Reads the Dataset in a study's folder. Raises `InputError` if there is none, or it is not a study's."""
    path = directory / RESULTS_FILE
    if not directory.is_dir():
        raise InputError(f"{directory}: no such folder; {_REMEDY}.")
    if not path.is_file():
        raise InputError(f"{directory}: holds no {RESULTS_FILE}; {_REMEDY}.")
    with reading(path, "not a netCDF file that can be read", "run the study again", OSError):
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
    try:
        failures = json.loads(dataset.attrs.get("failures", "[]"))
        wrong = [each for each in failures if not {"cell", "message", *SCENARIO} <= each.keys()]
    except BROKEN:
        failures, wrong = [], [None]
    if wrong:
        raise InputError(f"{path}: `failures` is not a list of cells that failed; {_REMEDY}.")
    check_plain(path, failures, _REMEDY)
