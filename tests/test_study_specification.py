"""The files of a study: what is wrong with a specification, with a folder to write to, and with one to report."""

import os

import h5py
import numpy as np
import pytest
import xarray as xr
from helpers import refused
from hypothesis import given, settings
from recorded_logs import ACCIDENTS, damaged
from small_study import AIRFRAME, specification
from strange import in_one_line
from synthetic_study import synthetic_study

from jaxos4.errors import InputError
from jaxos4.study import read_results

MINE = 'airframes = ["mine"]\n' + AIRFRAME
# Refused with a message that names the key.
WRONG_VALUES = (
    "flights = 1.5", "flights = 0", 'models = "published"', 'excitations = ["wobble"]', 'methods = ["rk5"]',
    'fit_method = "diffrax"', 'noises = ["pink"]', 'channels = ["smell"]', 'estimators = ["oracle"]',
    'initial_state = "hidden"', "scales = [-1.0]", "scales = [nan]", "scales = [inf]",
    "widths = [0.0]", "durations = [-1.0]", "durations = [inf]", "durations = [0.01]", "durations = [1e300]",
    "dt = nan", "dt = inf", "dt = 0", "seed = -1", "seed = 9223372036854775808", "batch = 0", "airframe = 3",
    'title = "two\\nlines"', 'title = "\\u0000"',
)  # fmt: skip
WRONG_SPECIFICATIONS = [
    ("flites = 3", "unknown key `flites`; choose from title, models,"),
    ('flights = "many"', "`flights`: expected a whole number, got a string; correct it."),
    ("network = 3", "`network`: expected a table, got a whole number"),
    ("network = { layers = 3 }", "[network]: unknown key `layers`; choose from steps,"),
    ('network = { hybrid_channels = "none" }', "`network.hybrid_channels`: unknown 'none'; choose from rates,"),
    ('models = ["newton"]', "`models`: unknown 'newton'; choose from published, corrected"),
    ('airframes = ["boeing"]', "`airframes`: unknown 'boeing'; choose from os4,"),
    ('truth = "guess"', "`truth`: unknown 'guess'; choose from airframe, drawn"),
    ("scales = []", "`scales` is empty"),
    ("scales = [1, 1.0]", "`scales` names a value twice"),
    ("flights = 1_000_000_000", "cells"),
    ('durations = [0.5]\nexcitations = ["chirp"]', "`excitations`: chirp of 0.5 s by os4: `duration`"),
    ("dt = 0.5", "`excitations`: multisine of 5 s by os4: `tones`"),
    (MINE + "max_rotor_speed = 230", "`excitations`: multisine of 5 s by mine: `amplitude`"),
    ("[network]\nsteps = 0", "network.steps"),
    ("[network]\nsteps = 100_000_000", "network.steps"),
    ("[network]\nheld_out = 10", "network.held_out"),
    (MINE + "wheels = 4", "[airframe.mine]: `wheels` is not a known key"),
    (MINE.replace("mass = 0.6", "mass = -0.6"), "[airframe.mine]: `mass`"),
    (MINE + "max_rotor_speed = inf", "[airframe.mine]: not finite"),
    (AIRFRAME, "[airframe.mine] is not flown"),
    ('[input]\nmine = "mine.csv"', "`input` mine is not flown; name it in `excitations`"),
    (None, "No such file"),
    *((text, "is empty; say at least what differs") for text in ("", "# flights = 3")),
    (b"\xff\xfe\x00", "not a TOML file"),
    ("flights = ", "not a TOML file"),
    ("a = " + "[" * 5000, "spec.toml"),
    *((text, f"`{text.split()[0]}") for text in WRONG_VALUES),
]


@pytest.mark.parametrize(("text", "words"), WRONG_SPECIFICATIONS)
def test_a_wrong_specification_is_one_line(run, tmp_path, text, words):
    rows = "".join(f"{0.01 * k:.2f},200,200,200,200\n" for k in range(600))
    (tmp_path / "mine.csv").write_text("t,omega1,omega2,omega3,omega4\n" + rows)
    if text is not None:
        (tmp_path / "spec.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    for option in ((), ("--dry-run",)):
        refused(run("study", "spec.toml", "--out", "out", *option), "spec.toml: ", words)
    assert not (tmp_path / "out").exists()


# Folders


OLD = '{"version": "0.0.1", "device": "d", "study": {"of": "old"}}'


@pytest.mark.parametrize(
    ("name", "content", "out", "said"),
    [
        ("out/thesis.tex", "mine", "out", "thesis.tex"),
        ("file", "mine", "file", "a file"),
        ("file", "mine", ".", "holds file and no study"),
        ("out/study.json", OLD, "out", "begun by jaxos4 0.0.1"),
        *(("out/study.json", text, "out", "give another folder") for text in ("", "\x00\x01", "[1, 2]", "[" * 100_000)),
    ],
)
def test_a_folder_without_a_study_of_this_version_is_refused_and_unchanged(name, content, out, said, run, tmp_path):
    specification(tmp_path)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(content)
    before = [*tmp_path.rglob("*")]
    for option in ((), ("--dry-run",)):
        refused(run("study", "spec.toml", "--out", out, *option), out, said)
    assert (tmp_path / name).read_text() == content
    assert [*tmp_path.rglob("*")] == before


def small_dataset():
    return synthetic_study(flights=4, scales=(1.0,), estimators=("ibss", "hybrid"), spoiled=False)


def changed(change):
    """Writes a study's Dataset after this change."""
    return lambda path: change(small_dataset()).to_netcdf(path, engine="h5netcdf")


def linked(link):
    """Writes a study's Dataset that leads to another place. A pipe would never answer."""

    def write(path):
        small_dataset().to_netcdf(path, engine="h5netcdf")
        os.mkfifo(path.with_name("pipe"))
        with h5py.File(path, "r+") as file:
            link(file)

    return write


def without_attributes(data):
    data = data.copy()
    for each in data.variables.values():
        each.attrs = {}
    return data


def another_code(data):
    return data.assign(result=(data["result"] + 100).assign_attrs(data["result"].attrs))


def virtual_layout():
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = h5py.VirtualSource("pipe", "x", (4,))
    return layout


def no_dataset(path):
    xr.Dataset({"truth": ("flight", np.zeros(3))}).to_netcdf(path, engine="h5netcdf")


NO_STUDY = {
    "no folder": (lambda path: path.parent.rmdir(), "is not there"),
    "no file": (lambda path: None, "holds no results.nc"),
    "text": (lambda path: path.write_text("not a netCDF file"), "not a netCDF file that can be read"),
    "HDF5": (lambda path: h5py.File(path, "w").create_dataset("truth", data=np.zeros(3)).file.close(), "not the"),
    "another Dataset": (no_dataset, "not the results of a study"),
    "no bound": (changed(lambda data: data.drop_vars("bound")), "no bound"),
    "another shape": (changed(lambda data: data.isel(model=0)), "not the results of a study"),
    "no coordinate": (changed(lambda data: data.drop_vars("excitation")), "no excitation"),
    "another kind": (changed(lambda data: data.assign_coords(level=[-1, -1, -1, -1])), "level"),
    "no codes": (changed(without_attributes), "codes"),
    "another code": (changed(another_code), "code"),
    "text of numbers": (changed(lambda data: data.assign(std=data["std"].astype(str))), "std is of another kind"),
    "infinite level": (changed(lambda data: data.assign_coords(level=[0.5, 0.9, 0.95, np.inf])), "level"),
    "control": (changed(lambda data: data.assign_coords(estimator=["ibss", "a\x07"])), "`estimator` is not one line"),
    "failures": (changed(lambda data: data.assign_attrs(failures='[{"cell": 1}]')), "`failures`"),
    "nested failures": (changed(lambda data: data.assign_attrs(failures="[" * 50_000)), "`failures`"),
    "empty": (changed(lambda data: data.isel(flight=slice(0, 0))), "another kind or shape"),
    "a pipe": (linked(lambda file: file.__setitem__("zz", h5py.ExternalLink("pipe", "/x"))), "a link to another"),
    "a name": (linked(lambda file: file.__setitem__("zz", h5py.SoftLink("/zz"))), "a link to another place"),
    "a device": (
        linked(lambda file: file.create_dataset("zz", (4,), "f8", external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])),
        "its arrays are in another file",
    ),
    "another file": (
        linked(lambda file: file.create_virtual_dataset("zz", virtual_layout())),
        "its arrays are in another file",
    ),
}


@pytest.mark.skipif(os.name != "posix", reason="makes a pipe")
@pytest.mark.parametrize("case", NO_STUDY)
def test_a_folder_that_no_study_wrote_is_refused_and_unchanged(run, tmp_path, case):
    write, words = NO_STUDY[case]
    (tmp_path / "study").mkdir()
    write(tmp_path / "study" / "results.nc")
    before = [*tmp_path.rglob("*")]
    _, out, err = result = run("report", "study")
    refused(result, "study", words)
    assert out == ""
    assert "jaxos4 study" in err or "run the study again" in err
    assert [*tmp_path.rglob("*")] == before


@pytest.mark.slow
def test_a_damaged_dataset_is_refused_without_a_word_of_the_library(tmp_path, capfd):
    path = tmp_path / "results.nc"
    synthetic_study(flights=4, scales=(1.0,), estimators=("ibss",), spoiled=False).to_netcdf(path, engine="h5netcdf")
    content = path.read_bytes()

    @given(accidents=ACCIDENTS)
    @settings(max_examples=20)
    def law(accidents):
        path.write_bytes(damaged(content, accidents))
        in_one_line(lambda _: read_results(tmp_path), path)

    law()
    bomb = xr.Dataset({"truth": (("flight", "parameter"), np.zeros((40_000, 1000), np.int8))})
    bomb.to_netcdf(path, engine="h5netcdf", encoding={"truth": {"zlib": True, "complevel": 9}})
    with pytest.raises(InputError, match="no |more than it holds"):
        read_results(tmp_path)
    assert capfd.readouterr() == ("", "")
