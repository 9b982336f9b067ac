"""`jaxos4 estimate` of real vehicles: the parameters of a simulated vehicle from two logs, and wrong requests."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refused
from test_logs_ulog import everything

import jaxos4
from jaxos4.cli._choices import VehicleModel
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


@pytest.fixture(scope="module")
def vehicle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an airframe, and two logs of commands whose rotors lag."""
    folder = tmp_path_factory.mktemp("vehicle")
    (folder / "airframe.toml").write_text(AIRFRAME, encoding="utf-8")
    airframe = jaxos4.load_airframe(str(folder / "airframe.toml"))
    for number in (1, 2):
        model = jaxos4.FlightModel(airframe, terms=TERMS)
        named = {**TRUTH, **{k.removesuffix(f"_{number}"): v for k, v in TRUTH.items() if k.endswith(f"_{number}")}}
        parameters = jnp.array(
            [named.get(n, float(a)) for n, a in zip(model.parameter_names, model.alpha, strict=True)]
        )
        omega = jaxos4.multisine(airframe, duration=8.0, dt=0.01)
        flight = jaxos4.simulate(model, parameters, omega, dt=0.01, method="rk4")
        noisy = jaxos4.WhiteNoise(0.01)(flight, key=jax.random.key(number))
        rates = np.full((omega.shape[0], 12), np.nan)
        rates[:, [7, 9, 11]] = np.asarray(noisy.states)[:, [7, 9, 11]]
        path = folder / f"flight{number}.csv"
        jaxos4.write_flight(eqx.tree_at(lambda f: f.states, flight, jnp.asarray(rates)), path)
        # The log holds commands.
        text = path.read_text(encoding="utf-8").splitlines()
        rows = [line.split(",") for line in text[1:]]
        header = text[0].replace("omega", "command").split(",")
        for row in rows:
            row[1:5] = [repr(float(cell) / 500.0) for cell in row[1:5]]
        path.write_text("\n".join(",".join(row) for row in (header, *rows)) + "\n", encoding="utf-8")
    return folder


def command(vehicle, *flights):
    """`jaxos4 estimate` of logs of the folder, or elsewhere if their paths are absolute."""
    return "estimate", *(str(vehicle / flight) for flight in flights), "--airframe", str(vehicle / "airframe.toml")


def test_two_logs_share_the_vehicle(run, vehicle, tmp_path):
    out = tmp_path / "found.json"
    code, page_text, err = run(
        *(*command(vehicle, "flight1.csv", "flight2.csv"), "--terms", ",".join(TERMS)),
        *("--out", str(out), "--report", str(tmp_path / "found.html")),
    )
    assert code == 0, err
    report = json.loads(out.read_text(encoding="utf-8"))
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
    assert report["provenance"]["notes"][0] == f"{vehicle}/{chosen}"
    assert "note: " in page_text


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--model", "flight", "--terms", "wings"), "--terms: knows no `wings`"),
        (("--model", "flight", "--terms", "velocity"), "did not measure"),
        (("--model", "flight", "--holdout", "0.9"), "--holdout"),
        (("--model", "flight", "--window", "-1"), "--window"),
        (("--model", "flight", "--window", "0.01"), "--window"),
        (("--model", "flight", "--window", "100"), "--window"),
        (("--model", "flight", "--sample-time", "nan"), "--sample-time"),
        (("--model", "flight", "--sample-time", "0.001"), "--sample-time"),
        (("--model", "flight", "--from", "5", "--to", "4"), "--from"),
        (("--model", "flight", "--from", "50"), "fewer than two samples"),
        (("--model", "flight", "--estimator", "kalman"), "--estimator"),
        (("--model", "flight", "--channels", "rates"), "--channels"),
        (("--model", "flight", "--initial-state", "known"), "--initial-state"),
        (("--terms", "wings"), "--terms: knows no `wings`"),
        (("--model", "published", "--terms", "offset"), "--terms"),
        (("--model", "published", "--from", "1"), "--from"),
        (("--model", "published", "--report", "r.html"), "--report"),
    ],
)
def test_wrong_requests_are_one_line(run, vehicle, options, said):
    refused(run(*command(vehicle, "flight1.csv"), *options), said)


def test_only_the_flight_model_takes_several_flights(run, vehicle):
    several = run(*command(vehicle, "flight1.csv", "flight2.csv"), "--model", "corrected")
    refused(several, "--model flight for several")


def test_a_vehicle_needs_an_airframe(run, vehicle, tmp_path):
    remedy = ("needs --airframe", "--airframe-out mine.toml")
    refused(run("estimate", str(vehicle / "flight1.csv")), "flight1.csv has commands", *remedy)
    assert run("simulate", "--duration", "1", "--out", "os4.csv")[0] == 0
    refused(run("estimate", "os4.csv", "--model", "flight"), "--model flight", *remedy)
    refused(run("estimate", "os4.csv", "--report", "r.html"), "--report", "os4.csv has no sign")


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
    prepared = prepare([read_recording(vehicle / f"flight{i}.csv", airframe) for i in (1, 2)], airframe)
    assert prepared.tested is not None
    fitted, held_out = (~np.isnan(np.asarray(f.states)[:, 7]) for f in (prepared.fitted, prepared.tested))
    assert (fitted ^ held_out).all()
    assert 0.15 < held_out.mean() < 0.35
    assert prepared.recordings == (0, 1)
    assert prepared.available == {"commands", "full scale"}


def test_the_models_of_the_command_line():
    assert [model.value for model in VehicleModel] == ["published", "corrected", "flight"]


def rewritten(path: Path, to: Path, change) -> Path:
    """A log with its header and its rows changed."""
    header, *rows = (line.split(",") for line in path.read_text(encoding="utf-8").splitlines())
    header, rows = change(header, rows)
    to.write_text("\n".join(",".join(row) for row in (header, *rows)) + "\n", encoding="utf-8")
    return to


def sampled(path: Path, to: Path, dt: float) -> Path:
    """A log whose samples are `dt` apart."""
    return rewritten(path, to, lambda h, rows: (h, [[repr(k * dt), *row[1:]] for k, row in enumerate(rows)]))


@pytest.mark.parametrize("steps", [(1 / 252,), (1 / 249, 1 / 251), (0.01, 0.00998), (0.004,), (0.0040001, 0.003)])
def test_no_window_reaches_from_one_stretch_into_the_next(vehicle, tmp_path, steps):
    airframe = jaxos4.load_airframe(str(vehicle / "airframe.toml"))
    paths = [sampled(vehicle / "flight1.csv", tmp_path / f"{i}.csv", dt) for i, dt in enumerate(steps)]
    prepared = prepare([read_recording(path, airframe) for path in paths], airframe, holdout=0.0)
    flight, windows = prepared.fitted, prepared.windows
    assert flight.time.shape[0] == windows * prepared.length
    assert flight.stretch is not None
    for stretch in np.asarray(flight.stretch).reshape(windows, prepared.length):
        assert np.ptp(stretch) == 0
    model = jaxos4.FlightModel(airframe, recordings=prepared.recordings)
    problem = jaxos4.ShootingProblem(model, flight, sigma=np.ones(12), channels="rates", windows=windows)
    assert (np.diff(problem.window_of_samples().reshape(windows, -1)) == 0).all()


def test_a_log_counts_once(run, vehicle):
    refused(run(*command(vehicle, "flight1.csv", "flight1.csv"), "--model", "flight"), "given twice")
    again = ("--model", "flight", "--validate", str(vehicle / "flight1.csv"))
    refused(run(*command(vehicle, "flight1.csv"), *again), "--validate", "is fitted")


def test_commands_and_speeds_do_not_mix(run, vehicle, tmp_path):
    def as_speeds(header, rows):
        return [name.replace("command", "omega") for name in header], [
            [row[0], *(repr(500 * float(x)) for x in row[1:5]), *row[5:]] for row in rows
        ]

    speeds = rewritten(vehicle / "flight2.csv", tmp_path / "speeds.csv", as_speeds)
    mixed = run(*command(vehicle, "flight1.csv", speeds), "--model", "flight")
    refused(mixed, "some of these logs hold commands")


def test_an_unpredictable_flight_is_refused_before_the_fit(run, vehicle, tmp_path):
    def rarely(header, rows):
        at = header.index("q")
        return header, [row if k % 10 == 0 else [*row[:at], "", *row[at + 1 :]] for k, row in enumerate(rows)]

    rare = rewritten(vehicle / "flight2.csv", tmp_path / "rare.csv", rarely)
    options = ("--model", "flight", "--validate", str(rare), "--out", str(tmp_path / "out.json"))
    result = run(*command(vehicle, "flight1.csv"), *options)
    refused(result, "nothing is long enough to be predicted 0.5 s ahead")
    assert not (tmp_path / "out.json").exists()
