"""Studies: their plan and grid, their Dataset against the library called directly, and `jaxos4 compare`."""

import itertools
import json
import os

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
import xarray as xr
from helpers import compiled_programs, output_of, refused
from hypothesis import given, settings, strategies as st
from small_study import AIRFRAME, run_study, specification

import jaxos4
from jaxos4.cli import studies
from jaxos4.report import write_report
from jaxos4.study import OUTCOMES, Study, Training, load_study, run as run_module
from jaxos4.study.cell import run_cell
from jaxos4.study.dataset import open_store, read_store
from jaxos4.study.specification import AXES

SPECIFICATION = """
durations = [1.0]
scales = [1.0, 0.1]
channels = ["rates"]
estimators = ["ibss", "equation-error"]
truth = "drawn"
flights = 10
batch = 4
seed = 5
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return run_study(tmp_path_factory.mktemp("study"), SPECIFICATION)


@pytest.fixture(scope="module")
def dataset(whole):
    with xr.open_dataset(whole / "results.nc") as dataset:
        return dataset.load()


@pytest.mark.slow
def test_another_specification_is_refused_with_what_changed(run, tmp_path):
    (tmp_path / "other.toml").write_text(SPECIFICATION.replace("seed = 5", "seed = 6\ndt = 0.02"))
    study = load_study(specification(tmp_path, SPECIFICATION))
    with open_store(tmp_path / "out", study, "these tests"):
        pass
    for option in ((), ("--dry-run",)):
        result = run("study", "other.toml", "--out", "out", *option)
        refused(result, "out: holds another study", "`seed` was 5, now 6", "`dt` was 0.01, now 0.02")
        assert "`flights`" not in result[2]
    code, out, _ = run("study", "spec.toml", "--out", "out", "--dry-run")
    assert (code, "12 of 12 cells" in out) == (0, True)


def test_a_dry_run_writes_nothing_and_counts(run, tmp_path, monkeypatch):
    monkeypatch.delenv("JAX_NUM_CPU_DEVICES")
    text = "airframes = ['mine']\ntruth = 'drawn'\nflights = 1000\nbatch = 100\nestimators = ['ibss', 'kalman']\n"
    specification(tmp_path, text + AIRFRAME)
    out = output_of(run("study", "spec.toml", "--out", "out", "--dry-run"))
    assert [path.name for path in tmp_path.iterdir()] == ["spec.toml"]
    rows = [line.split() for line in out.splitlines()]
    assert all([name, "30", "3000"] in rows for name in ("ibss", "kalman"))
    assert f"60 of 60 cells to be run, 6000 flights to be identified, on {len(os.sched_getaffinity(0))} x cpu" in out


# The grid.


@settings(max_examples=50)
@given(st.lists(st.integers(1, 3), min_size=5, max_size=5), st.integers(1, 40), st.integers(1, 12))
def test_cells_enumerate_every_scenario_and_block_once(lengths, flights, batch):
    all_values = {
        **{"durations": (1.0, 2.0, 3.0), "noises": ("white", "lossy", "biased"), "scales": (0.0, 1.0, 2.0)},
        **{"channels": ("rates", "attitude", "all"), "estimators": ("ibss", "network", "kalman")},
    }
    some = {name: values[:n] for (name, values), n in zip(all_values.items(), lengths, strict=True)}
    study = Study(flights=flights, batch=batch, models=("published", "corrected"), **some)
    cells = [study.cell(number) for number in range(study.count)]
    assert [cell.number for cell in cells] == list(range(study.count))
    axes = [getattr(study, axis) for axis in AXES]
    wanted = set(itertools.product(itertools.product(*axes), range(0, flights, batch)))
    assert {(tuple(cell.scenario), cell.first) for cell in cells} == wanted
    assert len(cells) == len(wanted) == study.count
    for cell in cells:
        assert tuple(axis[i] for axis, i in zip(axes, cell.place, strict=True)) == tuple(cell.scenario)


# The Dataset.


def flown(number, scale, *, channels="rates", initial_state=None):
    """Flight `number` of a study with truths that are drawn: its truth and problem, by the library."""
    model = jaxos4.PublishedOS4(jaxos4.OS4)
    omega = jaxos4.multisine(jaxos4.OS4, duration=1.0, dt=0.01)
    bracket = jaxos4.Bracket.default(model)
    truth_key, noise_key = jax.random.split(jax.random.fold_in(jax.random.fold_in(jax.random.key(5), 1), number))
    u = jax.random.uniform(truth_key, (8,), minval=-1, maxval=1)
    truth = bracket.center + u * bracket.half_width
    flight, sigma = jaxos4.simulate(model, truth, omega, dt=0.01), scale * jaxos4.SENSOR_SIGMA
    noisy = jaxos4.WhiteNoise(sigma)(flight, key=noise_key)
    problem = jaxos4.ShootingProblem(model, noisy, sigma=sigma, initial_state=initial_state, channels=channels)
    return truth, problem


@pytest.mark.slow
@pytest.mark.parametrize(("number", "scale"), [(0, 1.0), (9, 0.1)])
def test_the_dataset_is_what_the_library_computes(dataset, number, scale):
    truth, problem = flown(number, scale, initial_state=jnp.zeros(12))
    bracket = jaxos4.Bracket.default(problem.model)
    bound = jnp.sqrt(jnp.diagonal(jaxos4.cramer_rao_bound(problem, truth)))
    for name, estimator in (("equation-error", jaxos4.EquationError()), ("ibss", jaxos4.IBSS())):
        found = estimator(problem, bracket)
        of = dataset.sel(flight=number, scale=scale, estimator=name).squeeze()
        same(of["truth"], truth, bracket.half_width)
        same(of["bound"], bound)
        same(of["estimate"], found.parameters, found.std)
        same(of["std"], found.std)
        same(of["half_width"].sel(level=0.95), found.half_width(0.95))
        same(of["cost"], found.cost)
        assert int(of["rollouts"]) == int(found.rollouts)
        assert OUTCOMES[int(of["result"])] == jaxos4.result_names(found.result)
        assert int(of["hit"]) == -1
    same(dataset["center"].squeeze(), bracket.center, bracket.half_width)
    assert (dataset["truth"] == dataset["truth"].isel(scale=0)).all()  # the same draws in all scenarios
    same(dataset["bracket_half_width"].squeeze(), bracket.half_width)


HYBRID = """
durations = [1.0]
scales = [0.1, 1.0]
channels = ["attitude"]
estimators = ["ibss", "hybrid"]
truth = "drawn"
initial_state = "free"
flights = 6
batch = 4
seed = 5
[network]
steps = 2
held_out = 1000
hybrid_channels = "rates"
"""


@pytest.mark.slow
def test_the_hybrid_of_a_study_is_that_of_the_library(tmp_path):
    """The library searches from the network in one program for each flight, the study in batches with that of IBSS."""
    out = run_study(tmp_path, HYBRID)
    with xr.open_dataset(out / "results.nc") as dataset:
        dataset = dataset.load().squeeze()
    network = read_store(out).read_network(0)
    assert network.channels == "rates"
    for number, scale in ((0, 0.1), (5, 1.0)):
        truth, problem = flown(number, scale, channels="attitude")
        of = dataset.sel(flight=number, scale=scale, estimator="hybrid")
        found = jaxos4.Hybrid(network)(problem, jaxos4.Bracket.default(problem.model))
        assert OUTCOMES[int(of["result"])] == jaxos4.result_names(found.result)
        assert (np.abs(of["estimate"] - found.parameters) < 1e-6 * found.std).all()
        np.testing.assert_allclose(of["half_width"].sel(level=0.95), found.half_width(0.95), rtol=1e-6)
        assert int(of["rollouts"]) == int(found.rollouts)
        hit = (truth >= found.seed.lower) & (truth <= found.seed.upper)
        assert int(of["hit"]) == int(hit.all())
    assert (dataset["hit"].sel(estimator="ibss") == -1).all()


def same(ours, theirs, scale=0.0) -> None:
    """Equal to 1e-9 of their size, or of `scale` where they may be zero."""
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    assert ours.shape == theirs.shape
    assert np.isfinite(theirs).all()
    assert np.all(np.abs(ours - theirs) <= 1e-9 * np.maximum(np.abs(theirs), scale))


@pytest.mark.slow
def test_every_variable_has_a_name_and_a_unit_and_the_attributes_are_those_of_the_study(whole, dataset, tmp_path):
    for name, variable in dataset.variables.items():
        assert variable.attrs["long_name"], name
        assert variable.attrs["units"], name
    result = dataset["result"]
    assert (result.dtype.kind, result.dims[-2:]) == ("i", ("estimator", "flight"))
    assert result.attrs["flag_values"].tolist() == list(range(len(OUTCOMES)))
    assert result.attrs["flag_meanings"].split() == list(OUTCOMES)
    assert set(np.unique(result)) <= set(result.attrs["flag_values"].tolist())
    assert dataset["unit"].sel(parameter="alpha3").item() == "1/(kg m^2)"
    study, attributes = load_study(specification(tmp_path, SPECIFICATION)), dict(dataset.attrs)
    (tmp_path / "again.toml").write_text(attributes.pop("specification"))
    assert load_study(tmp_path / "again.toml") == study
    software = {
        "version": jaxos4.__version__,
        "jax": jax.__version__,
        "command": "jaxos4 study specification.toml --out .",
    }
    numbers = {"title": study.title, "precision": "float64", "seed": 5, "failures": "[]"}
    assert attributes == {"device": "these tests", **software, **numbers}


# Flights and cells that fail.


@pytest.mark.slow
def test_a_diverging_cell_is_counted_and_the_study_ends(run, tmp_path, dataset):
    specification(tmp_path, SPECIFICATION.replace("[1.0, 0.1]", "[1.0, 1e300]"))
    out = output_of(run("study", "spec.toml", "--out", "out"))
    with xr.open_dataset("out/results.nc") as found:
        diverged = found["result"].sel(scale=1e300)
        assert ((diverged != OUTCOMES.index("successful")) & (diverged < OUTCOMES.index("failed"))).all()
        # The other scale is unchanged.
        for name in ("estimate", "std", "result", "cost"):
            np.testing.assert_array_equal(found[name].sel(scale=1.0), dataset[name].sel(scale=1.0))
        codes, counts = np.unique(found["result"], return_counts=True)
    assert "40 estimates" in out
    assert all(f"{count} {OUTCOMES[result]}" in out for result, count in zip(codes, counts, strict=True))


@pytest.mark.slow
def test_a_cell_that_raises_is_kept_as_failed_until_it_is_deleted(run, tmp_path, monkeypatch, dataset):
    specification(tmp_path, SPECIFICATION)
    study, broken = ("study", "spec.toml", "--out", "out"), (1, 7, 10)

    def raises(study, cell, network):
        if cell.number in broken:
            raise ValueError("the moon was in\nthe way")
        return run_cell(study, cell, network)

    with monkeypatch.context() as patch:
        patch.setattr(run_module, "run_cell", raises)
        code, out, err = run(*study)
    assert (code, err, "12 failed" in out) == (0, "", True)
    assert "12 failed" in run(*study)[1]  # it is not tried again
    with xr.open_dataset("out/results.nc") as found:
        failures = json.loads(found.attrs["failures"])
        lost = found["result"].to_numpy() == OUTCOMES.index("failed")
        assert np.isnan(found["estimate"].to_numpy()[lost]).all()
        np.testing.assert_array_equal(found["result"].to_numpy()[~lost], dataset["result"].to_numpy()[~lost])
        # No estimator ran on flights 4 to 7 at scale 1, but their truth is known.
        np.testing.assert_array_equal(found["truth"], dataset["truth"])
    where = [(1, 4, "ibss", 1.0), (7, 4, "equation-error", 1.0), (10, 4, "equation-error", 0.1)]
    assert [(f["cell"], f["first"], f["estimator"], f["scale"]) for f in failures] == where
    assert {f["message"] for f in failures} == {"the moon was in the way"}
    for index in broken:
        (tmp_path / "out" / "cells" / f"{index:08d}.npz").unlink()
    code, out, _ = run(*study)
    assert (code, "failed" in out) == (0, False)
    with xr.open_dataset("out/results.nc") as found:
        assert found.drop_attrs(deep=False).identical(dataset.drop_attrs(deep=False))


# `jaxos4 compare`

SMALL = {"durations": (0.5,), "flights": 16, "batch": 16, "channels": ("rates",)}
SMALL |= {"estimators": ("ibss", "network", "hybrid"), "network": Training(steps=20, held_out=1000)}


def draw_few(dataset, directory, **options):
    """The report with one of the parameters: each has a panel, and panels take time."""
    return write_report(dataset.isel(parameter=[6]), directory, **options)


@pytest.fixture
def cut(monkeypatch):
    monkeypatch.setattr("jaxos4.report.write_report", draw_few)
    whole = studies.comparison
    monkeypatch.setattr(studies, "comparison", lambda *, quick: msgspec.structs.replace(whole(quick=quick), **SMALL))


@pytest.mark.usefixtures("cut")
def test_one_command_makes_table_dataset_figures_and_report(run, tmp_path, monkeypatch):
    with compiled_programs() as programs:
        out = output_of(run("compare", "--quick", "--out", "here"))
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
