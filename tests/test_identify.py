"""`jaxos4.identify`: the numbers and keys of `jaxos4 estimate --out`, and one line for each wrong argument."""

import json
from pathlib import Path

import jax
import pytest
from test_cli_vehicle import TERMS, vehicle  # noqa: F401

import jaxos4
from jaxos4.cli._output import in_options
from jaxos4.identification import settings_for
from jaxos4.recording import read_recording

COMMON = (
    *("estimator", "model", "result", "rollouts", "cost", "seconds", "parameters", "provenance", "covariance"),
    *("constants", "airframe"),
)
SETTINGS = ("airframe", "sample_time", "notes", "version", "jax", "device", "precision")
# The keys of the JSON, of its provenance, and of a parameter, by the kind of identification.
KEYS = {
    "flight": (
        {*COMMON, "fit", "validation"},
        {*SETTINGS, "flight", "channels", "initial_state", "windows", "samples"},
        {"estimate", "std", "bound", "ci95", "unit", "note", "noise_limit"},
    ),
    "vehicle": (
        {*COMMON, "held", "noise", "doubts", "disturbances", "widened", "skill", "sample_times"},
        {*SETTINGS, "flights", "validate", "terms", "fitted_seconds", "tested_seconds"},
        {"estimate", "std", "bound", "ci95", "unit", "note"},
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


def test_a_flight_has_the_numbers_of_the_command(run, tmp_path, flight):
    jaxos4.write_flight(flight, tmp_path / "flight.csv")
    code, _, err = run("estimate", "flight.csv", "--channels", "rates", "--out", "found.json")
    assert code == 0, err
    stages, settings = [], jaxos4.FlightSettings(channels="rates")
    found = jaxos4.identify(flight, jaxos4.PublishedOS4(), settings=settings, progress=stages.append)
    assert found.successful
    assert stages
    assert_same_as_written(found, tmp_path / "found.json")
    row = found.parameters["alpha3"]
    assert row.estimate is not None
    assert row.ci95[0] < row.estimate < row.ci95[1]


def test_a_vehicle_has_the_numbers_of_the_command(run, tmp_path, vehicle):  # noqa: F811
    paths, airframe = [vehicle / f"flight{i}.csv" for i in (1, 2)], str(vehicle / "airframe.toml")
    code, _, err = run(
        *("estimate", *map(str, paths), "--model", "flight", "--airframe", airframe),
        *("--terms", ",".join(TERMS), "--sample-time", "0.01", "--out", str(tmp_path / "found.json")),
    )
    assert code == 0, err
    constants = jaxos4.load_airframe(airframe)
    recordings, settings = (
        [read_recording(path, constants) for path in paths],
        jaxos4.VehicleSettings(terms=TERMS, sample_time=0.01),
    )
    found = jaxos4.identify(recordings, constants, settings=settings)
    assert_same_as_written(found, tmp_path / "found.json")
    assert found.predictions is not None
    assert found.predictions.horizons.tolist() == found.skill.horizons


MODEL, AIRFRAME = jaxos4.PublishedOS4(), jaxos4.OS4
OF_FLIGHT, OF_VEHICLE = jaxos4.FlightSettings, jaxos4.VehicleSettings


@pytest.mark.parametrize(
    ("subject", "options", "said"),
    [
        (MODEL, {"estimator": "nobody"}, "`estimator`: must be one of ibss"),
        (MODEL, {"estimator": "kalman", "settings": OF_FLIGHT(window=1.0)}, "`window`: kalman does not shoot"),
        (MODEL, {"network": "none.net"}, "`network`: ibss uses none"),
        (MODEL, {"bracket": {"alpha9": (0.0, 1.0)}}, "`bracket`: knows no parameter `alpha9`"),
        (MODEL, {"bracket": {"alpha1": (1.0, 0.0)}}, "`bracket`: `alpha1` must be"),
        (MODEL, {"settings": OF_FLIGHT(initial_state="guessed")}, "`initial_state`: must be free or known"),
        (MODEL, {"settings": OF_FLIGHT(channels="some")}, "`channels`: must be one of rates"),
        (MODEL, {"settings": OF_VEHICLE()}, "`settings`: must be FlightSettings for a model"),
        (jaxos4.FlightModel(), {}, "`subject`: must be a model in alpha_1..8"),
        (AIRFRAME, {"settings": OF_FLIGHT()}, "`settings`: must be VehicleSettings for an airframe"),
        (AIRFRAME, {"estimator": jaxos4.JointEKF()}, "`estimator` kalman: is biased by a controller"),
        (AIRFRAME, {"network": "none.net"}, "`network`: a vehicle's network is trained for its own flights"),
        (AIRFRAME, {"settings": OF_VEHICLE(holdout=0.9)}, "`holdout`: must be a share from 0 to 0.5"),
        (AIRFRAME, {"settings": OF_VEHICLE(terms=("drag",))}, "`terms`: drag needs lateral specific force"),
    ],
)
def test_wrong_combinations_are_refused_in_one_line(flight, subject, options, said):
    with pytest.raises(jaxos4.InputError) as error:
        jaxos4.identify(flight, subject, **options)
    assert said in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_one_flight_for_a_model_and_none_twice_for_a_vehicle(flight):
    with pytest.raises(jaxos4.InputError, match="flight 2: `subject` published explains one flight"):
        jaxos4.identify([flight, flight], MODEL)
    with pytest.raises(jaxos4.InputError, match="flight 2: given twice"):
        jaxos4.identify([flight, flight], AIRFRAME)
    with pytest.raises(jaxos4.InputError, match="holds no flight"):
        jaxos4.identify([], AIRFRAME)


@pytest.mark.parametrize(
    ("subject", "options", "said"),
    [
        (MODEL, {"terms": ("offset",)}, "`terms`: is for an `Airframe` as `subject`, not for the published model"),
        (MODEL, {"begin": 1.0, "channels": "rates"}, "`begin`: is for an `Airframe`"),
        (AIRFRAME, {"channels": "rates"}, "`channels`: a vehicle is identified from its rates"),
        (AIRFRAME, {"window": 0.25}, "`window`: a vehicle is identified from its rates"),
        (AIRFRAME, {"initial_state": "known"}, "`initial_state` known: a vehicle's filters find their own"),
    ],
)
def test_options_become_settings_of_their_own_kind(subject, options, said):
    with pytest.raises(jaxos4.InputError, match=said):
        settings_for(subject, options)
    kind = OF_FLIGHT if subject is MODEL else OF_VEHICLE
    assert settings_for(subject, dict.fromkeys(options) | {"initial_state": "free"}) == kind()


def test_messages_name_options_on_the_command_line():
    text = "flight.csv: `begin` 3: `initial_state` free, `bracket`: knows no `alpha9`; an `Airframe` as `subject`."
    said = "flight.csv: --from 3: --initial-state free, --bracket b.toml: knows no `alpha9`; --model flight."
    assert in_options(text, bracket=Path("b.toml")) == said
