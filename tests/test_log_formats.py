"""A new log format is one file and one line in the registry."""

import json

import numpy as np
import pytest

from jaxos4.errors import InputError
from jaxos4.logs import FORMATS, LogFormat, Table, log_format, read_log
from jaxos4.logs.table import opened, refuse

# The new file.


def read_json_log(path):
    """The first line names the log; the second holds the columns."""
    with opened(path) as file:
        lines = file.readlines()
    try:
        columns = {name: np.array(values, dtype=float) for name, values in json.loads(lines[1]).items()}
    except (ValueError, IndexError):
        refuse(path, "has no columns; write them as one JSON object", row=2)
    return Table(path, columns, first_row=None), ("times are those of the logger",)


JSON_LOG = LogFormat("JSON", "two-line JSON", lambda begin: begin.startswith(b'{"log"'), read_json_log)


@pytest.fixture
def log(save, monkeypatch):
    monkeypatch.setattr("jaxos4.logs.FORMATS", (JSON_LOG, *FORMATS))  # the new line
    t = 0.01 * np.arange(300)
    columns = {"t": t, **{f"omega{i}": np.full(300, 226.0) for i in range(1, 5)}, "p": np.sin(t)}
    return save('{"log": 1}\n' + json.dumps({name: column.tolist() for name, column in columns.items()}), "log")


def test_a_new_format_is_read_and_inspected(log, save, run):
    flight, notes = read_log(log)
    assert notes == ("times are those of the logger",)
    np.testing.assert_array_equal(np.asarray(flight.states)[:, 7], np.sin(0.01 * np.arange(300)))
    assert log_format(log) is JSON_LOG
    code, out, err = run("inspect", "log", "--out", "found.json")
    assert (code, err) == (0, "")
    assert out.startswith("log: two-line JSON, 0.00 to 2.99 s, 300 samples")
    assert json.loads(log.with_name("found.json").read_text())["format"] == "JSON"
    with pytest.raises(InputError, match=r"bad: row 2: has no columns; write them as one JSON object\.$"):
        read_log(save('{"log": 1}\n', "bad"))
    assert log_format(save("t,p\n", "other")).name == "CSV"
