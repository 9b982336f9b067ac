"""`jaxos4 compare`: from simulation to report in one command, here with a comparison of a few seconds."""

import msgspec
import pytest
import xarray as xr
from helpers import compiled_programs, refused

from jaxos4.cli import studies
from jaxos4.report import write_report
from jaxos4.study import OUTCOMES, Training

SMALL = {"durations": (0.5,), "flights": 16, "batch": 16, "channels": ("rates",)}
SMALL |= {"estimators": ("ibss", "network", "hybrid"), "network": Training(steps=20, held_out=1000)}


def draw_few(dataset, directory, **options):
    """The report with some of the parameters and states: each has a panel, and panels take time."""
    return write_report(dataset.isel(parameter=[0, 1, 6], state=[0, 2, 4, 7]), directory, **options)


@pytest.fixture(autouse=True)
def cut(monkeypatch):
    monkeypatch.setattr("jaxos4.report.write_report", draw_few)
    whole = studies.comparison
    monkeypatch.setattr(studies, "comparison", lambda *, quick: msgspec.structs.replace(whole(quick=quick), **SMALL))


def test_one_command_makes_table_dataset_figures_and_report(run, tmp_path, monkeypatch):
    with compiled_programs() as programs:
        code, out, err = run("compare", "--quick", "--out", "here")
    assert (code, err) == (0, "")
    # One program for the network, and one search for IBSS and the hybrid.
    assert [programs.count(f"jit({name})") for name in ("_identify", "_search")] == [1, 1]
    rows = ("noise x 0.1", "noise x 10", "bound, rates", "ibss", "network", "hybrid", "bracket centre")
    assert all(words in out for words in (*rows, "144 estimates"))
    figures = {path.name for path in (tmp_path / "here/figures").iterdir()}
    assert figures >= {"error.svg", "efficiency.svg", "search.svg", "deviations.svg"}
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
