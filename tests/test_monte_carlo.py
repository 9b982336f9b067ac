"""The loop of the experiments: rows of flights, lost flights, interrupted files, and tables."""

import json

import numpy as np
import pytest

from experiments import monte_carlo as loop


def run(out, fitted, *, kinds=("calm", "gusty"), seed=1, broken=None):
    """Two kinds of three flights, of which one is lost; `fitted` gets each flight that is fitted now."""

    def row_of(kind, flight):
        if (kind, flight) == broken:
            raise KeyboardInterrupt
        if flight == 1:
            return {"result": loop.LOST}
        fitted.append((kind, flight))
        return {"result": "successful", "error": 1.0 + flight}

    return loop.study(out, {"seed": seed}, loop.product(kind=kinds, flight=range(3)), row_of)


def test_each_flight_has_a_row_and_lost_ones_are_in_no_group():
    rows, fitted = run(None, now := []), now
    assert fitted == [("calm", 0), ("calm", 2), ("gusty", 0), ("gusty", 2)]
    groups = loop.groups(rows, "kind")
    assert list(groups) == [("calm",), ("gusty",)]
    for some in groups.values():
        assert [row["flight"] for row in some] == [0, 2]
        found = loop.statistics(np.array([row["error"] for row in some]), np.array([1.0, 10.0]))
        assert (found["mean"], found["covered"], loop.results_of(some)) == (2.0, 1.0, "2 successful")


def test_an_interrupted_file_is_continued_and_one_with_other_settings_is_refused(tmp_path):
    out, before, after = tmp_path / "out.json", [], []
    with pytest.raises(KeyboardInterrupt):
        run(out, before, broken=("gusty", 2))
    rows = run(out, after)
    assert (before[-1], after) == (("gusty", 0), [("gusty", 2)])
    assert rows == run(None, []) == json.loads(out.read_text())["rows"]
    assert run(out, again := [], kinds=("gusty",)) == rows
    assert again == []
    with pytest.raises(SystemExit, match="other settings"):
        run(out, [], seed=2)


def test_a_table_cuts_no_cell(capsys):
    rows = [("a", loop.interval({"estimate": 2e-5, "std": 1e-6}, 1e5)), ("b", loop.interval(None, 1.0))]
    loop.print_table("a title", ("name", "Ix"), rows)
    assert "2.00 +- 0.20" in capsys.readouterr().out
