"""A log is checked against itself: each fault is named with its cause, and good flights have none."""

import json
import re

import equinox as eqx
import msgspec
import numpy as np
import pytest
from helpers import CRAZYFLIE, output_of
from scipy.spatial.transform import Rotation

import jaxos4
from experiments.sample_times.run import VEHICLE as CINERAT
from experiments.verdicts.faults import (
    along_the_earth,
    clipped,
    impossible,
    late,
    scaled,
    shortened,
    thinned,
    turned,
    without_rows,
)
from jaxos4.closed_loop import fly_standard
from jaxos4.flight import ANGLES, RATES, VELOCITY
from jaxos4.logs import write_flight
from jaxos4.recording import Recording, plausible, read_recording
from jaxos4.recording.checks import CHECKS, Evidence, agreement, channels, different_vehicles, self_checks
from jaxos4.recording.checks.estimates import attitude_turns, batched, jackknife
from jaxos4.recording.checks.response import rotor_response
from jaxos4.recording.motion import in_body_axes
from jaxos4.recording.prepared import prepare
from jaxos4.recording.stretches import cut

INERTIAS = {"Ix", "Iy", "Iz"}
WIND = {"wind": 1.0, "drag": 0.3, "inflow": 0.6, "flapping": 2.0}
P, FORCE, AZ = 7, np.array([12, 13, 14]), 14  # of the channels


@pytest.fixture(scope="module")
def flights():
    """Flights with commands or speeds, in weak and strong gusts; the last one has wind and velocity."""

    def flown(logged, gust, seed, **more):
        loop = jaxos4.ClosedLoop(CRAZYFLIE, gust=gust, logged=logged, **more)
        return Recording.of(fly_standard(loop, duration=20.0, seed=seed), f"{logged}.csv")

    settings = (("commands", 2.0), ("speeds", 2.0), ("commands", 10.0), ("speeds", 5.0))
    moving = {"air": jaxos4.Air(**WIND), "sensors": jaxos4.Sensors(velocity_noise=0.05)}
    return [*(flown(*each, seed) for seed, each in enumerate(settings)), flown("commands", 2.0, 9, **moving)]


def rotated(matrix):
    """Gyro and accelerometer along other axes."""

    def spoil(flight, _):
        states, force = flight.states.copy(), flight.specific_force @ np.transpose(matrix)
        states[:, RATES] = states[:, RATES] @ np.transpose(matrix)
        return flight._replace(states=states, specific_force=force)

    return spoil


def tilted(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return rotated([[1, 0, 0], [0, c, s], [0, -s, c]])


def timed(flight, factor):
    return flight._replace(time=factor * flight.time)


def in_units(flight, size):
    return flight._replace(specific_force=flight.specific_force / size)


def stuck(flight, size):
    force = flight.specific_force.copy()
    force[:, 2] = size
    return flight._replace(specific_force=force)


SCALE, TIME = "the gyro's scale", "the time stamps"
# By fault: how a flight gets it, its size, words of the cause, what it concerns, and whether it contradicts that.
FAULTS = {
    "gyro scale": (scaled(RATES), 0.5, [SCALE, TIME], INERTIAS, True),
    "gyro scale, a little": (scaled(RATES), 1.2, ["0.83", SCALE], INERTIAS, True),
    "time scale": (timed, 2.0, ["0.5 times", TIME], INERTIAS, True),
    "attitude scale": (scaled(ANGLES), 0.5, ["scale of the attitude"], {"attitude"}, True),
    "sign of the attitude": (scaled(ANGLES[1:2]), -1.0, ["opposite signs in pitch"], INERTIAS | {"attitude"}, True),
    "attitude late": (late(ANGLES), 0.1, ["attitude is recorded 100 ms late"], {"attitude"}, True),
    "gyro early": (late(RATES), -0.03, ["gyro is recorded", "early"], INERTIAS, True),
    "force late": (late(FORCE), 0.03, ["accelerometer is recorded"], INERTIAS | {"thrust"}, True),
    "gyro clipped": (clipped(P), 0.3, ["clipped"], {"Ix"}, True),
    "force clipped": (clipped(AZ), 0.9, ["clipped"], INERTIAS | {"thrust"}, False),
    "force stuck": (stuck, 9.81, ["never changes"], INERTIAS | {"thrust"}, True),
    "turned": (turned, 20, ["mounted at an angle about the vertical axis"], INERTIAS, True),
    "turned back": (turned, -30, ["mounted at an angle about the vertical axis"], INERTIAS, True),
    "tilted": (tilted(40), 0, ["not along its z axis"], {"thrust"}, True),
    "along the earth": (along_the_earth, 1.0, ["axes of the earth"], {"thrust"}, True),
    "in g": (in_units, 9.80665, ["units of g"], {"thrust"}, True),
    "impossible speeds": (impossible, 19.0, ["impossible"], {"thrust"}, False),
    "thinned": (thinned, 10, ["more rarely"], {"damping"}, True),
    "short": (shortened, 2.0, ["short"], INERTIAS, False),
    "rows missing": (without_rows, 0.3, ["not uniform"], INERTIAS, True),
}


def with_fault(fault, flight):
    spoil, size, *_ = FAULTS[fault]
    return spoil(flight, size)


def copied(flight):
    arrays = {name: x.copy() for name, x in flight._asdict().items() if isinstance(x, np.ndarray)}
    return flight._replace(**arrays)


def test_good_flights_have_no_findings(flights):
    for flight in flights:
        assert self_checks(flight, CRAZYFLIE) == self_checks(flight) == ()
    assert different_vehicles(flights, CRAZYFLIE) is None


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_with_its_cause(fault, flights):
    _, _, words, quantities, contradicted = FAULTS[fault]
    for flight in flights[:2]:
        found = self_checks(with_fault(fault, flight), CRAZYFLIE)
        assert found, flight.name
        for word in words:
            assert word in str(found[0])
        assert set(found[0].quantities) >= quantities
        assert found[0].contradicted == contradicted
        json.dumps([each.to_dict() for each in found])
        named = [each for each in found if each.contradicted]
        assert len(named) <= 1 or fault in ("tilted", "gyro clipped"), found


@pytest.mark.slow
@pytest.mark.parametrize("rows", [2, 3, 4])
def test_speeds_at_instants_that_are_far_apart_are_noted(rows, flights):
    """Motion of the rotors in between is not known; 8 ms are good enough."""
    found = self_checks(flights[1].rows(slice(None, None, rows)), CRAZYFLIE)
    assert [each.name for each in found] == ["rare_speeds"] * (rows > 2)
    assert not any(each.contradicted for each in found)


@pytest.mark.slow
@pytest.mark.parametrize("rows", [4, 8])
def test_a_gyro_below_50_hz_does_not_judge_the_scale_of_the_attitude(rows, flights):
    flight = scaled(RATES)(flights[1], 0.5)
    slow = copied(flight)
    slow.states[np.arange(flight.time.size) % rows > 0] = np.nan
    names = [each.name for each in self_checks(slow, CRAZYFLIE)]
    assert ("gyro_or_time_scale" in names) == (rows * flight.dt <= 0.02)


@pytest.mark.slow
def test_each_fault_of_one_sensor_says_nothing_of_another(flights):
    """A late attitude leaves the inertias alone, and so does one of another scale."""
    for fault in ("attitude late", "attitude scale"):
        (found,) = self_checks(with_fault(fault, flights[2]), CRAZYFLIE)
        assert found.quantities == ("attitude",)


@pytest.mark.slow
@pytest.mark.parametrize(("sensor", "name"), [(RATES, "gyro_or_accelerometer_clock"), (ANGLES, "attitude_clock")])
def test_two_causes_are_both_named_if_the_log_does_not_show_which(sensor, name, flights):
    flight = late(sensor)(flights[0], -0.02 if sensor is RATES else 0.1)
    if sensor is RATES:
        flight.states[:, ANGLES] = np.nan
    else:
        flight = flight._replace(specific_force=None)
    (found,) = self_checks(flight, CRAZYFLIE)
    assert set(found.name.split("_")) == set(name.split("_"))


@pytest.mark.slow
def test_an_attitude_of_other_axes_leaves_the_inertias_alone(flights):
    """Turned by 20 degrees, with the rotors on the side of the gyro."""
    flight, turn = copied(flights[0]), np.radians(20)
    roll, pitch = flight.states[:, ANGLES[:2]].T
    flight.states[:, ANGLES[0]] = np.cos(turn) * roll + np.sin(turn) * pitch
    flight.states[:, ANGLES[1]] = np.cos(turn) * pitch - np.sin(turn) * roll
    (found,) = self_checks(flight, CRAZYFLIE)
    assert (found.name, found.quantities) == ("mounting", ("attitude",))
    (found,) = self_checks(flight)
    assert set(found.quantities) == INERTIAS | {"attitude"}


@pytest.mark.slow
def test_a_velocity_tells_the_gyro_from_the_time_and_its_own_axes(flights):
    flight = flights[-1]
    for fault, cause in (("gyro scale", SCALE), ("time scale", TIME)):
        (found,) = self_checks(with_fault(fault, flight), CRAZYFLIE)
        assert f"{cause} {'is' if cause is SCALE else 'are'} wrong" in found.cause
        assert (TIME in found.cause) == (cause is TIME)
    north_east = copied(flight)
    north_east.states[:, VELOCITY[:2]] = north_east.states[:, VELOCITY[1::-1]] * [1, -1]
    (found,) = self_checks(north_east)
    assert found.name == "velocity_axes"
    assert "turned by -90 degrees" in found.size


def given_rotation(finding):
    """The `sensor_rotation` that a finding advises [deg]."""
    return np.array(re.search(r"`sensor_rotation = \[(.*?)\]`", finding.remedy)[1].split(", "), dtype=float)


@pytest.mark.slow
@pytest.mark.parametrize("angles", [(0.0, 0.0, 30.0), (15.0, -25.0, 40.0), (180.0, 0.0, -90.0)])
def test_the_advised_rotation_of_the_sensors_cures_their_mounting(flights, angles):
    """Without a rotation about z, the thrust shows two angles, and the rotors then the third."""
    axes = Rotation.from_euler("ZYX", angles[::-1], degrees=True).as_matrix()
    turned_flight, airframe = rotated(axes.T)(flights[0], 0), CRAZYFLIE
    for _ in range(2):
        found = {each.name: each for each in self_checks(turned_flight, airframe)}
        if not found:
            break
        advised = given_rotation(found.get("force_direction") or found["mounting"])
        airframe = eqx.tree_at(lambda a: a.sensor_rotation, airframe, advised)
    np.testing.assert_allclose(np.asarray(airframe.sensor_axes), axes, atol=0.06)
    assert not self_checks(turned_flight, airframe)


@pytest.mark.slow
def test_a_channel_that_is_missing_stays_missing_along_its_own_axis_only(flights):
    flight = copied(flights[0])
    flight.states[10, RATES[0]] = np.nan
    seen = in_body_axes(flight, eqx.tree_at(lambda a: a.sensor_rotation, CRAZYFLIE, np.array([0.0, 0.0, 90.0])))
    np.testing.assert_array_equal(np.isnan(seen.states[10, RATES]), [False, True, False])
    np.testing.assert_allclose(seen.states[10, RATES[2]], flight.states[10, RATES[2]])


@pytest.mark.slow
def test_simulated_sensors_are_mounted_as_the_airframe_says(flights):
    """A flight along the axes of turned sensors is that of sensors which are not turned."""
    turned_vehicle = eqx.tree_at(lambda a: a.sensor_rotation, CRAZYFLIE, np.array([10.0, 20.0, 30.0]))
    loop = jaxos4.ClosedLoop(turned_vehicle, gust=2.0, logged="commands")
    flight = Recording.of(fly_standard(loop, duration=20.0, seed=0), "turned.csv")
    seen = in_body_axes(flight, turned_vehicle)
    np.testing.assert_allclose(seen.channels, flights[0].channels, atol=1e-9)


@pytest.mark.slow
def test_a_turned_sensor_seems_to_lie_on_the_ground(flights):
    flight = tilted(100)(flights[0], 0)
    flight.states[:, ANGLES] = np.nan
    found = self_checks(flight, CRAZYFLIE)
    assert [each.name for each in found if each.contradicted] == ["force_direction"]


@pytest.mark.slow
def test_faulty_values_count_as_not_measured(flights):
    flight = impossible(clipped(P)(flights[1], 0.5), 19.0)
    found = plausible(flight)
    count, share, end = found.clipped["p"]
    assert count == np.isnan(found.recording.states[:, P]).sum() > 20
    assert share == pytest.approx(count / flight.time.size)
    assert abs(end) == pytest.approx(np.abs(flight.states[:, P]).max())
    assert found.impossible["rotor 4"][0] == 2
    row = len(flight.omega) // 3
    np.testing.assert_array_equal(found.recording.omega[row], flight.omega[[row, row, row, row - 1], np.arange(4)])
    assert plausible(flights[0]).recording is flights[0]


@pytest.mark.slow
@pytest.mark.parametrize("signal", ["coarse", "held", "noisy"])
def test_a_largest_value_is_no_limit(signal, flights):
    """A coarse or a held signal repeats its largest value."""
    rng, flight = np.random.default_rng(1), copied(flights[0])
    values = np.sin(3 * flight.time) + 0.3 * np.sin(7.3 * flight.time)
    if signal == "coarse":
        values = np.round(20 * values) / 20
    elif signal == "held":
        values = (values + rng.normal(0, 0.02, values.size))[np.arange(values.size) // 25 * 25]
    else:
        values = values + rng.normal(0, 0.02, values.size)
    flight.states[:, P] = values
    assert plausible(flight).clipped == {}


@pytest.mark.slow
@pytest.mark.parametrize("counts", [2, 6])
@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_the_noise_of_a_gyro_at_rest_is_no_limit(counts, jitter, flights):
    """A few counts of noise, at even times, or brought to even times from others."""
    rng, flight = np.random.default_rng(2), copied(flights[0])
    noise = np.floor(rng.uniform(0, counts, flight.time.size)) * 0.0175
    dt = flight.time[1] - flight.time[0]
    flight.states[:, P] = np.interp(flight.time, flight.time + jitter * dt * rng.uniform(-1, 1, noise.size), noise)
    assert plausible(flight).clipped == {}


@pytest.mark.slow
def test_logs_of_two_vehicles(flights):
    heavy = eqx.tree_at(lambda airframe: airframe.mass, CRAZYFLIE, np.asarray(0.035))
    for i, contradicted in ((0, False), (1, True)):
        loop = jaxos4.ClosedLoop(heavy, gust=2.0, logged="commands" if i == 0 else "speeds")
        other = Recording.of(fly_standard(loop, duration=20.0, seed=3))
        found = different_vehicles([flights[i], other], CRAZYFLIE)
        assert found is not None
        assert "30 %" in found.size
        assert found.contradicted == contradicted


@pytest.mark.slow
def test_estimates_hold_within_their_standard_errors(flights):
    """Delay, axes and scale of flights without faults."""
    for flight in flights:
        turns, response = attitude_turns([flight]), rotor_response([flight], CRAZYFLIE)
        matrix, errors = turns.matrix
        assert (np.abs(matrix - np.eye(3)) < 5 * errors + 0.01).all()
        delay, error = turns.delay
        assert abs(delay) < 5 * error + 0.001
        _, _, (between, error) = response.delays.T
        assert abs(between) < 5 * error + 0.006
    values = np.random.default_rng(0).normal(size=(12, 50))
    _, error = jackknife(batched(np.stack([values, np.ones((12, 50))], axis=1)), lambda sums: sums[0] / sums[1])
    np.testing.assert_allclose(error, values.std(axis=0, ddof=1) / np.sqrt(12))


@pytest.mark.slow
def test_a_flight_with_few_motions_is_short(flights, monkeypatch):
    monkeypatch.setattr(channels, "MIN_MOTIONS", 1000.0)
    assert [each.name for each in self_checks(flights[0], CRAZYFLIE)] == ["short_flight"]
    assert len({check.__name__ for check in CHECKS}) == len(CHECKS)


@pytest.mark.slow
def test_little_or_nothing_measured_is_no_fault(flights):
    flight = copied(flights[0])
    nothing = flight._replace(states=np.full_like(flight.states, np.nan), specific_force=None)
    assert self_checks(nothing, CRAZYFLIE) == ()
    assert self_checks(flight.rows(slice(3)), CRAZYFLIE) == ()
    still = copied(flight)
    still.states[:, RATES], still.states[:, ANGLES] = 0.0, 0.0
    assert [each.name for each in self_checks(still, CRAZYFLIE)] == []
    gaps = copied(flight)
    gaps.states[np.random.default_rng(0).random(gaps.time.size) < 0.1] = np.nan
    gaps.specific_force[1000:3000] = np.nan
    assert self_checks(gaps, CRAZYFLIE) == ()
    assert self_checks(cut(flight, jaxos4.recording.Stretch(3.0, 18.0)), CRAZYFLIE) == ()


def test_inspect_prints_cause_size_and_remedy(flights, run, tmp_path):
    write_flight(with_fault("gyro scale", flights[1]).flight, tmp_path / "flight.csv", CRAZYFLIE)
    out = output_of(run("inspect", "flight.csv", "--out", "found.json"))
    assert "contradicts Ix, Iy, Iz: the attitude turns 2 times as much as the gyro says" in out
    (found,) = msgspec.json.decode((tmp_path / "found.json").read_bytes())["checks"]
    assert found["name"] == "gyro_or_time_scale"
    assert found["quantities"] == ["Ix", "Iy", "Iz"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("log", "airframe", "names"),
    [
        ("arpl_crazyflie_rollpitch.csv", CRAZYFLIE, []),
        ("arpl_crazyflie_hover.csv", CRAZYFLIE, []),
        ("nanobench/B8_star_fast_rep1.csv", CRAZYFLIE, []),
        # Its accelerometer is filtered: 12 ms, which is to be noted.
        ("cinerat/cinerat_281.csv", CINERAT, ["accelerometer_or_gyro_clock"]),
    ],
)
def test_real_flights(log, airframe, names, shared_flights):
    found = self_checks(read_recording(shared_flights / log, airframe), airframe)
    assert [each.name for each in found] == names
    assert not any(each.contradicted for each in found)


def rested(flight, force, spoil):
    """The flight after 3 s at rest with this specific force; `spoil` changes the specific force in flight."""
    rows, rng = round(3.0 / flight.dt), np.random.default_rng(2)
    still = np.full((rows, 15), np.nan)
    still[:, RATES] = rng.normal(0.0, 0.02, (rows, 3))
    still[:, FORCE] = np.asarray(force) + rng.normal(0.0, 0.05, (rows, 3))
    channels = flight.channels.copy()
    channels[:, FORCE] = spoil(channels[:, FORCE], flight.time)
    channels[:, ANGLES] = np.nan
    channels = np.concatenate([still, channels])
    return flight._replace(
        time=flight.dt * np.arange(len(channels)),
        omega=np.concatenate([np.zeros((rows, 4)), flight.omega]),
        states=channels[:, :12],
        specific_force=channels[:, FORCE],
    )


DRAG = np.array([4.0, 0.0, 0.0])
AT_REST = {
    "drag is no mounting": ([0.0, 0.0, 9.81], lambda force, _: force - DRAG, []),
    "an inverted vehicle is no scale": (
        [0.0, 0.0, 9.0],
        lambda force, t: force * np.where(t % 4 < 1, -0.3, 0.92)[:, None] - 0.75 * DRAG,
        ["an error of 8 % (9 m/s^2 at rest"],
    ),
    "a slope is no mounting": ([3.4, 0.0, 9.2], lambda force, _: force, []),
    "in g": ([0.0, 0.0, 1.0], lambda force, _: force / 9.81, ["in units of g"]),
    "tilted": (
        [0.0, 9.81 * np.sin(0.5), 9.81 * np.cos(0.5)],
        lambda force, _: force @ Rotation.from_euler("x", -0.5).as_matrix().T,
        ["at an angle", "sensor_rotation = [29, 0, 0]"],
    ),
}


@pytest.mark.parametrize("case", AT_REST)
def test_rest_before_take_off_judges_scale_and_mounting_of_the_accelerometer(case, flights):
    force, spoil, words = AT_REST[case]
    found = self_checks(rested(flights[0], force, spoil), CRAZYFLIE)
    named = [str(each) for each in found if each.name in ("force_scale", "force_direction")]
    assert len(named) == bool(words)
    for word in words:
        assert word in named[0]


def test_a_difference_of_two_clocks_is_one_lag(flights, monkeypatch):
    """Gyro and accelerometer alone do not show which of the two clocks is wrong."""
    delay = ((1, -1, 0, 0), -0.0131, np.hypot(0.002, 0.004))
    monkeypatch.setattr(agreement, "_delays", lambda _: ([delay], True))
    found = agreement.sensor_clocks(Evidence(flights[0], CRAZYFLIE))
    assert (found.cause, found.size) == ("the accelerometer lags the gyro", "13.1 +- 8.9 ms")


def test_noisy_rotor_speeds_are_smoothed_and_noted(flights):
    noise = np.random.default_rng(3).normal(0, 20, flights[1].omega.shape)
    notes = prepare([flights[1]._replace(omega=flights[1].omega + noise)], CRAZYFLIE)[0].notes
    (note,) = (note for note in notes if "noisy" in note)
    assert re.fullmatch(
        r"speeds.csv: rotor speeds are noisy \(2\d rad/s, \d+ % of their changes .*\) and were smoothed", note
    )
