"""`jaxos4 estimate` of real vehicles: the parameters of a simulated vehicle from two logs, and wrong requests."""

import json
import shutil
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refused
from test_logs_ulog import everything

import jaxos4
from jaxos4.estimators import ESTIMATORS
from jaxos4.recording.preparation import prepare
from jaxos4.recording.reading import read_recording, vehicle_evidence

AIRFRAME = """
mass = 0.65
arm = 0.23
inertia = [7.5e-3, 7.5e-3, 1.3e-2]
thrust_coefficient = 3.13e-5
drag_coefficient = 7.5e-7
rotor_inertia = 6e-5
max_rotor_speed = 500.0
"""
TERMS = ("offset", "lag")
TRUTH = {"roll_offset_1": 0.8, "pitch_offset_1": -0.5, "roll_offset_2": -0.6, "rotor_lag": 0.06, "alpha3": 120.0}


def rewritten(path: Path, name: str, change) -> Path:
    """A log beside another one, with its header and its rows changed."""
    header, *rows = (line.split(",") for line in path.read_text(encoding="utf-8").splitlines())
    header, rows = change(header, rows)
    to = path.with_name(name)
    to.write_text("\n".join(",".join(row) for row in (header, *rows)) + "\n", encoding="utf-8")
    return to


def as_commands(header, rows):
    names = [name.replace("omega", "command") for name in header]
    return names, [[row[0], *(repr(float(x) / 500.0) for x in row[1:5]), *row[5:]] for row in rows]


def rarely(header, rows):
    at = header.index("q")
    return header, [row if k % 10 == 0 else [*row[:at], "", *row[at + 1 :]] for k, row in enumerate(rows)]


@pytest.fixture(scope="module")
def vehicle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an airframe, and two logs of commands whose rotors lag; each also with other contents."""
    folder = tmp_path_factory.mktemp("vehicle")
    (folder / "airframe.toml").write_text(AIRFRAME, encoding="utf-8")
    airframe = jaxos4.load_airframe(str(folder / "airframe.toml"))
    model = jaxos4.FlightModel(airframe, terms=TERMS)
    for number in (1, 2):
        named = {**TRUTH, **{k.removesuffix(f"_{number}"): v for k, v in TRUTH.items() if k.endswith(f"_{number}")}}
        parameters = jnp.array(
            [named.get(n, float(a)) for n, a in zip(model.parameter_names, model.alpha, strict=True)]
        )
        omega = jaxos4.multisine(airframe, duration=8.0, dt=0.01)
        flight = jaxos4.simulate(model, parameters, omega, dt=0.01, method="rk4")
        noisy = jaxos4.WhiteNoise(0.01)(flight, key=jax.random.key(number))
        rates = np.full((omega.shape[0], 12), np.nan)
        rates[:, [7, 9, 11]] = np.asarray(noisy.states)[:, [7, 9, 11]]
        speeds = folder / f"speeds{number}.csv"
        jaxos4.write_flight(eqx.tree_at(lambda f: f.states, flight, jnp.asarray(rates)), speeds)
        rewritten(rewritten(speeds, f"flight{number}.csv", as_commands), f"rare{number}.csv", rarely)
    return folder


def test_two_logs_share_the_vehicle(run, vehicle, tmp_path, monkeypatch):
    monkeypatch.chdir(vehicle)
    files = ("--out", str(tmp_path / "found.json"), "--report", str(tmp_path / "found.html"))
    logs = ("flight1.csv", "flight2.csv", "--airframe", "airframe.toml")
    code, page_text, err = run("estimate", *logs, "--terms", ",".join(TERMS), *files)
    assert code == 0, err
    report = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    assert report["result"] == "successful"
    for name, truth in TRUTH.items():
        row = report["parameters"][name]
        assert abs(row["estimate"] - truth) < 4 * row["std"], (name, row)
    assert abs(report["parameters"]["rotor_lag"]["estimate"] - 0.06) < 0.005
    # The model has the true equations: it predicts the held-out part up to the noise.
    assert min(report["skill"][rate]["skill"][1] for rate in "pq") > 0.9
    assert "inertias" in page_text
    page = (tmp_path / "found.html").read_text(encoding="utf-8")
    assert all(name in page for name in TRUTH)
    assert report["provenance"]["terms"] == list(TERMS)
    # The log says that it is of a real vehicle, and the page says that this decided.
    assert report["model"] == "flight"
    chosen = "flight1.csv has commands, not rotor speeds: taken as a real vehicle's (--model flight)"
    assert report["provenance"]["notes"][0] == chosen
    assert "note: " in page_text


# A command line in the folder of the logs, and what its message says. `VEHICLE`: a log with its airframe.
VEHICLE = "flight1.csv --airframe airframe.toml"
BIASED = [name for name, kind in ESTIMATORS.items() if not kind.in_closed_loop]
REFUSED = {
    f"{VEHICLE} --model flight --terms wings": "--terms: knows no `wings`",
    f"{VEHICLE} --terms wings": "--terms: knows no `wings`",
    f"{VEHICLE} --model flight --terms velocity": "did not measure",
    f"{VEHICLE} --model flight --holdout 0.9": "--holdout",
    f"{VEHICLE} --model flight --window 0.25": "--window: a vehicle is identified from its rates",
    f"{VEHICLE} --model flight --sample-time nan": "--sample-time",
    f"{VEHICLE} --model flight --sample-time 0.001": "--sample-time",
    f"{VEHICLE} --model flight --from 5 --to 4": "--from",
    f"{VEHICLE} --model flight --from 50": "fewer than two samples",
    **{f"{VEHICLE} --estimator {name}": f"--estimator {name}: is biased by a controller" for name in BIASED},
    f"{VEHICLE} --model flight --channels rates": "--channels",
    f"{VEHICLE} --model flight --initial-state known": "--initial-state",
    f"{VEHICLE} --model published --terms offset": "--terms",
    f"{VEHICLE} --model published --from 1": "--from",
    f"{VEHICLE} --model published --report r.html": "--report",
    f"flight2.csv {VEHICLE} --model corrected": "--model flight for several",
    f"flight1.csv {VEHICLE} --model flight": "given twice",
    f"{VEHICLE} --model flight --validate flight1.csv": "is fitted",
    f"speeds2.csv {VEHICLE} --model flight": "some of these logs hold commands",
    f"{VEHICLE} --model flight --validate rare2.csv": "nothing is long enough to be predicted 0.5 s ahead",
    "flight1.csv": "flight1.csv has commands, not rotor speeds: a real vehicle needs --airframe; `jaxos4 inspect",
    "speeds1.csv --model flight": "--model flight: a real vehicle needs --airframe; `jaxos4 inspect",
    "speeds1.csv --report r.html": "--report: is for real vehicles, and speeds1.csv has no sign of one",
}


@pytest.mark.parametrize(("line", "said"), REFUSED.items(), ids=REFUSED)
def test_wrong_requests_are_one_line(run, vehicle, monkeypatch, line, said):
    monkeypatch.chdir(vehicle)
    out = () if "--report" in line else ("--out", "out.json")
    refused(run("estimate", *line.split(), *out), said)
    assert not list(vehicle.glob("*.json"))
    assert not list(vehicle.glob("*.html"))


def test_a_log_shows_whether_its_vehicle_is_real(vehicle, tmp_path):
    commands = read_recording(vehicle / "flight1.csv", full_scale=1.0)
    assert vehicle_evidence(commands) == "has commands, not rotor speeds"
    felt = commands._replace(commanded=False, specific_force=np.ones((commands.time.size, 3)))
    assert vehicle_evidence(felt) == "has an accelerometer"
    speeds = commands._replace(commanded=False)
    assert vehicle_evidence(speeds) == ""
    (tmp_path / "log").write_bytes(everything())
    assert vehicle_evidence(speeds._replace(name=str(tmp_path / "log"))) == "is a log of a vehicle (PX4 ULog)"
    assert vehicle_evidence(speeds._replace(name="flight 1")) == ""


def test_each_measurement_is_either_fitted_or_held_out(vehicle):
    airframe = jaxos4.load_airframe(str(vehicle / "airframe.toml"))
    prepared, *_ = prepare([read_recording(vehicle / f"flight{i}.csv", airframe) for i in (1, 2)], airframe)
    assert prepared.tested is not None
    fitted, held_out = (~np.isnan(np.asarray(f.states)[:, 7]) for f in (prepared.fitted, prepared.tested))
    assert (fitted ^ held_out).all()
    assert 0.15 < held_out.mean() < 0.35
    assert prepared.recordings == (0, 1)
    assert prepared.available == {"commands", "full scale"}


@pytest.mark.parametrize("steps", [(1 / 252,), (1 / 249, 1 / 251), (0.01, 0.00998), (0.004,), (0.0040001, 0.003)])
def test_no_window_reaches_from_one_stretch_into_the_next(vehicle, tmp_path, steps):
    airframe = jaxos4.load_airframe(str(vehicle / "airframe.toml"))
    shutil.copy(vehicle / "flight1.csv", tmp_path)

    def sampled(header, rows, dt):
        return header, [[repr(k * dt), *row[1:]] for k, row in enumerate(rows)]

    original = tmp_path / "flight1.csv"
    paths = [rewritten(original, f"{i}.csv", partial(sampled, dt=dt)) for i, dt in enumerate(steps)]
    prepared, *_ = prepare([read_recording(path, airframe) for path in paths], airframe, holdout=0.0)
    flight, windows = prepared.fitted, prepared.windows
    assert flight.time.shape[0] == windows * prepared.length
    assert flight.stretch is not None
    for stretch in np.asarray(flight.stretch).reshape(windows, prepared.length):
        assert np.ptp(stretch) == 0
    model = jaxos4.FlightModel(airframe, recordings=prepared.recordings)
    problem = jaxos4.ShootingProblem(model, flight, sigma=np.ones(12), channels="rates", windows=windows)
    assert (np.diff(problem.window_of_samples().reshape(windows, -1)) == 0).all()
