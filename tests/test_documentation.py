"""The documentation agrees with the code, and the type checker of the tests sees every call."""

import json
import re
import shutil
import subprocess
import sys
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    CRAZYFLIE,
    EACH,
    ROOT,
    blocks,
    documented_class,
    how_we_compile,
    standard_flight,
    standard_problem,
    start,
)
from jaxtyping import Array, Float, TypeCheckError, jaxtyped
from synthetic_identification import identified_flight, identified_vehicle
from typechecker import check

import jaxos4
from experiments.pictures.run import floors_picture
from jaxos4._registry import Registry
from jaxos4.airframe import airframe_table
from jaxos4.estimators import ESTIMATORS
from jaxos4.noise import NOISES
from jaxos4.study import load_study

EXTEND = ROOT / "docs" / "extend"


def run_blocks(page: str, **given) -> dict:
    """Runs the Python of a page of `docs/extend`, one block after another, and returns the names that it defines."""
    defined = {"__name__": "documented", **given}
    for code in blocks(EXTEND / page, "python"):
        exec(code.replace("from ..", "from jaxos4."), defined)  # noqa: S102
    return defined


def test_every_public_name_is_in_the_api_reference():
    pages = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.md"))
    paths = [path.split(".") for path in re.findall(r"^::: jaxos4\.(.+)$", pages, flags=re.MULTILINE)]
    # A function that has the name of its file is documented by its place, which else would be that of the file.
    documented = {path[-1] for path in paths if len(path) == 1 or path[-1] == path[-2]}
    public = {name for name in dir(jaxos4) if name[0] != "_" and not isinstance(getattr(jaxos4, name), type(jaxos4))}
    assert public - documented == set()
    assert {"identify", "assess", "predict"} <= public


def test_the_picture_of_the_floors_is_up_to_date():
    drawn = (ROOT / "docs" / "pictures" / "floors.svg").read_text(encoding="utf-8")
    # If this fails: python -m experiments pictures.run docs/pictures --only floors
    assert drawn == floors_picture(ROOT / "pyproject.toml")


PROSE = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs" / "tutorials").glob("*.py")]
PROSE += [page for folder in (".", ".github", "experiments") for page in (ROOT / folder).glob("*.md")]


@pytest.mark.parametrize("page", PROSE, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files_of_the_repository(page):
    links = re.findall(r"\]\(([^)#]+)", page.read_text(encoding="utf-8"))
    assert [link for link in links if not link.startswith("https:") and not (page.parent / link).exists()] == []


def test_the_links_of_the_readme_are_absolute_in_a_release(tmp_path):
    for name in ("README.md", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    there = ("https://example.org/jaxos4", "https://example.org/docs", "v1.0.0")
    subprocess.run([sys.executable, ROOT / ".ci" / "addresses.py", *there], cwd=tmp_path, check=True)
    links = re.findall(r"\]\(([^)#]+)", (tmp_path / "README.md").read_text(encoding="utf-8"))
    assert links
    assert all(link.startswith("https://") for link in links)
    urls = tomllib.loads((tmp_path / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]
    assert {"Documentation", "Source", "Issues", "Changelog"} <= set(urls)


def test_the_last_release_of_the_changelog_is_the_version_of_the_package():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    heads = re.findall(r"^## \[(.+?)\](.*)$", text, flags=re.MULTILINE)
    assert heads[0] == ("Unreleased", "")
    assert all(re.fullmatch(r" - \d{4}-\d\d-\d\d", date) for _, date in heads[1:])
    releases = re.split(r"^## ", text, flags=re.MULTILINE)[1:]
    assert all(len(re.findall(r"^- ", release, flags=re.MULTILINE)) <= 15 for release in releases)
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert heads[1][0] == version
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"version: {version}\n" in cited
    assert f'date-released: "{heads[1][1].removeprefix(" - ")}"\n' in cited
    assert f"version = {{{version}}}," in (ROOT / "docs" / "cite.md").read_text(encoding="utf-8")


def test_the_workflow_tests_each_python_and_system_that_the_package_names():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = re.findall(r"Python :: (3\.\d+)", " ".join(project["classifiers"]))
    assert project["requires-python"] == f">={named[0]}"
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    (pythons,), (systems,) = (
        re.findall(rf"^ +{axis}: \[(.+)\]$", workflow, flags=re.MULTILINE) for axis in ("python", "os")
    )
    assert re.findall(r"3\.\d+", pythons) == named
    assert systems == "ubuntu-latest, macos-latest, windows-latest"


def table(page: str, of: int = 0) -> list[list[str]]:
    """The rows of a table of the documentation, cell by cell, without the marks of code."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    rows = re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE)[of].replace("`", "").splitlines()[2:]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]


def test_the_table_of_parameters_is_that_of_the_terms():
    rows = {name: rest for name, *rest in table("reference/parameters.md", of=1)}
    assert [rows.pop(parameter.name)[0] for parameter in jaxos4.FlightModel(terms=()).parameters] == [
        parameter.unit for parameter in jaxos4.FlightModel(terms=()).parameters
    ]
    terms = {}
    for name, term in jaxos4.TERMS.items():
        for parameter in term.parameters:
            terms.setdefault(parameter, []).append(name)
    assert rows.keys() == {parameter.name for parameter in terms}
    for parameter, names in terms.items():
        unit, of, prior, positive, each = rows[parameter.name]
        assert (unit, of) == (parameter.unit, ", ".join(names)), parameter.name
        assert (positive == "yes", each == "yes") == (parameter.nonnegative, parameter.each_recording), parameter.name
        if callable(parameter.half_width):
            assert not re.fullmatch(r"[\d.]+ ± [\d.]+", prior), parameter.name
        else:
            assert prior == f"{parameter.center:g} ± {parameter.half_width:g}", parameter.name


def test_the_keys_of_airframe_and_result_files_are_in_their_tables():
    keys = {name for name, *_ in table("reference/airframe.md")}
    assert keys == {*airframe_table(CRAZYFLIE), "arm", "hover_speed"}
    rows = {name: of for names, _, of in table("reference/result.md") for name in names.split(", ")}
    from_flights, of_vehicles = ({name for name, of in rows.items() if of == kind} for kind in ("OS4", "vehicle"))
    os4, vehicle = (found.to_dict().keys() for found in (identified_flight(), identified_vehicle()))
    assert rows.keys() == os4 | vehicle
    assert (from_flights, of_vehicles) == (os4 - vehicle, vehicle - os4)


def test_inner_functions_are_checked_at_each_call():
    def differences(values, annotation):
        @jaxtyped(typechecker=check)
        def inner(x: annotation, y: Float[Array, " n"]) -> Float[Array, " n"]:
            return x - y

        return inner(values, jnp.zeros(3))

    vector, anything = Float[Array, " n"], Float[Array, "..."]
    for _ in range(2):
        assert differences(jnp.ones(3), vector).shape == (3,)
        for values, annotation in ((jnp.ones(4), vector), (np.ones(3), vector), (jnp.ones((2, 3)), anything)):
            with pytest.raises(TypeCheckError):
                differences(values, annotation)


@pytest.fixture(autouse=True)
def tables_are_left_as_they_were(monkeypatch):
    for table in (ESTIMATORS.data, jaxos4.TERMS.data, NOISES):
        for name in ("gauss-newton", "friction", "spikes"):
            monkeypatch.setitem(table, name, None)
            monkeypatch.delitem(table, name)


def test_the_documented_estimator_and_search_run():
    problem = standard_problem(channels="rates")
    found = run_blocks("estimator.md")["ESTIMATORS"]["gauss-newton"]()(problem)
    np.testing.assert_allclose(found.parameters[2], 133.33, rtol=1e-3)
    searched = run_blocks("likelihood.md", MyProblem=lambda model, flight: problem, model=None, flight=None)
    assert issubclass(searched["Descent"], jaxos4.AbstractEstimator)


def test_the_documented_term_brakes_the_yaw():
    model = run_blocks("term.md")["model"]
    flight = standard_flight()
    free, braked = (
        jaxos4.simulate(model, model.alpha.at[-1].set(friction), flight.omega[:201], dt=0.01).states[:, 11]
        for friction in (0.0, 1.0)
    )
    assert np.abs(braked).max() < np.abs(free).max()
    values = model.alpha.at[-1].set(0.8)
    flown = jaxos4.simulate(model, values, flight.omega[:201], dt=0.01)
    problem = jaxos4.ShootingProblem(model, flown, sigma=jaxos4.SENSOR_SIGMA, channels="rates")
    problem = problem.hold(dict(zip(model.parameter_names[:8], values, strict=False)))
    np.testing.assert_allclose(jaxos4.OutputError()(problem).parameters[-1], 0.8, atol=1e-4)


def test_the_documented_noise_has_spikes_and_a_study_takes_it(tmp_path):
    noise, flight = run_blocks("noise.md")["noise"], standard_flight()
    error = (noise(flight, key=jax.random.key(0)).states - flight.states) / jaxos4.SENSOR_SIGMA
    assert 0.08 < np.isnan(error).mean() < 0.12
    assert 0.003 < (np.abs(error) > 5).mean() < 0.01  # white noise has one in two million; a spike in a hundred
    (tmp_path / "spikes.toml").write_text(*blocks(EXTEND / "noise.md", "toml"))
    assert load_study(tmp_path / "spikes.toml").noises == ("white", "spikes")


FAKE = """
import json, jax
jax.config.update("jax_enable_x64", True)
import jaxos4, lab
from jaxos4.airframe import airframe_table
from jaxos4.closed_loop import fly_standard
from jaxos4.estimators import ESTIMATORS
from jaxos4.models import default_terms
used = [name for name in ("gauss_newton", "friction", "mylog") if hasattr(lab, name)]
flight, notes = jaxos4.read_log("flight.log", full_scale=400.0)
model = jaxos4.FlightModel(terms=("friction", "offset"))
print(json.dumps([
    used, flight.states[:, 7].tolist(), notes, ESTIMATORS["gauss-newton"].looks_at, list(ESTIMATORS)[-1],
    model.parameter_names[8:], "friction" in default_terms(frozenset()),
]))
"""


@pytest.mark.slow
def test_another_package_adds_an_estimator_a_term_and_a_log_format(tmp_path):
    """The files of the documentation, in an installed package that names them as entry points."""
    (packages := tmp_path / "lab").mkdir()
    (tmp_path / "lab-1.0.dist-info").mkdir()
    (tmp_path / "lab-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: lab\nVersion: 1.0\n")
    table = tomllib.loads(*blocks(EXTEND / "index.md", "toml"))["project"]["entry-points"]
    lines = [f"[{group}]\n" + "".join(f"{name} = {at}\n" for name, at in each.items()) for group, each in table.items()]
    (tmp_path / "lab-1.0.dist-info" / "entry_points.txt").write_text("\n".join(lines))
    (packages / "__init__.py").touch()
    (packages / "gauss_newton.py").write_text(documented_class("estimator.md"))
    (packages / "friction.py").write_text(blocks(EXTEND / "term.md", "python")[0])
    (packages / "mylog.py").write_text(*blocks(EXTEND / "log_format.md", "python"))
    rows = "".join(f"{10 * i};{i};0;0;500;500;500;500\n" for i in range(50))
    (tmp_path / "flight.log").write_text("# mylog\n" + rows)
    jaxos4.write_flight(standard_flight(duration=1.0), tmp_path / "flight.csv")
    (tmp_path / "study.toml").write_text('estimators = ["gauss-newton"]\nflights = 2\n')
    known = "--channels rates --initial-state known --out found.json"
    expected = {
        "estimate x --estimator nothing": (2, "ant-colony, gauss-newton"),
        f"estimate flight.csv --estimator gauss-newton {known}": (0, "gauss-newton, published model"),
        "study study.toml --out study --dry-run": (0, "gauss-newton"),
    }
    code = "import sys; sys.path.append('.')\n" + FAKE + EACH
    process = start(*expected, code=code, cwd=tmp_path, **how_we_compile())
    assert process.returncode == 0, process.stderr
    (used, rates, notes, looks_at, last, names, by_default), *answers = map(json.loads, process.stdout.splitlines())
    assert (used, looks_at, last, by_default) == ([], "rates", "gauss-newton", False)
    np.testing.assert_allclose(rates, np.radians(np.arange(50)))
    assert notes[0] == "commands are shares of full scale"
    assert names == ["roll_offset", "pitch_offset", "yaw_offset", "yaw_friction"]
    for (line, (code, said)), (answered, ended, printed, _) in zip(expected.items(), answers, strict=True):
        assert (answered, ended, said in printed) == (line, code, True), printed


def test_a_package_that_cannot_be_imported_is_named_and_replaces_nothing(tmp_path, monkeypatch):
    (tmp_path / "lab-1.0.dist-info").mkdir()
    (tmp_path / "lab-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: lab\nVersion: 1.0\n")
    (tmp_path / "lab-1.0.dist-info" / "entry_points.txt").write_text("[numbers]\nnone = lab:none\none = lab:none\n")
    monkeypatch.syspath_prepend(tmp_path)
    numbers = Registry("numbers", {"one": 1})
    assert (list(numbers), len(numbers), numbers["one"], "none" in numbers) == (["one", "none"], 2, 1, True)
    with pytest.raises(jaxos4.InputError, match="lab: its entry point `none` in numbers cannot be imported"):
        numbers["none"]
    with pytest.raises(KeyError):
        numbers["two"]
