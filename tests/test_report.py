"""The report of a study: its files, every number in its tables, the trouble that it names, and what it refuses."""

import csv
import io
import json
import math
import re
from xml.etree import ElementTree

import matplotlib.colors
import numpy as np
import pytest
import xarray as xr
from helpers import output_of, refused
from pages import read_page, words
from rich.console import Console
from scipy.spatial.distance import pdist
from synthetic_study import ESTIMATORS, LEVELS, SCENARIO, UNITS, synthetic_study

from jaxos4.estimators import ESTIMATORS as REGISTRY
from jaxos4.report import error_csv, error_table, study_figures, study_page, write_report
from jaxos4.report.matplotlib_figures import as_pdf
from jaxos4.report.panels import styles
from jaxos4.report.study_tables import scenario_tables, scenarios
from jaxos4.report.text import DASH, plain, with_unit
from jaxos4.study import metrics, read_results

OF_SCENARIO = {"overview", "error", "efficiency", "coverage"}


def few(**options):
    """A study with three of the parameters: each has a panel, and panels take time."""
    return synthetic_study(**options).isel(parameter=[0, 1, 6])


def tables(text):
    """The tables of a page by id: {(group, row, column): (number, interval, mark)}."""
    found = {}
    for source in re.findall("<table.*?</table>", text, flags=re.DOTALL):
        table = ElementTree.fromstring(source)
        headings = [heading.text.strip() for heading in table.iterfind("thead/tr/th")]
        cells = found[table.get("id")] = {}
        for body in table.iterfind("tbody"):
            group, *rows = body
            for row in rows:
                label, *numbers = row
                for heading, cell in zip(headings[1:], numbers, strict=True):
                    place = group.findtext("th/span"), "".join(label.itertext()).strip(), heading
                    number = cell.text.rstrip("†‡ \n")
                    cells[place] = number, cell.findtext("small", ""), cell.text.removeprefix(number).strip()
    return found


@pytest.fixture(scope="module")
def study():
    return few(flights=24, estimators=("ibss", "network", "hybrid", "svsf"))


@pytest.fixture(scope="module")
def report(study, tmp_path_factory):
    return write_report(study, tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def page(report):
    return tables(read_page(report[0]))


def test_the_command_writes_the_same_files_from_the_dataset(study, report, tmp_path, run):
    folder = report[0].parent
    names = {path.relative_to(folder).as_posix() for path in report}
    assert names == {"report.html"} | {f"figures/{n}.svg" for n in OF_SCENARIO}
    written = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert written == names | {"specification.toml"}  # which the page's command names
    assert "jaxos4 study specification.toml --out ." in report[0].read_text(encoding="utf-8")
    assert (folder / "specification.toml").read_text() == study.attrs["specification"]
    study.to_netcdf(tmp_path / "results.nc", engine="h5netcdf")
    xr.testing.assert_equal(read_results(tmp_path), study)
    out = output_of(run("report", str(tmp_path), "--csv", str(tmp_path / "errors.csv")))
    assert "4 figures" in out
    for path in report:
        assert (tmp_path / path.relative_to(folder)).read_bytes() == path.read_bytes(), path.name


def test_figures_as_pdf_are_beside_those_as_svg_if_wanted_and_do_not_outlive_them(study, tmp_path, run):
    study.to_netcdf(tmp_path / "results.nc", engine="h5netcdf")
    out = output_of(run("report", str(tmp_path), "--pdf"))
    assert "4 figures, as SVG and PDF" in out
    files = {path.name: path.read_bytes()[:5] for path in (tmp_path / "figures").iterdir()}
    assert files.keys() == {f"{name}.{kind}" for name in OF_SCENARIO for kind in ("svg", "pdf")}
    assert {head for name, head in files.items() if name.endswith(".pdf")} == {b"%PDF-"}
    write_report(study, tmp_path)
    assert not [*(tmp_path / "figures").glob("*.pdf")]
    (tmp_path / "found.json").write_text("{}")
    refused(run("report", str(tmp_path / "found.json"), "--pdf"), "--pdf:", "leave it out")


def test_the_csv_has_every_number(study):
    rows = list(csv.DictReader(io.StringIO(error_csv(study))))
    data = study.isel({name: 0 for name in SCENARIO if name not in ("scale", "estimator")})
    error, efficiency = metrics.estimator_error(data), metrics.efficiency(data)
    assert len(rows) == error["absolute"].size
    for row in rows:
        at = {"scale": float(row["noise_scale"]), "estimator": row["estimator"], "parameter": row["parameter"]}
        for name, value in (("rms_error", error["absolute"]), ("efficiency_low", efficiency["low"])):
            expected = float(value.sel(at))
            assert (row[name] == "") == math.isnan(expected)
            assert not row[name] or float(row[name]) == pytest.approx(expected, rel=1e-5)
    alpha7 = [row for row in rows if row["parameter"] == "alpha7"]
    assert {(row["unit"], row["rms_error_percent"], row["model"]) for row in alpha7} == {("1", "", "published")}


def units_of(table):
    _, headings, *_ = table
    return dict(heading[:-1].split(" [") for heading in headings[1:])


def test_the_unit_in_a_head_is_that_of_the_cells_below_it():
    """alpha7 is 0, so that no error is a share of it; alpha2 and alpha5 are below the noise floor."""
    study = synthetic_study(flights=24, estimators=("ibss", "network"))
    data = study.isel({name: 0 for name in SCENARIO if name not in ("scale", "estimator")})
    units = units_of(scenario_tables(data)["error"])
    assert units["alpha3"] == units["alpha8"] == "%"
    assert (units["alpha7"], units["alpha2"]) == ("1", "1/s")
    mixed = data.assign(truth=data["truth"].where(data["parameter"] != "alpha3", data["truth"] * (data["scale"] < 5)))
    assert units_of(scenario_tables(mixed)["error"])["alpha3"] == "%; marked: 1/(kg m^2)"


def test_no_line_hides_another_and_a_title_says_who_sees_which_channels(study, report):
    data = study.isel({name: 0 for name in SCENARIO if name not in ("scale", "estimator")})
    for figure in (study_figures.errors(data), study_figures.overview(data)):
        widths = [next(mark.width for mark in figure.panels[0].marks if mark.group == i) for i in range(4)]
        assert widths == sorted(widths, reverse=True)
        assert len({*widths}) == 4
    said = "Not of the same channels: ibss, hybrid see all; network, svsf see rates"
    assert said in words(report[0].read_text(encoding="utf-8"))


def test_every_number_in_the_tables(study, page):
    """`test_metrics.py` has the metrics; here each of them stands in its place, as text."""
    data = study.isel({name: 0 for name in SCENARIO if name not in ("scale", "estimator")})
    errors, bounds, center = (of(data) for of in (metrics.estimator_error, metrics.bound_error, metrics.center_error))
    efficiency, coverage = metrics.efficiency(data), metrics.coverage(data).sel(level=0.95)
    levels, counts, hits = metrics.mean_coverage(data), metrics.result_counts(data), metrics.hit_rate(data)
    shown = set()

    def percent(share):
        return plain(100 * share)

    def check(table, row, column, one, measure, text=plain):
        found = page[table][row[0], row[1], column]
        shown.add((table, row, column))
        assert found[0] == text(float(one[measure])), (table, row, column)
        if "low" in one and not math.isnan(one["low"]):
            assert found[1] == f"{text(float(one['low']))} to {text(float(one['high']))}"
        return found[2]

    for s, e in np.ndindex(data.sizes["scale"], data.sizes["estimator"]):
        at, noise = {"scale": s, "estimator": e}, f"noise x {data['scale'].values[s]:g}"
        row = noise, str(data["estimator"].values[e])
        for p, name in enumerate(data["parameter"].values):
            bound = f"bound, {data['seen'].values[e]}"
            for found, label in ((errors, row[1]), (bounds, bound), (center, "bracket centre")):
                one = found.isel({k: v for k, v in (at | {"parameter": p}).items() if k in found.dims})
                if label == bound and math.isnan(one["absolute"]):
                    continue  # the row shows an estimator that was run
                unit = "absolute" if one["reason"] else "percent"
                mark = check("error-1", (noise, label), name, one, unit)
                assert mark == ("" if math.isnan(one[unit]) else ("", "†", "‡")[int(one["reason"])])
            check("efficiency-1", row, name, efficiency.isel(at | {"parameter": p}), "efficiency")
            check("coverage-1", row, name, coverage.isel(at | {"parameter": p}), "coverage", percent)
        for k, level in enumerate(LEVELS):
            check("levels-1", row, f"{100 * level:g} %", levels.isel(at | {"level": k}), "coverage", percent)
        for code in counts["code"].values[(counts > 0).any(("scale", "estimator")).values]:
            number = page["results-1"][*row, code.replace("_", " ")][0]
            assert number == str(int(counts.isel(at).sel(code=code)))
            shown.add(("results-1", row, code.replace("_", " ")))
        check("results-1", row, "seed hits", hits.isel(at), "hit_rate", percent)
        check("results-1", row, "rollouts", {"x": metrics.mean_rollouts(data).isel(at)}, "x")
    assert shown == {(table, place[:2], place[2]) for table, cells in page.items() for place in cells}


def test_trouble_is_named(report):
    shown = words(report[0].read_text(encoding="utf-8"))
    for said in (
        "Incomplete: 1 of 12 cells",
        "Most accurate, within Monte-Carlo error: ",
        "1 of 12 cells failed",
        "scale 10.0, estimator svsf: FloatingPointError: <b>the filter's covariance</b> is not",
        "noise x 0.1, ibss, flight 1: at bound",
        "noise x 0.1, ibss, flight 3: nonfinite trajectory",
        "noise x 10, ibss, flight 2: max sweeps",
        "3 flights without a successful result",
        "† absolute error, in the parameter's unit: the truth is 0",
        "‡ absolute error, in the parameter's unit: below the noise floor",
        "jaxos4 study specification.toml --out .",
        *("alpha1 [%]", *(f"[{UNITS[place]}]" for place in (1, 6))),
    ):
        assert said in shown, said


def test_a_study_of_one_flight_shows_the_answer_and_no_statistics(tmp_path):
    study = few(flights=1, scales=(0.0, 1.0), estimators=("ibss", "svsf"), spoiled=False)
    code = metrics.codes(study)["max_sweeps"]
    for name, none in {"result": code, "estimate": np.nan, "half_width": np.nan}.items():
        study[name].loc[{"scale": 0.0, "estimator": "svsf"}] = none
    page, *figures = write_report(study, tmp_path)
    text = read_page(page)
    assert [path.name for path in figures] == ["intervals.svg"]
    assert set(tables(text)) == {"estimates-1", "results-1"}
    shown, cells = words(text), tables(text)["estimates-1"]
    assert "Each scenario has one flight: there are answers, but no statistics." in shown
    assert "svsf at noise x 0: max sweeps." in shown
    one = study.isel({name: 0 for name in SCENARIO} | {"flight": 0, "scale": 1})
    half = one["half_width"].sel(level=0.95).values
    held = int((abs(one["estimate"] - one["truth"]).values <= half).sum())
    assert f"ibss at noise x 1: successful, {held} of 3 intervals contain the truth." in shown
    for k, (name, unit) in enumerate(zip(study["parameter"].values, study["unit"].values, strict=True)):
        given = f"{with_unit(name, unit)} at noise x {{}}, truth {plain(float(one['truth'][k]), 4)}"
        row = {heading: cells[given.format(1), "ibss", heading][0] for heading in ("estimate", "interval")}
        value = float(one["estimate"][k])
        ends = f"{plain(value - half[k], 4)} to {plain(value + half[k], 4)}"
        assert row == {"estimate": plain(value, 4), "interval": ends}
        assert cells[given.format(0), "svsf", "estimate"][0] == DASH
        assert cells[given.format(0), "svsf", "interval"][0] == DASH
    single = study.isel(scale=[1], estimator=[0])
    assert '<p class="verdict">ibss at noise x 1: successful, ' in write_report(single, tmp_path)[0].read_text()


def test_the_terminal_has_the_same_errors_in_80_columns():
    study = synthetic_study(flights=8, estimators=tuple(ESTIMATORS))
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(error_table(study))
    text = console.export_text()
    first = {name: 0 for name in SCENARIO} | {"scale": 1, "parameter": 0}
    error = float(metrics.estimator_error(study)["percent"].isel(first))
    rows = re.split(r"noise x 1 *\n", text)[1].splitlines()
    _, first, second, *_ = next(line for line in rows if line.startswith("ibss")).split()
    assert (first, second[-1]) == (plain(error, 2), "‡")
    assert ("…" in text, "below the noise floor" in text) == (False, True)
    assert max(map(len, text.splitlines())) <= 80


SMALL = {"estimators": ("ibss", "svsf"), "spoiled": False}


def test_what_is_absent_is_not_drawn_and_figures_have_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(study_page, "MOST_DRAWN", 1)
    study = few(models=("published", "corrected"), flights=4, scales=(1.0,), **SMALL)
    written = write_report(study, tmp_path)
    assert {path.stem for path in written[1:]} == {f"{name}-1" for name in OF_SCENARIO}
    text = written[0].read_text(encoding="utf-8")
    assert {"error-1", "error-2"} <= tables(text).keys()
    for said in ("The first 1 scenarios have figures; all 2 have tables.", "corrected model"):
        assert said in words(text)


def test_a_study_without_noise_has_a_page_without_figures_of_noise(tmp_path):
    """A logarithmic axis has no place for a scale of 0."""
    study = synthetic_study(flights=4, scales=(1.0,), spoiled=False).assign_coords(scale=[0.0])
    files = write_report(study, tmp_path)
    assert not {"error.svg", "efficiency.svg"} & {file.name for file in files}
    read_page(tmp_path / "report.html")


def test_names_cannot_break_out_of_the_page(tmp_path):
    evil = "</script><script>alert(1)</script>"
    study = few(flights=3, scales=(0.0, 1.0), **SMALL)
    parameters = ["$\\frac{<b>}$", *study["parameter"].values[1:]]
    study = study.assign_coords(estimator=["ibss", evil], model=[f"{evil} {{{{ 1 }}}}"], parameter=parameters)
    failures = json.dumps([{"cell": 0, "scale": 1.0, "estimator": evil, "message": evil}])
    study.attrs |= {"title": evil, "specification": f"</pre>{evil}", "command": evil, "failures": failures}
    text = read_page(write_report(study, tmp_path)[0])
    assert words(text).count("alert(1)") >= 6
    assert all(name in words(text) for name in ("{{ 1 }}", "$\\frac{<b>}$"))


def test_user_settings_of_matplotlib_are_neither_used_nor_changed(study):
    ((_, data),) = scenarios(study)
    figure = study_figures.coverage(data)
    before = as_pdf(figure)
    assert before.startswith(b"%PDF")
    with matplotlib.rc_context({"lines.linewidth": 9, "font.size": 20}):
        settings = dict(matplotlib.rcParams)
        assert as_pdf(figure) == before
        assert dict(matplotlib.rcParams) == settings


# What linear red, green and blue become for a reader without red or green cones (Machado et al. 2009, severity 1).
VISIONS = {
    "all cones": np.eye(3),
    "no red cones": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "no green cones": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def cielab(linear):
    f = np.cbrt(np.clip(linear @ TO_XYZ.T, 1e-4, None) / [0.9505, 1.0, 1.089])
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


@pytest.mark.parametrize("vision", VISIONS.values(), ids=VISIONS)
def test_estimators_differ_in_colour_mark_and_line_for_every_reader(vision):
    known = styles(list(REGISTRY))
    looks = known.values()
    for kind in zip(*looks, strict=True):
        assert len(set(kind)) == len(REGISTRY)
    linear = np.array([matplotlib.colors.to_rgb(look.color) for look in looks])
    linear = np.where(linear <= 0.04045, linear / 12.92, ((linear + 0.055) / 1.055) ** 2.4)
    luminance = linear @ TO_XYZ[1]
    assert (1.05 / (luminance + 0.05)).min() > 3  # on white paper
    assert ((luminance + 0.05) / (0.0097 + 0.05)).min() > 3  # on dark paper
    assert pdist(cielab(np.clip(linear @ np.transpose(vision), 0, 1))).min() > 17
    # Others have styles of their own, and the known ones keep theirs.
    for names in (["svsf"], ["new", "newer", "newest"], [*REGISTRY, *(f"toy {i}" for i in range(12))]):
        found = styles(names)
        assert len(set(found.values())) == len(found)
        assert all(found[name] == known[name] for name in names if name in known)
