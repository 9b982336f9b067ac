"""The loop of the experiments: rows of flights, lost flights, interrupted files, and tables."""

import json

import numpy as np
import pytest

from experiments import monte_carlo as loop


def run(out, fitted, *, kinds=("calm", "gusty"), seed=1, broken=None):
    """Two kinds of three flights, of which one is lost; `fitted` gets each flight that is fitted now."""

    def row_of(flight, i, kind):
        if (kind, i) == broken:
            raise KeyboardInterrupt
        fitted.append((kind, i))
        return {"result": "successful", "error": flight}

    def summary(rows):
        return {"mean": float(np.mean([row["error"] for row in rows]))}

    cases = [{"kind": kind} for kind in kinds]
    return loop.monte_carlo(out, {"seed": seed}, cases, lambda kind: [1.0, None, 3.0], row_of, summary)


def test_each_flight_has_a_row_in_its_case_and_lost_ones_have_none():
    report, fitted = run(None, now := []), now
    assert fitted == [("calm", 0), ("calm", 2), ("gusty", 0), ("gusty", 2)]
    assert [case["kind"] for case in report["cases"]] == ["calm", "gusty"]
    for case in report["cases"]:
        assert [row["flight"] for row in case["flights"]] == [0, 2]
        assert (case["summary"], loop.results_of(case)) == ({"mean": 2.0}, "2 successful")


def test_an_interrupted_file_is_continued_and_one_with_other_settings_is_refused(tmp_path):
    out, before, after = tmp_path / "out.json", [], []
    with pytest.raises(KeyboardInterrupt):
        run(out, before, broken=("gusty", 2))
    report = run(out, after)
    assert (before[-1], after) == (("gusty", 0), [("gusty", 2)])
    assert report == run(None, []) == json.loads(out.read_text())
    assert run(out, again := [], kinds=("gusty",)) == report
    assert again == []
    with pytest.raises(SystemExit, match="other settings"):
        run(out, [], seed=2)


def test_a_table_cuts_no_cell(capsys):
    rows = [("a", loop.interval({"estimate": 2e-5, "std": 1e-6}, 1e5)), ("b", loop.interval(None, 1.0))]
    loop.print_table("a title", ("name", "Ix"), rows)
    assert "2.00 +- 0.20" in capsys.readouterr().out
