"""`jaxos4 inspect` as a user types it: logs of each format, good and bad."""

import json

import numpy as np
import pytest
from recorded_logs import VEHICLE, blackbox_csv
from test_logs_blackbox import T as BLACKBOX_TIME, recorded
from test_logs_crazyflie import one_event
from test_logs_ulog import everything

LOGS = {
    "ULog": everything(),
    "blackbox": blackbox_csv(recorded(BLACKBOX_TIME)).encode(),
    "Crazyflie": one_event(0.004 * np.arange(750)),
}


@pytest.mark.parametrize("kind", LOGS)
def test_each_format_is_inspected(kind, run, tmp_path):
    (tmp_path / "log").write_bytes(LOGS[kind])
    (tmp_path / "vehicle.toml").write_text(VEHICLE)
    code, out, err = run("inspect", "log", "--airframe", "vehicle.toml", "--out", "log.json")
    assert (code, err) == (0, "")
    assert len(out.splitlines()) < 40  # a screen
    for words in ("p q r: ", "rad/s", "usable", "good ("):
        assert words in out
    report = json.loads((tmp_path / "log.json").read_text())
    assert report["format"] == kind
    assert report["measured"]["p"]["rate"] == pytest.approx(1 / report["sample_time"], rel=0.02)
    (part,) = report["parts"]
    assert part["usable"]
    assert part["excitation"]["roll"]["verdict"] == "good"


def test_a_simulated_flight_and_what_it_cannot_tell(run, tmp_path):
    assert run("simulate", "--duration", "3", "--noise", "1", "--out", "flight.csv")[0] == 0
    code, out, err = run("inspect", "flight.csv", "--airframe", "os4")
    assert (code, err) == (0, "")
    assert "flight CSV, 0.00 to 3.00 s, 301 samples, one every 10 ms" in out
    rows = [f"{0.01 * k:.2f},226,226,226,226,0,0,0" for k in range(200)]
    (tmp_path / "hover.csv").write_text("\n".join(["t,omega1,omega2,omega3,omega4,p,q,r", *rows]))
    code, out, err = run("inspect", "hover.csv", "--airframe", "os4")
    assert (code, err) == (0, "")
    assert "none (0)" in out


def test_commands_need_no_airframe_to_be_inspected(run, tmp_path):
    rows = [f"{0.01 * k:.2f},0.5,0.5,0.5,{0.5 + 0.1 * np.sin(k):.3f},0.1" for k in range(200)]
    (tmp_path / "c.csv").write_text("\n".join(["t,command1,command2,command3,command4,p", *rows]))
    code, out, err = run("inspect", "c.csv")
    assert (code, err) == (0, "")
    assert "up to 0.6 of full scale (commands)" in out
    assert "usable" in out
