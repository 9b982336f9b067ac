"""Nothing that comes from a file is trusted: each door ends in one line, and no text of a file becomes code or markup.

The doors of logs are tested in `test_logs_readers`, that of a network's file also in `test_hybrid`.
"""

import ast
import io
import json
import math
import os
import subprocess
import sys
import threading
import time
import tokenize
import tomllib
import tracemalloc
import xml.etree.ElementTree as ElementTree

import h5py
import numpy as np
import pytest
import small_study
import xarray as xr
from helpers import refused
from hypothesis import given, settings, strategies as st
from recorded_logs import ACCIDENTS, damaged, table_csv
from strange import in_one_line, survives_strange_values
from synthetic_results import held, provenance, vehicle_result
from synthetic_study import synthetic_study

import jaxos4
from jaxos4._files import read_toml, write_file
from jaxos4.airframe import load_airframe
from jaxos4.errors import InputError
from jaxos4.export import TARGETS, export_vehicle, read_result
from jaxos4.forecast import vehicle_of
from jaxos4.identification.problem import bracket_of
from jaxos4.logs import read_log
from jaxos4.logs.messages import Messages
from jaxos4.models import MODELS
from jaxos4.networks.file import load_network
from jaxos4.recording import read_recording
from jaxos4.recording.inspection import airframe_draft, inspect_log
from jaxos4.study import load_study, read_results
from jaxos4.study.dataset import read_store

MINE = "mass = 0.6\ninertia = [7e-3, 7e-3, 1.2e-2]\narm = 0.2\nthrust_coefficient = 3e-5\ndrag_coefficient = 7e-7\n"
MINE += "rotor_inertia = 6e-5\nmax_rotor_speed = inf\n"
STUDY = small_study.SPECIFICATION.replace("title", 'airframes = ["mine"]\ntitle') + small_study.AIRFRAME
LEVEL = {"strength": 1.0, "unit": "", "time_constant": 0.2, "sensor": 0.01, "correlation": 0.0}
PREDICTS = {"disturbances": dict.fromkeys("pqr", LEVEL), "provenance": provenance(terms=["offset", "damping"])}
PREDICTS["held"] = {f"alpha{i}": held(0.1) for i in (1, 2, 4, 5, 7)}
OFFSETS = {f"{axis}_{kind}": 0.1 for kind in ("offset", "damping") for axis in ("roll", "pitch", "yaw")}
RESULT = vehicle_result({f"alpha{i}": value for i, value in ((3, 6e4), (6, 5.9e4), (8, 3.5e4))} | OFFSETS, **PREDICTS)
NESTED = 250_000 * "["


# Damage at every door


def exported(path):
    """Prints the result, and exports it to all simulators; each file is parsed."""
    jaxos4.read_result(path).summary(verbose=True)
    found = read_result(path)
    for target in TARGETS:
        for text in (lambda written: (written.text, *written.samples))(export_vehicle(found, target, samples=1)):
            parsed(text, target)


def bracket(path):
    bracket_of(read_toml(path), MODELS["published"]())


def store(path):
    (path.parent / "study.json").write_bytes(path.read_bytes())
    read_store(path.parent)


HEADER = {"version": "0", "device": "cpu", "study": {"title": "A study", "scales": [1.0]}}
DOORS = {
    "export": (exported, json.dumps(RESULT)),
    "predict": (vehicle_of, json.dumps(RESULT)),
    "airframe": (load_airframe, MINE),
    "bracket": (bracket, "alpha1 = [-1.0, 1.0]\nalpha3 = [100, 200]\n"),
    "study": (load_study, STUDY),
    "study.json": (store, json.dumps(HEADER)),
}
LITERALS = ["1e308", "1e999", "nan", "inf", "-1", "0", "0x" + 5000 * "f", '"\\u0007"', "[]", "{}", NESTED, "1979-05-27"]


@pytest.mark.slow
@pytest.mark.parametrize("name", DOORS)
def test_a_damaged_file_ends_in_one_line(name, tmp_path):
    door, text = DOORS[name]
    path = tmp_path / "file"
    path.write_text(text, encoding="utf-8")
    assert in_one_line(door, path) == (name != "study.json")  # that one is of another version
    words = [i for i in range(1, len(text)) if text[i].isdigit() and not text[i - 1].isalnum()]

    @given(accidents=ACCIDENTS, place=st.sampled_from(words), literal=st.sampled_from(["", *LITERALS]))
    @settings(max_examples=60)
    def bytes_are_damaged(accidents, place, literal):
        end = next(i for i in range(place, len(text) + 1) if i == len(text) or text[i] not in "0123456789.eE+-")
        other = text if not literal else text[:place] + literal + text[end:]
        path.write_bytes(damaged(other.encode(), accidents if not literal else []))
        in_one_line(door, path)

    bytes_are_damaged()
    if text.startswith("{"):
        survives_strange_values(door, path, [text], examples=60)


# The cases that were found


@pytest.mark.parametrize("key", ["a" + 20_000 * ".b", "a" + 20_000 * " . 'b'", '[a."b"' + 20_000 * r'."\""' + "]"])
def test_a_key_of_many_parts_costs_little(key, save):
    path = save(f"{key} = 1" if key[0] == "a" else key)
    tracemalloc.start()
    with pytest.raises(InputError, match="nested too deeply; correct that place"):
        read_toml(path)
    assert tracemalloc.get_traced_memory()[1] < 200e6  # of which 134 MB are the largest file
    tracemalloc.stop()


@pytest.mark.parametrize("text", ["[" + 2_600_000 * "{}," + "{}]", '{"a":1' + 2_600_000 * ',"a":1' + "}"])
def test_more_values_than_a_study_has_are_refused_before_they_are_read(text, save):
    path = save(text, "r.json")
    tracemalloc.start()
    with pytest.raises(InputError, match="has more than 5,000,000 values; give a file of"):
        read_result(path)
    assert tracemalloc.get_traced_memory()[1] < 200e6
    tracemalloc.stop()
    with pytest.raises(InputError, match="has more than 500,000 values; correct that place"):
        load_airframe(save("mass = [" + 600_000 * "1," + "]", "a.toml"))


def result_with(change):
    result = json.loads(json.dumps(RESULT))
    change(result)
    return json.dumps(result)


def correlated(result):
    result["covariance"][0][1] = result["covariance"][1][0] = 1e9


RESULTS = {
    "huge value": result_with(lambda r: r["parameters"]["alpha3"].update(estimate=1e308)),
    "huge covariance": result_with(lambda r: r["covariance"][0].__setitem__(1, -1e308)),
    "correlation": result_with(correlated),
    "kind of what nobody reads": result_with(lambda r: r.update(sample_times=[[[1, 2], [3]]])),
    "estimator": result_with(lambda r: r.update(estimator='x coding: unicode_escape \\u000aopen("pwned.txt","w")')),
    "control character": result_with(lambda r: r.update(doubts=[{"result": "no_skill", "cause": "\0", "remedy": ""}])),
    "sample time": result_with(lambda r: r["provenance"].update(sample_time=-1.0)),
    "no length": result_with(lambda r: r["provenance"].pop("fitted_seconds")),
    "nested": NESTED,
    "nested inside": json.dumps(RESULT)[:-1] + ', "rollouts": ' + NESTED,
    "long number": json.dumps(RESULT)[:-1] + ', "rollouts": ' + 5000 * "9" + "}",
}


@pytest.mark.parametrize("case", RESULTS)
@pytest.mark.parametrize("command", ["export", "predict"])
def test_a_result_that_nobody_wrote_is_refused(run, save, tmp_path, command, case):
    save(RESULTS[case], "found.json")
    save("t,omega1,omega2,omega3,omega4,p,q,r\n0,9,9,9,9,0,0,0\n0.01,9,9,9,9,0,0,0\n", "flight.csv")
    arguments = ("--to", "rotorpy", "--out", "v.py") if command == "export" else ("flight.csv", "--json", "v.json")
    refused(run(command, "found.json", *arguments), "found.json: ", "jaxos4 estimate")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flight.csv", "found.json"]


SPOILT = {
    "no coordinate": (lambda data: data.drop_vars("excitation"), "no excitation"),
    "another kind": (lambda data: data.assign_coords(level=[-1, -1, -1, -1]), "level"),
    "no codes": (lambda data: without(data), "codes"),
    "another code": (
        lambda data: data.assign(result=(data["result"] + 100).assign_attrs(data["result"].attrs)),
        "code",
    ),
    "text of numbers": (lambda data: data.assign(std=data["std"].astype(str)), "std is of another kind"),
    "infinite level": (lambda data: data.assign_coords(level=[0.5, 0.9, 0.95, np.inf]), "level"),
    "control": (lambda data: data.assign_coords(estimator=["ibss", "a\x07"]), "`estimator` is not one line"),
    "failures": (lambda data: data.assign_attrs(failures='[{"cell": 1}]'), "`failures`"),
    "nested failures": (lambda data: data.assign_attrs(failures=NESTED[:50_000]), "`failures`"),
    "empty": (lambda data: data.isel(flight=slice(0, 0)), "another kind or shape"),
}


def without(data):
    data = data.copy()
    for each in data.variables.values():
        each.attrs = {}
    return data


@pytest.mark.parametrize("case", SPOILT)
def test_a_dataset_that_no_study_wrote_is_refused(run, tmp_path, case):
    spoil, words = SPOILT[case]
    (tmp_path / "study").mkdir()
    data = synthetic_study(flights=4, scales=(1.0,), estimators=("ibss", "hybrid"), spoiled=False)
    spoil(data).to_netcdf(tmp_path / "study" / "results.nc", engine="h5netcdf")
    refused(run("report", "study"), "study/results.nc: ", words)
    assert [path.name for path in (tmp_path / "study").iterdir()] == ["results.nc"]


ELSEWHERE = {
    "a pipe": lambda file: file.__setitem__("zz", h5py.ExternalLink("pipe", "/x")),
    "a name": lambda file: file.__setitem__("zz", h5py.SoftLink("/zz")),
    "a device": lambda file: file.create_dataset("zz", (4,), "f8", external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)]),
    "another file": lambda file: file.create_virtual_dataset("zz", virtual_layout()),
}


def virtual_layout():
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = h5py.VirtualSource("pipe", "x", (4,))
    return layout


@pytest.mark.skipif(os.name != "posix", reason="makes a pipe")
@pytest.mark.parametrize("case", ELSEWHERE)
def test_a_dataset_that_leads_to_another_file_is_refused(case, tmp_path):
    """A pipe would never answer."""
    data = synthetic_study(flights=4, scales=(1.0,), estimators=("ibss", "hybrid"), spoiled=False)
    data.to_netcdf(tmp_path / "results.nc", engine="h5netcdf")
    os.mkfifo(tmp_path / "pipe")
    with h5py.File(tmp_path / "results.nc", "r+") as file:
        ELSEWHERE[case](file)
    with pytest.raises(InputError, match=r"it has a link to another place|its arrays are in another file"):
        read_results(tmp_path)


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


@pytest.mark.skipif(os.name != "posix", reason="makes a pipe")
def test_a_pipe_is_written_if_somebody_reads_it_and_else_refused(tmp_path):
    """To open a pipe without a reader would wait for ever."""
    os.mkfifo(pipe := tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe: nobody reads this pipe; start its reader first"):
        write_file(pipe, "x")
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_file(pipe, "x")
    assert os.read(reader, 9) == b"x"
    os.close(reader)


PIPES = {
    "result": jaxos4.read_result,
    "airframe": load_airframe,
    "log": read_log,
    "columns": lambda path: read_log(path.parent / "log.csv", columns=path),
    "network": load_network,
}


@pytest.mark.skipif(os.name != "posix", reason="makes a pipe")
@pytest.mark.parametrize("door", PIPES)
def test_a_pipe_that_nobody_writes_is_refused(door, tmp_path):
    """To open it would wait for ever."""
    os.mkfifo(pipe := tmp_path / "pipe")
    (tmp_path / "log.csv").write_text("t,gyro\n0,1\n1,2\n", encoding="utf-8")
    with pytest.raises(InputError, match="pipe: "):
        PIPES[door](pipe)


@pytest.mark.skipif(os.name != "posix", reason="makes a pipe")
def test_a_pipe_with_a_writer_is_read_to_its_end():
    reader, writer = os.pipe()
    thread = threading.Thread(target=lambda: (time.sleep(0.1), os.write(writer, MINE.encode()), os.close(writer)))
    thread.start()
    assert load_airframe(f"/dev/fd/{reader}").mass == 0.6
    thread.join()
    os.close(reader)


# Texts in exported files and drafts

HOSTILE = ['"""', "'''", "-->", "--->", "]]>", "<!--", "</mujoco>", "&", "&lt;", "<", '"', "\\", "\\u000a", "#", "--"]
HOSTILE += ["coding: unicode_escape", "-*- coding: utf-7 -*-", "\nimport os", "\r", "\x0c", "\x85", "\u2028", "\x1b[2J"]
HOSTILE += ["\udcff", "\ufffe", "{{ 1 }}", "{% raw %}", "é", "\u202e", "mass = 1", "{}", "%s", " ", "'", "b" * 40]
NAMES = st.lists(st.sampled_from(HOSTILE), min_size=1, max_size=4).map("".join)


def parsed(text, target):
    """The names of a Python file outside of strings and comments, or the parts of an XML file that are no comments.

    Of a TOML file, all that is in it.
    """
    if target == "drone-models":
        return tomllib.loads(text)
    if target != "rotorpy":
        return {part for each in ElementTree.fromstring(text).iter() for part in (each.tag, *each.attrib.values())}
    first, second = text.split("\n")[:2]
    assert (first.isascii(), second) == (True, "")
    ast.parse(text)
    ast.parse(text.encode())  # as Python reads a file, with its encoding
    tokens = tokenize.tokenize(io.BytesIO(text.encode()).readline)
    return {token.string for token in tokens if token.type in (tokenize.NAME, tokenize.OP)}


@pytest.mark.slow
def test_hostile_names_are_in_comments_alone(tmp_path):
    path = tmp_path / "found.json"
    path.write_text(json.dumps(RESULT), encoding="utf-8")
    found = read_result(path)
    usual = {target: parsed(export_vehicle(found, target).text, target) for target in TARGETS}
    log = read_recording(write_log(tmp_path / "flight.csv"))
    draft = airframe_draft(log)[0]

    @given(name=NAMES)
    @settings(max_examples=200)
    def law(name):
        hostile = found._replace(source=name, result="no_skill", doubts=(name,), notes=(name, f"Note: {name}"))
        for target in TARGETS:
            written = export_vehicle(hostile, target)
            assert parsed(written.text, target) == usual[target]
            assert all(note.isprintable() for note in written.notes[2:])
        named = airframe_draft(log._replace(name=name))[0]
        assert named.splitlines()[1:] == draft.splitlines()[1:]
        assert named.splitlines()[0].isprintable()

    law()


def write_log(path, names="t,omega1,omega2,omega3,omega4,p,q,r", extra=()):
    """A short log."""
    time = 0.01 * np.arange(400)
    motion = 0.1 * np.sin(np.outer(time, [3, 4, 5]))
    path.write_bytes(table_csv(names.split(","), time, np.full((400, 4), 1740.0), motion, *extra))
    return path


def test_a_name_with_a_line_break_writes_nothing_into_the_drafted_airframe(run, tmp_path):
    write_log(tmp_path / "a\nmass = 1\n.csv")
    code, out, err = run("inspect", "a\nmass = 1\n.csv", "--airframe-out", "mine.toml")
    assert (code, err) == (0, "")
    text = (tmp_path / "mine.toml").read_text(encoding="utf-8")
    assert text.startswith("# The airframe of a\\nmass = 1\\n.csv. SI units.\n")
    assert "\nmass" not in text
    assert "a\\nmass = 1\\n.csv: flight CSV" in out
    refused(run("estimate", "a\nmass = 1\n.csv", "--model", "flight"), "--airframe-out mine.toml` begins one")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes on Linux alone")
def test_a_name_that_is_not_utf8_is_estimated_and_shown(run, tmp_path):
    name = os.fsencode(write_log(tmp_path / "x.csv").parent) + b"/l\xffg.csv"
    os.rename(tmp_path / "x.csv", name)
    arguments = ("equation-error", "--out", b"f\xff.json", "--model", "published", "--airframe", "os4")
    line = [sys.executable, "-m", "jaxos4", "estimate", name, "--estimator", *arguments]
    done = subprocess.run(line, cwd=tmp_path, env=small_study.environment(), capture_output=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    assert b"Traceback" not in done.stderr
    (written,) = tmp_path.glob("*.json")
    assert json.loads(written.read_bytes())["provenance"]["flight"].endswith("l\\udcffg.csv")
    code, out, _ = run("inspect", os.fsdecode(name))
    assert (code, "l\\udcffg.csv: flight CSV" in out) == (0, True)


# Logs


def test_the_columns_that_are_there_are_named_if_time_is_not(tmp_path):
    path = write_log(tmp_path / "log.csv", "time,omega1,omega2,omega3,omega4,p,q,r")
    words = r"there is no time; .* There are 'omega1', .*, 'time': rename one, or give a column map\.$"
    with pytest.raises(InputError, match=words):
        read_log(path)


def test_all_impossible_rotor_speeds_count_as_not_measured_and_not_only_the_largest(tmp_path):
    path = write_log(tmp_path / "log.csv")
    lines = path.read_text().splitlines()
    for row, speed in ((100, 104_720.0), (250, 33_000.0)):
        cells = lines[row].split(",")
        lines[row] = ",".join([*cells[:2], str(speed), *cells[3:]])
    path.write_text("\n".join(lines))
    found = read_recording(path)
    assert found.notes == ("impossible values count as not measured, in omega2: 2 (first 104720 rad/s at 0.99 s)",)
    np.testing.assert_array_equal(found.omega, 1740.0)
    assert inspect_log(found).parts
    # A motor that idles for most of the log, and then flies six times as fast, is possible.
    rows = [[0.01 * k, *4 * [300.0 if k < 395 else 1800.0], math.sin(k), 0, 0] for k in range(400)]
    path.write_bytes(table_csv("t,omega1,omega2,omega3,omega4,p,q,r".split(","), np.array(rows)))
    assert read_recording(path).omega.max() == 1800.0


def test_a_corrupt_field_of_an_esc_is_missing():
    fields = {"esc[0].actuator_function": np.array([101.0, np.nan]), "esc[1].state": np.array([5.0])}
    log = Messages("log", {"esc_status": {0: fields}}, "")
    assert log.latest("esc_status", "esc[0].actuator_function") is None
    assert log.latest("esc_status", "esc[1].state") == 5.0
