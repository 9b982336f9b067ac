"""RotorPy's vehicle is flown, recorded and identified in a small configuration."""

import numpy as np
import pytest
from small_experiments import load, report_of

import jaxos4


@pytest.mark.usefixtures("quickly_compiled")
def test_rotorpy(tmp_path):
    pytest.importorskip("rotorpy.vehicles.multirotor", reason="pip install rotorpy")
    cases = {"flights": 1, "kinds": ["calm"], "duration": 8.0, "estimators": ["filter-error"]}
    report = report_of("rotorpy", tmp_path, recordings=tmp_path / "flights", **cases)
    (path,) = (tmp_path / "flights").iterdir()
    flight = jaxos4.read_flight(path)
    assert np.isfinite(flight.omega).all()
    # Frames, positions and spins are those of jaxos4: torques of the airframe make the body accelerate.
    vehicle = load("rotorpy", "flights").VEHICLE
    rates = np.asarray(flight.states)[:, [7, 9, 11]]
    change = np.diff(rates[::5], axis=0) / (5 * float(flight.dt))
    speeds = np.asarray(flight.omega)[: 5 * len(change)].reshape(-1, 5, 4)
    expected = np.square(speeds).mean(axis=1) @ vehicle.mixer[:3].T / vehicle.inertia
    for axis in range(3):
        assert np.corrcoef(change[:, axis], expected[:, axis])[0, 1] > 0.9
    (case,) = report["cases"]
    assert [row["result"] for row in case["flights"]] == ["successful"]
    assert all(abs(case["summary"][name]["mean"]) < 0.05 for name in ("Ix", "Iy", "Iz", "thrust"))
    # The flights that are there are not flown again, and those that were identified are not identified again.
    recorded = path.stat().st_mtime_ns
    assert report_of("rotorpy", tmp_path, recordings=tmp_path / "flights", **cases) == report
    assert path.stat().st_mtime_ns == recorded
