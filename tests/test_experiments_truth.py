"""`experiments/truth`: flights of another's simulator are flown, identified and counted."""

import json

import pytest
from small_experiments import load, result_of

# A simulator in this package's stead: the experiment must find, call and believe it.
FLY = """
import json, pathlib, shutil
import jaxos4
CRAZYFLIE = pathlib.Path(jaxos4.__file__).with_name("airframes") / "crazyflie.toml"
def fly(case, out):
    airframe = jaxos4.load_airframe("crazyflie")
    loop = jaxos4.ClosedLoop(airframe, gust=1.0, logged="speeds")
    flight = jaxos4.closed_loop.fly_standard(loop, duration=case["seconds"], seed=case["seed"])
    jaxos4.write_flight(flight, out / f"{case['name']}.csv", airframe)
    shutil.copy(CRAZYFLIE, out / f"{case['name']}.toml")
    truth = dict(zip(("Ix", "Iy", "Iz"), (case["scale"] * float(x) for x in airframe.inertia)))
    (out / f"{case['name']}.truth.json").write_text(json.dumps(truth))
"""
CASES = [
    {"name": f"flight{i}", "effect": "none", "seed": i, "seconds": 16, "scale": s} for i, s in ((0, 1.0), (1, 3.0))
]


@pytest.fixture
def simulator(tmp_path):
    folder = tmp_path / "simulator"
    folder.mkdir()
    (folder / "fly.py").write_text(FLY)
    (folder / "cases.jsonl").write_text("".join(json.dumps(case) + "\n" for case in CASES))
    return folder


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_cases_are_flown_identified_and_counted(capsys, simulator, tmp_path):
    """The second case has a false truth: the estimate is wrong, and is counted as wrong."""
    report = result_of(tmp_path, "truth", truth=simulator)
    good, bad = report["rows"]
    for row, scale in ((good, 1.0), (bad, 3.0)):
        known = row["quantities"]["Ix"]
        assert known["status"].startswith("identified")
        assert abs(scale * known["estimate"] / known["truth"] - 1) < 0.1
    wrong = {what: names for what, _, names in load("truth").counts(report["rows"])}
    assert any(
        "flight1 Ix" in wrong[what] for what in ("identified, beyond 3 std or 12 %", "with a reservation, beyond 4 std")
    )
    assert "flight0" not in "".join(wrong.values())
    assert "flight1" in capsys.readouterr().out


def row_of(case, name, ratio, std, status):
    known = {"truth": 2.0, "estimate": 2.0 * ratio, "std": 2.0 * std, "status": status, "reasons": []}
    return {"case": case, "effect": "none", "result": "", "missing": {}, "quantities": {name: known}}


def test_each_kind_of_wrong_answer_is_counted():
    rows = [
        row_of("a", "Ix", 1.04, 0.01, "identified"),
        row_of("b", "Ix", 1.13, 0.2, "identified"),
        row_of("c", "Iy", 1.11, 0.05, "identified"),
        row_of("d", "Iz", 1.5, 0.1, "identified with a reservation"),
        row_of("e", "Iz", 1.35, 0.1, "identified with a reservation"),
        row_of("f", "Ix", 1.05, 0.03, "contradicted"),
        row_of("g", "Ix", 1.15, 0.1, "not identified"),
        row_of("h", "roll_damping", 1.15, 0.1, "identified"),
    ]
    truth = load("truth")
    found = {what: (count, names) for what, count, names in truth.counts(rows)}
    assert found == {
        "identified, beyond 3 std or 12 %": (2, "a Ix, b Ix"),
        "with a reservation, beyond 4 std": (1, "d Iz"),
        "refused, but right": (1, "f Ix"),
        "values": (7, ""),
    }
    assert truth.cell(rows[0], "Ix") == "1.040 +4.0 I"
    assert truth.cell(rows[0], "Iy") == ""
    assert truth.cell(rows[0] | {"missing": {"Iz": "not identified"}}, "Iz") == "N"
    held = {name: line for name, *line in truth.linearised(rows)}
    assert held["roll_damping"][:2] == ["1", "100 +- 50.0"]


def test_the_studies_have_each_vehicle_and_sag():
    cases = load("truth").studies(2, 1)
    assert len(cases) == 3 * (2 * 4 + 1)
    assert cases["sag_10_big_1"]["sim"]["over"]["sag_load"] == 0.1
    assert cases["clean_nano_0"]["kind"] == "sine"


def test_a_simulator_that_is_missing_is_named(monkeypatch, simulator, tmp_path):
    monkeypatch.setenv("JAXOS4_TRUTH", str(tmp_path / "nowhere"))
    with pytest.raises(SystemExit, match="--truth: no cases.jsonl in .*nowhere: give the folder"):
        load("truth").main()
    with pytest.raises(SystemExit, match="--cases: no flight7 in cases.jsonl"):
        load("truth").main(truth=simulator, cases=["flight7"])
