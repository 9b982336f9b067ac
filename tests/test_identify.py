"""Vehicles by `jaxos4 estimate` and `jaxos4.identify`: the same numbers and keys; one line for a wrong request."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CRAZYFLIE, refused, same
from px4_logs import everything
from sign_flights import flown, turned

import jaxos4
from jaxos4.estimators import ESTIMATORS
from jaxos4.export.spread import ESTIMATE
from jaxos4.identification import settings_for
from jaxos4.recording import read_recording

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
    model, omega = jaxos4.FlightModel(airframe, terms=TERMS), jaxos4.multisine(airframe, duration=8.0, dt=0.01)
    for number in (1, 2):
        named = TRUTH | {k.removesuffix(f"_{number}"): v for k, v in TRUTH.items() if k.endswith(f"_{number}")}
        values = [named.get(n, float(a)) for n, a in zip(model.parameter_names, model.alpha, strict=True)]
        flight = jaxos4.simulate(model, jnp.array(values), omega, dt=0.01, method="rk4")
        states = np.array(jaxos4.WhiteNoise(0.01)(flight, key=jax.random.key(number)).states)
        states[:, [0, 1, 2, 3, 4, 5, 6, 8, 10]] = np.nan
        speeds = folder / f"speeds{number}.csv"
        jaxos4.write_flight(eqx.tree_at(lambda f: f.states, flight, jnp.asarray(states)), speeds)
        rewritten(rewritten(speeds, f"flight{number}.csv", as_commands), f"rare{number}.csv", rarely)
    return folder


# A command line in the folder of the logs, and what its message says. `VEHICLE`: a log with its airframe.
VEHICLE = "flight1.csv --airframe airframe.toml"
BIASED = [name for name, kind in ESTIMATORS.items() if not kind.in_closed_loop]
REFUSED = {
    f"{VEHICLE} --terms wings": "--terms: knows no `wings`",
    f"{VEHICLE} --model flight --terms velocity": "did not measure",
    f"{VEHICLE} --model flight --sample-time 0.001": "--sample-time",
    f"{VEHICLE} --model flight --begin 5 --end 4": "--begin",
    f"{VEHICLE} --model flight --from 50": "fewer than two samples",
    **{f"{VEHICLE} --estimator {name}": f"--estimator {name}: is biased by a controller" for name in BIASED},
    f"{VEHICLE} --model published --terms offset": "--terms",
    f"{VEHICLE} --model published --begin 1": "--begin",
    f"flight2.csv {VEHICLE} --model corrected": "several need an airframe and the model flight",
    f"flight1.csv {VEHICLE} --model flight": "given twice",
    f"{VEHICLE} --model flight --validate flight1.csv": "is fitted",
    f"speeds2.csv {VEHICLE} --model flight": "some of these logs hold commands",
    f"{VEHICLE} --model flight --validate flight2.csv --holdout 0.2": "--holdout: --validate is predicted instead",
    f"{VEHICLE} --model flight --validate rare2.csv": "nothing is long enough to be predicted 0.5 s ahead",
    "flight1.csv": "flight1.csv has commands, not rotor speeds: a real vehicle needs --airframe; `jaxos4 inspect",
    "speeds1.csv --model flight": "--model flight: a real vehicle needs --airframe; `jaxos4 inspect",
}


@pytest.mark.slow
@pytest.mark.parametrize(("line", "said"), REFUSED.items(), ids=REFUSED)
def test_wrong_requests_are_one_line(run, vehicle, monkeypatch, line, said):
    monkeypatch.chdir(vehicle)
    refused(run("estimate", *line.split(), "--out", "out.json", "--report", "out.html"), said)
    assert not list(vehicle.glob("*.json"))
    assert not list(vehicle.glob("*.html"))


@pytest.mark.slow
def test_a_log_shows_whether_its_vehicle_is_real(vehicle, tmp_path):
    commands = read_recording(vehicle / "flight1.csv", full_scale=1.0)
    assert commands.vehicle_evidence == "has commands, not rotor speeds"
    felt = commands._replace(commanded=False, specific_force=np.ones((commands.time.size, 3)))
    assert felt.vehicle_evidence == "has an accelerometer"
    speeds = commands._replace(commanded=False)
    assert speeds.vehicle_evidence == ""
    (tmp_path / "log").write_bytes(everything())
    facts = read_recording(tmp_path / "log", full_scale=1.0).facts
    assert speeds._replace(facts=facts).vehicle_evidence == "is a log of a vehicle (PX4 ULog)"
    assert jaxos4.Recording.of(speeds.flight).vehicle_evidence == ""


COMMON = (
    *("estimator", "model", "result", "rollouts", "cost", "seconds", "parameters", "provenance", "covariance"),
    *("constants", "airframe", "verdicts", "doubts"),
)
SETTINGS = ("airframe", "sample_time", "notes", "version", "jax", "device", "precision")
ARRAYS = ("traces", "correlations", "predictions", "trajectories", "response")
# The keys of the JSON, of its provenance, and of a parameter, by the kind of identification.
KEYS = {
    "flight": (
        {*COMMON, "fit", "validation", "traces", "correlations"},
        {*SETTINGS, "flight", "channels", "initial_state", "windows", "samples"},
        {"estimate", "std", "bound", "ci95", "unit", "note", "noise_limit", "bracket"},
    ),
    "vehicle": (
        {*COMMON, "held", "noise", "disturbances", "widened", "skill", "sample_times", *ARRAYS},
        {*SETTINGS, "flights", "validate", "terms", "fitted_seconds", "tested_seconds"},
        {"estimate", "std", "bound", "ci95", "unit", "note", "bracket"},
    ),
}


@pytest.fixture(scope="module")
def flight():
    model = jaxos4.PublishedOS4()
    flown = jaxos4.simulate(model, model.alpha, jaxos4.multisine(model.airframe, duration=2.0), dt=0.01)
    return jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flown, key=jax.random.key(0))


def assert_same_as_written(found, path):
    """The keys are those of `KEYS`, and all numbers those of the file that a command wrote."""
    written = json.loads(path.read_text(encoding="utf-8"))
    own = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    keys, used, row = KEYS["vehicle" if found.is_vehicle else "flight"]
    assert own.keys() == written.keys() == keys
    assert own["provenance"].keys() == used
    assert written["provenance"].keys() == used | {"command"}
    assert all(parameter.keys() == row for parameter in own["parameters"].values())
    for name in keys - {"seconds", "provenance"}:
        assert own[name] == written[name], name
    assert len(own["covariance"]) == len(own["parameters"])


@pytest.fixture
def called(monkeypatch):
    """The calls of `jaxos4.identify` by commands: flights, subject, options, and what was returned."""
    calls, identify = [], jaxos4.identify

    def spy(flights, subject, **options):
        found = identify(flights, subject, **options)
        options.pop("progress")
        calls.append((flights, subject, {name: given for name, given in options.items() if given}, found))
        return found

    monkeypatch.setattr(jaxos4, "identify", spy)
    return calls


def test_the_command_calls_the_library_and_writes_its_numbers(run, tmp_path, flight, called):
    jaxos4.write_flight(flight, tmp_path / "flight.csv")
    code, _, err = run("estimate", "flight.csv", "--channels", "rates", "--out", "found.json")
    assert code == 0, err
    (((recording,), subject, options, found),) = called
    assert same(subject, jaxos4.PublishedOS4())
    assert options == {"settings": jaxos4.OS4Settings(channels="rates")}
    for name in ("omega", "states"):
        np.testing.assert_array_equal(getattr(recording.flight, name), getattr(flight, name))
    assert found.successful
    assert_same_as_written(found, tmp_path / "found.json")
    row = found.parameters["alpha3"]
    assert row.estimate is not None
    assert row.ci95[0] < row.estimate < row.ci95[1]


@pytest.mark.slow
def test_identify_takes_paths(tmp_path):
    model = jaxos4.PublishedOS4()
    flight = jaxos4.simulate(model, model.alpha, jaxos4.multisine(model.airframe, duration=1.0, dt=0.01), dt=0.01)
    flight = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(0))
    jaxos4.write_flight(flight, tmp_path / "flight.csv")
    stages = []
    options = {"estimator": "equation-error", "validate": tmp_path / "flight.csv", "progress": stages.append}
    found = [
        jaxos4.identify(source, model, **options)
        for source in (tmp_path / "flight.csv", str(tmp_path / "flight.csv"), [tmp_path / "flight.csv"])
    ]
    assert stages
    assert len({json.dumps(each.to_dict()["parameters"]) for each in found}) == 1
    assert found[0].provenance.flight == str(tmp_path / "flight.csv")
    assert found[0].validation.flight == str(tmp_path / "flight.csv")
    with pytest.raises(jaxos4.InputError, match="there is no such file"):
        jaxos4.identify(tmp_path / "none.csv", model)


@pytest.mark.slow
def test_two_logs_share_the_vehicle(run, tmp_path, vehicle, monkeypatch, called):
    monkeypatch.chdir(vehicle)
    files = ("--out", str(tmp_path / "found.json"), "--report", str(tmp_path / "found.html"))
    logs = ("flight1.csv", "flight2.csv", "--airframe", "airframe.toml", "--terms", ",".join(TERMS))
    code, page_text, err = run("estimate", *logs, "--sample-time", "0.01", "--verbose", *files)
    assert code == 0, err
    report = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    assert (report["result"], report["model"]) == ("successful", "flight")
    for name, truth in TRUTH.items():
        row = report["parameters"][name]
        assert abs(row["estimate"] - truth) < 4 * row["std"], (name, row)
    assert abs(report["parameters"]["rotor_lag"]["estimate"] - 0.06) < 0.005
    # The model has the true equations: it predicts the held-out part up to the noise.
    assert min(report["skill"][rate]["skill"][1] for rate in "pq") > 0.9
    assert all(words in page_text for words in ("inertias", "note: "))
    page = (tmp_path / "found.html").read_text(encoding="utf-8")
    assert all(name in page for name in TRUTH)
    assert run("report", str(tmp_path / "found.json"), "--out", str(tmp_path / "again.html"))[0] == 0
    assert (tmp_path / "again.html").read_text(encoding="utf-8") == page
    assert report["provenance"]["terms"] == list(TERMS)
    # The log says that it is of a real vehicle, and the page says that this decided.
    chosen = "flight1.csv has commands, not rotor speeds: taken as a real vehicle's (--model flight)"
    assert report["provenance"]["notes"][0] == chosen
    ((recordings, subject, options, found),) = called
    assert [recording.name for recording in recordings] == ["flight1.csv", "flight2.csv"]
    assert same(subject, jaxos4.load_airframe("airframe.toml"))
    assert options == {"settings": jaxos4.VehicleSettings(terms=list(TERMS), sample_time=0.01)}
    assert_same_as_written(found, tmp_path / "found.json")
    assert found.predictions.horizons.tolist() == found.skill.horizons
    kept, own = np.isin(found.predictions.start, found.trajectories.start), found.trajectories
    assert 20 <= own.start.size == kept.sum() <= 40
    (near,) = np.flatnonzero(np.isclose(own.horizons, found.predictions.horizons[0]))
    np.testing.assert_array_equal(own.predicted[:, near], found.predictions.predicted[kept, 0])
    np.testing.assert_allclose(np.diff(own.horizons), own.horizons[0])
    assert own.horizons[-1] == pytest.approx(0.5, abs=own.horizons[0])
    # Vehicles are drawn from it as from the file, as wide as the moments of inertia are uncertain.
    varying, key = jaxos4.export.read_result(found).varying, jax.random.key(1)
    known = {name: row.std for name, row in found.rigid_body.constants.items()}
    wide = {name: varying[name]["std"] for name in known}
    assert wide.keys() >= {"Ix", "Iy"}
    assert all(wide[name] > known[name] or wide[name] == pytest.approx(known[name]) for name in known)
    plain = {name for name in known if varying[name]["origin"] == ESTIMATE}
    assert {name: wide[name] for name in plain} == pytest.approx({name: known[name] for name in plain})
    drawn, again = found.sample(3, key=key), jaxos4.export.sample_vehicles(tmp_path / "found.json", 3, key=key)
    assert all(np.allclose(drawn[name], again[name], rtol=1e-9, atol=0) for name in drawn)


@pytest.mark.slow
def test_a_search_that_fails_keeps_what_the_log_shows():
    diverging, settings = {"roll_damping": [-1e6, -9e5]}, jaxos4.VehicleSettings(sample_time=0.016, holdout=0.0)
    recording, airframe = flown(CRAZYFLIE, 0, seconds=6.0), turned(CRAZYFLIE, "rotor_spins")
    found = jaxos4.identify(recording, airframe, bracket=diverging, settings=settings)
    assert found.result == "nonfinite_trajectory"
    assert any("yaw answers the rotors with the opposite sign" in issue.cause for issue in found.issues)


MODEL, OS4 = jaxos4.PublishedOS4(), jaxos4.OS4
TURNED = eqx.tree_at(lambda a: a.sensor_rotation, OS4, np.array([0.0, 0.0, 45.0]))
OF_FLIGHT, OF_VEHICLE = jaxos4.OS4Settings, jaxos4.VehicleSettings


@pytest.mark.parametrize(
    ("subject", "options", "said"),
    [
        (MODEL, {"estimator": "nobody"}, "`estimator` must be one of ibss"),
        (MODEL, {"estimator": "kalman", "settings": OF_FLIGHT(window=1.0)}, "`window`: kalman does not shoot"),
        (MODEL, {"network": "none.net"}, "`network`: ibss uses none"),
        (MODEL, {"bracket": {"alpha9": (0.0, 1.0)}}, "`bracket`: knows no parameter `alpha9`"),
        (MODEL, {"bracket": {"alpha1": (1.0, 0.0)}}, "`bracket`: `alpha1` must be"),
        (MODEL, {"settings": OF_FLIGHT(initial_state="guessed")}, "`initial_state`: must be free or known"),
        (MODEL, {"settings": OF_FLIGHT(channels="some")}, "`channels` must be one of rates"),
        (MODEL, {"settings": OF_VEHICLE()}, "`settings`: must be OS4Settings for a model"),
        (jaxos4.FlightModel(), {}, "`subject`: must be a model in alpha_1..8 or an airframe, which"),
        (OS4, {"settings": OF_FLIGHT()}, "`settings`: must be VehicleSettings for an airframe"),
        (OS4, {"network": "none.net"}, "`network`: a vehicle's network is trained for its own flights"),
        (OS4, {"settings": OF_VEHICLE(holdout=0.9)}, "`holdout`: must be a share from 0 to 0.5"),
        (OS4, {"settings": OF_VEHICLE(terms=("drag",))}, "`terms`: drag needs lateral specific force"),
        (jaxos4.PublishedOS4(TURNED), {}, "`sensor_rotation`: the rates of an OS4 flight are along the body's axes"),
        (MODEL, {"flights": 2}, "flight 2: the published model explains one flight"),
        (OS4, {"flights": 0}, "holds no flight"),
    ],
)
def test_wrong_combinations_are_refused_in_one_line(flight, subject, options, said):
    flights = [flight] * options["flights"] if "flights" in options else flight
    with pytest.raises(jaxos4.InputError) as error:
        jaxos4.identify(flights, subject, **{name: value for name, value in options.items() if name != "flights"})
    assert said in str(error.value)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("subject", "options", "said"),
    [
        (MODEL, {"terms": ("offset",)}, "`terms`: is for a real vehicle, not for the published model"),
        (MODEL, {"begin": 1.0, "channels": "rates"}, "`begin`: is for a real vehicle"),
        (OS4, {"channels": "rates"}, "`channels`: a vehicle is identified from its rates"),
        (OS4, {"window": 0.25}, "`window`: a vehicle is identified from its rates"),
        (OS4, {"initial_state": "known"}, "`initial_state` known: a vehicle's filters find their own"),
    ],
)
def test_options_become_settings_of_their_own_kind(subject, options, said):
    with pytest.raises(jaxos4.InputError, match=said):
        settings_for(subject, options)
    kind = OF_FLIGHT if subject is MODEL else OF_VEHICLE
    assert settings_for(subject, dict.fromkeys(options) | {"initial_state": "free"}) == kind()
