"""Experiments in their small configurations: running, plotting and reading them."""

import importlib.util
import json
import pathlib
import sys

from jaxos4.report import read_results
from jaxos4.study import load_study

EXPERIMENTS = pathlib.Path(__file__).resolve().parents[1] / "experiments"
sys.path.append(str(EXPERIMENTS))

from shared import load_results as load_results, run_studies  # noqa: E402


def load(name: str, script: str = "run"):
    spec = importlib.util.spec_from_file_location(f"experiment_{name}_{script}", EXPERIMENTS / name / f"{script}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def report_of(name: str, folder: pathlib.Path, **options) -> dict:
    """Runs an experiment with these options, and returns the JSON that it writes."""
    load(name).main(**options, out=folder / "out.json")
    return json.loads((folder / "out.json").read_text())


def small(name: str) -> pathlib.Path:
    return EXPERIMENTS / name / "small.toml"


def study(name: str, out: pathlib.Path):
    """Runs and plots the small configuration of an experiment that is a study."""
    run_studies({name: load_study(small(name))}, out)
    plot(name, out / name, out / "figures")
    return read_results(out / name).squeeze()


def plot(name: str, results: pathlib.Path, figures: pathlib.Path) -> None:
    load(name, "plot").main(results, figures)
    drawn = sorted(figures.iterdir())
    assert {path.suffix for path in drawn} == {".svg", ".pdf"}
    assert all(path.name.startswith(name) and path.stat().st_size > 5000 for path in drawn)
