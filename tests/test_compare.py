"""`jaxos4 compare` from simulation to report, and an estimator in one file and one line of the registry."""

import json

import msgspec
import pytest
import xarray as xr
from helpers import compiled_programs, documented_class, refused
from small_study import finish, start

from jaxos4.cli import studies
from jaxos4.report import write_report
from jaxos4.study import OUTCOMES, Training

pytestmark = pytest.mark.slow

SMALL = {"durations": (0.5,), "flights": 16, "batch": 16, "channels": ("rates",)}
SMALL |= {"estimators": ("ibss", "network", "hybrid"), "network": Training(steps=20, held_out=1000)}


def draw_few(dataset, directory, **options):
    """The report with one of the parameters: each has a panel, and panels take time."""
    return write_report(dataset.isel(parameter=[6]), directory, **options)


@pytest.fixture(autouse=True)
def cut(monkeypatch):
    monkeypatch.setattr("jaxos4.report.write_report", draw_few)
    whole = studies.comparison
    monkeypatch.setattr(studies, "comparison", lambda *, quick: msgspec.structs.replace(whole(quick=quick), **SMALL))


def test_one_command_makes_table_dataset_figures_and_report(run, tmp_path, monkeypatch):
    with compiled_programs() as programs:
        code, out, err = run("compare", "--quick", "--out", "here")
    assert (code, err) == (0, "")
    # Flights, their bounds, the network, and one search for IBSS and the hybrid.
    assert programs.count("jit(chunk)") == 4
    rows = ("noise x 0.1", "noise x 10", "bound, rates", "ibss", "network", "hybrid", "bracket centre")
    assert all(words in out for words in (*rows, "144 estimates"))
    figures = {path.name for path in (tmp_path / "here/figures").iterdir()}
    assert figures >= {"error.svg", "efficiency.svg"}
    page = (tmp_path / "here/report.html").read_text(encoding="utf-8")
    assert all(f'<figure id="figure-{name.removesuffix(".svg")}">' in page for name in figures)
    with xr.open_dataset(tmp_path / "here/results.nc") as results:
        assert (results["result"] != OUTCOMES.index("not_run")).all()
        assert dict(results.sizes)["scale"] == 3

    written = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("here/cells/*")}
    # Nothing remains to be computed. The figures would be the same again (test_report.py).
    monkeypatch.setattr("jaxos4.report.write_report", lambda dataset, directory, **_: [directory / "report.html"])
    code, again, _ = run("compare", "--quick", "--out", "here")
    assert code == 0
    assert written == {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("here/cells/*")} != {}
    assert again.splitlines()[:-2] == out.splitlines()[:-2]

    refused(run("compare", "--out", "here"), "here", "another study", "`title`")


REGISTERED = """
import sys
from jaxos4.estimators import ESTIMATORS
ESTIMATORS["gauss-newton"] = GaussNewton  # the line in the registry

from jaxos4.cli import main
from jaxos4.cli.studies import comparison

assert {*ESTIMATORS} - {*comparison(quick=False).estimators} == {"ant-colony"}
assert comparison(quick=False).estimators[-1] == "gauss-newton"
for line in open(sys.argv[1]):
    sys.argv = ["jaxos4", *line.split()]
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise
"""
STUDY = """
title = "A study with a new estimator"
durations = [1.0]
scales = [0.1]
channels = ["rates"]
estimators = ["gauss-newton"]
flights = 2
batch = 2
"""
COMMANDS = """study study.toml --out study --dry-run
study study.toml --out study
report study
simulate --duration 1 --out flight.csv
study study.toml --out study --dry-run
estimate flight.csv --estimator gauss-newton --channels rates --initial-state known --out found.json
"""


def test_a_new_estimator_is_offered_everywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "commands").write_text(COMMANDS)
    said = finish(start("commands", code=documented_class("estimator.md") + REGISTERED))
    assert said.count("gauss-newton") >= 3  # in both plans and in the table of the study
    assert "2 estimates: 2 successful" in said
    assert ["gauss-newton", "0", "0"] in [line.split() for line in said.splitlines()]  # nothing remains
    found = json.loads((tmp_path / "found.json").read_text())
    assert (found["estimator"], found["result"]) == ("gauss-newton", "successful")
    assert "gauss-newton" in (tmp_path / "study" / "report.html").read_text(encoding="utf-8")
