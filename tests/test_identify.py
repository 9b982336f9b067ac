"""`jaxos4.identify`: the numbers of `jaxos4 estimate --out`, and one line for each wrong combination of arguments."""

import json
from pathlib import Path

import jax
import pytest
from test_cli_vehicle import TERMS, vehicle  # noqa: F401

import jaxos4
from jaxos4.cli._output import in_options
from jaxos4.recording import read_recording

APART = ("seconds", "provenance")


@pytest.fixture(scope="module")
def flight():
    model = jaxos4.PublishedOS4()
    flown = jaxos4.simulate(model, model.alpha, jaxos4.multisine(model.airframe, duration=2.0), dt=0.01)
    return jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flown, key=jax.random.key(0))


def as_json(found):
    return json.loads(json.dumps(found.to_dict(), allow_nan=False))


def test_a_flight_has_the_numbers_of_the_command(run, tmp_path, flight):
    jaxos4.write_flight(flight, tmp_path / "flight.csv")
    code, _, err = run("estimate", "flight.csv", "--channels", "rates", "--out", "found.json")
    assert code == 0, err
    written = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    stages = []
    found = jaxos4.identify(flight, jaxos4.PublishedOS4(), channels="rates", progress=stages.append)
    assert isinstance(found, jaxos4.FlightIdentification)
    assert found.successful
    assert stages
    from_python = as_json(found)
    assert from_python.keys() == written.keys()
    for name in from_python.keys() - set(APART):
        assert from_python[name] == written[name], name
    assert written["provenance"].keys() - from_python["provenance"].keys() == {"command"}
    row = found.parameters["alpha3"]
    assert row.identifiable
    assert row.ci95[0] < row.estimate < row.ci95[1]
    assert found.rigid_body.constants["Ix"].estimate == written["constants"]["Ix"]["estimate"]


def test_a_vehicle_has_the_numbers_of_the_command(run, tmp_path, vehicle):  # noqa: F811
    paths, airframe = [vehicle / f"flight{i}.csv" for i in (1, 2)], str(vehicle / "airframe.toml")
    code, _, err = run(
        *("estimate", *map(str, paths), "--model", "flight", "--airframe", airframe),
        *("--terms", ",".join(TERMS), "--out", str(tmp_path / "found.json")),
    )
    assert code == 0, err
    written = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    constants = jaxos4.load_airframe(airframe)
    found = jaxos4.identify([read_recording(path, constants) for path in paths], constants, terms=TERMS)
    assert isinstance(found, jaxos4.VehicleIdentification)
    from_python = as_json(found)
    assert from_python.keys() == written.keys()
    for name in from_python.keys() - set(APART):
        assert from_python[name] == written[name], name
    assert found.predictions is not None
    assert found.predictions.horizons.tolist() == found.skill.horizons


MODEL, AIRFRAME = jaxos4.PublishedOS4(), jaxos4.OS4


@pytest.mark.parametrize(
    ("subject", "options", "said"),
    [
        (MODEL, {"terms": ("offset",)}, "`terms`: is for an `Airframe` as `subject`, not for the published model"),
        (MODEL, {"begin": 1.0}, "`begin`: is for an `Airframe`"),
        (MODEL, {"estimator": "nobody"}, "`estimator`: must be one of ibss"),
        (MODEL, {"estimator": "kalman", "window": 1.0}, "`window`: kalman does not shoot"),
        (MODEL, {"network": "none.net"}, "`network`: ibss uses none"),
        (MODEL, {"bracket": {"alpha9": (0.0, 1.0)}}, "`bracket`: knows no parameter `alpha9`"),
        (MODEL, {"bracket": {"alpha1": (1.0, 0.0)}}, "`bracket`: `alpha1` must be"),
        (MODEL, {"initial_state": "guessed"}, "`initial_state`: must be free or known"),
        (MODEL, {"channels": "some"}, "`channels`: must be one of rates"),
        (jaxos4.InertialOS4(MODEL), {}, "`subject`: must be a model in alpha_1..8"),
        (AIRFRAME, {"channels": "rates"}, "`channels`: a vehicle is identified from"),
        (AIRFRAME, {"initial_state": "known"}, "`initial_state` known: each window"),
        (AIRFRAME, {"estimator": jaxos4.JointEKF()}, "`estimator` kalman: does not shoot"),
        (AIRFRAME, {"loss": "absolute"}, "`loss`: must be huber or squares"),
        (AIRFRAME, {"holdout": 0.9}, "`holdout`: must be a share from 0 to 0.5"),
        (AIRFRAME, {"terms": ("drag",)}, "`terms`: drag needs lateral specific force"),
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


def test_messages_name_options_on_the_command_line():
    text = "flight.csv: `begin` 3: `initial_state` free, `bracket`: knows no `alpha9`; an `Airframe` as `subject`."
    said = "flight.csv: --from 3: --initial-state free, --bracket b.toml: knows no `alpha9`; --model flight."
    assert in_options(text, bracket=Path("b.toml")) == said
