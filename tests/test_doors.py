"""Nothing that comes from a file is trusted: the reader of a damaged file ends in one line.

Readers of logs: `test_logs_readers`; of studies: `test_study_specification`; of networks: `test_hybrid`. No text of a
file becomes code or markup: `test_export_descriptions`.
"""

import json
import os
import sys
import threading
import time

import numpy as np
import pytest
from flight_csvs import csv, write_log
from helpers import memory_below, output_of, refused
from hypothesis import given, settings, strategies as st
from recorded_logs import ACCIDENTS, damaged, outcome
from small_study import AIRFRAME, SPECIFICATION
from strange import in_one_line, parsed, survives_strange_values
from synthetic_results import predicting_result

import jaxos4
from jaxos4._files import read_toml, write_file
from jaxos4.airframe import load_airframe
from jaxos4.errors import InputError
from jaxos4.export import TARGETS, export_vehicle, read_result
from jaxos4.forecast import vehicle_of
from jaxos4.identification.prepare_os4 import bracket_of
from jaxos4.logs import read_log
from jaxos4.models import MODELS
from jaxos4.networks.file import load_network
from jaxos4.study import load_study
from jaxos4.study.dataset import read_store

MINE = AIRFRAME.replace("[airframe.mine]", "") + "max_rotor_speed = inf\n"
STUDY = SPECIFICATION.replace("title", 'airframes = ["mine"]\ntitle') + AIRFRAME
RESULT = predicting_result()
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


def study(path):
    """The numbers of a study are finite, and its flights can be flown."""
    found = load_study(path)
    assert found.cell(found.count - 1)
    assert np.isfinite([found.dt, *found.durations, *found.scales, *found.widths]).all()
    assert all(2 <= duration / found.dt <= 1e6 for duration in found.durations)


def store(path):
    (path.parent / "study.json").write_bytes(path.read_bytes())
    read_store(path.parent)


HEADER = {"version": "0", "device": "cpu", "study": {"title": "A study", "scales": [1.0]}}
DOORS = {
    "export": (exported, json.dumps(RESULT)),
    "predict": (vehicle_of, json.dumps(RESULT)),
    "airframe": (load_airframe, MINE),
    "bracket": (bracket, "alpha1 = [-1.0, 1.0]\nalpha3 = [100, 200]\n"),
    "study": (study, "dt = 0.01\nwidths = [1.0]\n" + STUDY),
    "study.json": (store, json.dumps(HEADER)),
    "flight": (lambda path: outcome(read_log, path), csv()),
}
LITERALS = ["1e308", "1e999", "nan", "inf", "-1", "0", "0x" + 5000 * "f", '"\\u0007"', "[]", "{}", NESTED, "1979-05-27"]
LITERALS += [*',;"- \0\r\n\u2028\ufeff١½', "1_0", "1 2", "\t1", "x" * 60, "1e-999", "1e5"]


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
    with memory_below(200e6), pytest.raises(InputError, match="nested too deeply; correct that place"):
        read_toml(path)  # 134 MB are the largest file


@pytest.mark.parametrize("text", ["[" + 2_600_000 * "{}," + "{}]", '{"a":1' + 2_600_000 * ',"a":1' + "}"])
def test_more_values_than_a_study_has_are_refused_before_they_are_read(text, save):
    path = save(text, "r.json")
    with memory_below(200e6), pytest.raises(InputError, match="has more than 5,000,000 values; give a file of"):
        read_result(path)
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
@pytest.mark.parametrize("reader", [read_result, vehicle_of])
def test_a_result_that_nobody_wrote_is_refused(save, reader, case):
    path = save(RESULTS[case], "found.json")
    with pytest.raises(InputError, match="jaxos4 estimate") as caught:
        reader(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).isprintable()


PIPES = {
    "result": jaxos4.read_result,
    "airframe": load_airframe,
    "log": read_log,
    "columns": lambda path: read_log(path.parent / "log.csv", columns=path),
    "network": load_network,
    "written": lambda path: write_file(path, "x"),
}


@pytest.mark.skipif(os.name != "posix", reason="makes a pipe")
@pytest.mark.parametrize("door", PIPES)
def test_a_pipe_without_another_end_is_refused(door, tmp_path):
    """To open it would wait for ever."""
    os.mkfifo(pipe := tmp_path / "pipe")
    (tmp_path / "log.csv").write_text("t,gyro\n0,1\n1,2\n", encoding="utf-8")
    with pytest.raises(
        InputError, match="pipe: nobody reads this pipe; start its r" if door == "written" else "pipe: "
    ):
        PIPES[door](pipe)


@pytest.mark.skipif(os.name != "posix", reason="makes a pipe")
def test_a_pipe_with_another_end_is_written_and_read_to_its_end(tmp_path):
    os.mkfifo(pipe := tmp_path / "pipe")
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_file(pipe, "x")
    assert os.read(reader, 9) == b"x"
    os.close(reader)
    reader, writer = os.pipe()
    thread = threading.Thread(target=lambda: (time.sleep(0.1), os.write(writer, MINE.encode()), os.close(writer)))
    thread.start()
    assert load_airframe(f"/dev/fd/{reader}").mass == 0.6
    thread.join()
    os.close(reader)


# Names of logs


def test_a_name_with_a_line_break_writes_nothing_into_the_drafted_airframe(run, tmp_path):
    write_log(tmp_path / "a\nmass = 1\n.csv")
    out = output_of(run("inspect", "a\nmass = 1\n.csv", "--airframe-out", "mine.toml"))
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
    known = ("--estimator", "equation-error", "--model", "published", "--airframe", "os4")
    assert run("estimate", os.fsdecode(name), *known, "--out", os.fsdecode(b"f\xff.json"))[0] in (0, 1)
    (written,) = tmp_path.glob("*.json")
    assert json.loads(written.read_bytes())["provenance"]["flight"].endswith("l\\udcffg.csv")
    code, out, _ = run("inspect", os.fsdecode(name))
    assert (code, "l\\udcffg.csv: flight CSV" in out) == (0, True)
