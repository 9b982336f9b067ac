"""Experiments in small configurations: their modules, the JSON that they write, and their figures."""

import functools
import importlib
import json
import pathlib
from xml.etree import ElementTree

import pytest

import jaxos4
from experiments import drawing
from experiments.__main__ import main_of


def load(name, script="run"):
    """The module of an experiment."""
    return importlib.import_module(f"experiments.{name}.{script}")


def result_of(folder: pathlib.Path, name, script="run", **options):
    """Runs an experiment with these options and small networks, and returns the JSON that it writes."""
    small = functools.partial(jaxos4.NetworkEstimator, width=32, depth=2, tilings=4, cells=8, batch=64, held_out=4000)
    small.steps = jaxos4.NetworkEstimator.steps
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jaxos4, "NetworkEstimator", small)
        main_of(f"{name}.{script}")(**options, out=folder / "out.json")
    return json.loads((folder / "out.json").read_text())


def drawn(path: pathlib.Path):
    """The lines, bands, points and words inside the axes of an SVG figure."""
    for group in ElementTree.parse(path).iter("{http://www.w3.org/2000/svg}g"):
        if "clip-path" in group.attrib:
            yield from group


def plot(folder: pathlib.Path, name, script="plot", results="out.json", *, suffixes=(".svg",)):
    """Draws the results of an experiment in a folder. Only the comparison is drawn as PDF too."""
    with pytest.MonkeyPatch.context() as patch:
        if ".pdf" not in suffixes:
            patch.setattr(drawing, "as_pdf", lambda _: b"")
        main_of(f"{name}.{script}")(folder / results, folder / f"{name} {script}")
    for suffix in suffixes:
        figures = list((folder / f"{name} {script}").glob(f"*{suffix}"))
        assert figures
        least = 2000 if suffix == ".svg" else 5000  # bytes
        assert all(path.name.startswith(name) and path.stat().st_size > least for path in figures)
        if suffix == ".svg":
            assert all(len([*drawn(path)]) > 1 for path in figures)
