"""What the values of a log must be: units against each other, impossible samples, rates of logging."""

import ardupilot_logs as dataflash
import blackbox_logs as blackbox
import crazyflie_logs as crazyflie
import numpy as np
import px4_logs as ulog
import pytest
import recorded_logs
from flight_csvs import csv, read_flight_and_notes
from helpers import CRAZYFLIE, output_of, refused
from recorded_logs import FRD, RPM, VEHICLE, blackbox_csv, outcome, rates, speeds, table_csv

from jaxos4.flight import STATE_NAMES
from jaxos4.logs import Recording, Sampling, read_log, read_recording
from jaxos4.logs.values import plausible


def test_an_accelerometer_that_never_changes_is_off(save):
    rows = [f"{0.01 * k:.2f},{','.join(['200'] * 4)},0.1,0,0,9.81" for k in range(200)]
    for last, off in (("9.81", True), ("9.80", False)):
        content = csv("t,omega1,omega2,omega3,omega4,p,ax,ay,az", [*rows[:-1], rows[-1].replace("9.81", last)])
        flight, notes = read_flight_and_notes(save(content))
        assert any("is off" in note for note in notes) == off
        assert (flight.specific_force is not None and np.isfinite(flight.specific_force).all()) != off


# Impossible samples


def spoilt(truth, bad, column, value):
    """Samples of a sensor, of which the rows `bad` of one column are impossible."""

    def values(t):
        out = truth(t)
        out[bad, column] = value
        return out

    return values


def csv_of(t, *sensors):
    names = ["t", "p", "q", "r", "ax", "ay", "az", *(f"omega{i}" for i in range(1, 5))]
    return table_csv(names, t, *(sensor(t) for sensor in sensors))


def ulog_of(t, gyro, accelerometer, rotors):
    return ulog.log(ulog.combined(t, gyro, accelerometer), ulog.escs(t, speeds=rotors))


def crazyflie_of(t, gyro, accelerometer, rotors):
    names = [*crazyflie.GYRO, *(f"rpm.m{i}(f)" for i in range(1, 5))]
    values = [np.rad2deg(gyro(t)), accelerometer(t) / recorded_logs.GRAVITY, rotors(t) / RPM]
    return recorded_logs.crazyflie([("e", names, t, np.column_stack(values))])


def blackbox_of(t, gyro, accelerometer, rotors):
    columns = blackbox.recorded(t, gyro=gyro, accelerometer=accelerometer, rotors=rotors)
    return blackbox_csv(columns, settings=blackbox.SETTINGS | {"motor_poles": "14"}).encode()


# For each format, its names of the values that are spoilt.
IMPOSSIBLE = {
    csv_of: ("p", "az", "omega4"),
    ulog_of: ("gyro_rad[0]", "accelerometer_m_s2[2]", "esc[3].esc_rpm"),
    crazyflie_of: ("gyro.x", "acc.z", "rpm.m4"),
    blackbox_of: ("gyroADC[0]", "accSmooth[2]", "eRPM[3]"),
}


@pytest.mark.parametrize("write", IMPOSSIBLE)
def test_ten_impossible_samples_are_missing_and_the_rest_is_as_it_was(write, save):
    t, bad = ulog.grid(0.004, 5.0), 7 + 120 * np.arange(10)

    def log(gyro=bad, accelerometer=bad + 1, rotors=bad):
        sensors = (rates, gyro, 0, 1e6), (recorded_logs.force, accelerometer, 2, -1e5), (speeds, rotors, 3, 104_720.0)
        return save(write(t, *(spoilt(*each) for each in sensors)))

    clean, found = read_recording(log([], [], [])), read_recording(log())
    (note,) = set(found.notes) - set(clean.notes)
    assert note.startswith("impossible values count as not measured, in ")
    words = zip(
        IMPOSSIBLE[write], ("1e+06 rad/s at 0.028 s", "-100000 m/s^2 at 0.032 s", "104720 rad/s at 0.028"), strict=True
    )
    for name, first in words:
        assert f"{name}: 10 (first {first}" in note
    p = STATE_NAMES.index("p")
    expected = clean.states.copy()
    expected[bad, p] = np.nan
    np.testing.assert_array_equal(found.states, expected)
    expected = clean.specific_force.copy()
    expected[bad + 1, 2] = np.nan
    np.testing.assert_array_equal(found.specific_force, expected)
    elsewhere = np.delete(np.arange(t.size - 1), [bad - 1, bad])
    np.testing.assert_allclose(found.omega[elsewhere], clean.omega[elsewhere], rtol=1e-12)
    np.testing.assert_allclose(found.omega, clean.omega, atol=1.6)  # a step of eRPM is 1.5
    many = np.arange(13) * 90  # of 1250
    for kind, name in zip(("gyro", "accelerometer", "rotors"), IMPOSSIBLE[write], strict=True):
        message = outcome(read_log, log(**{kind: many}))
        assert f"{name}: " in message
        assert " (13 of 1250 values, more than 1 %); " in message


def test_impossible_values_of_a_rotor_are_counted_and_replaced_by_the_value_before_or_the_next_one(save):
    speeds = {0: 2e5, 1: 2e5, 9: 2e5, 250: 33_000.0}
    rows = [f"{0.01 * k:.2f},{speeds.get(k, 100 + k)},1,1,1,0.1" for k in range(400)]
    found = read_recording(save("\n".join(["t,omega1,omega2,omega3,omega4,p", *rows])))
    assert found.omega[[0, 1, 2, 8, 9, 10, 250], 0].tolist() == [102, 102, 102, 108, 108, 110, 349]
    assert found.notes == ("impossible values count as not measured, in omega1: 4 (first 200000 rad/s at 0 s)",)


def test_a_motor_that_idles_for_most_of_the_log_and_then_flies_six_times_as_fast_is_possible(save):
    rows = [[0.01 * k, *4 * [300.0 if k < 395 else 1800.0], np.sin(k), 0, 0] for k in range(400)]
    content = table_csv("t,omega1,omega2,omega3,omega4,p,q,r".split(","), np.array(rows))
    assert read_recording(save(content)).omega.max() == 1800.0


def ardupilot_of(t, gyro, accelerometer, rotors):
    imu = ("IMU", "Bffffff", "I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", t, (0 * t, gyro(t) @ FRD, accelerometer(t) @ FRD))
    return recorded_logs.dataflash([imu, dataflash.escs(t, speeds=rotors)])


@pytest.mark.parametrize("write", [*IMPOSSIBLE, ardupilot_of])
def test_zeros_of_a_turning_rotor_are_counted_and_filled_however_many(write, save):
    """A rotor that has stopped needs longer to turn again. Telemetry of ESC answers 0 now and then."""
    t = ulog.grid(0.004, 5.0)
    bad = np.flatnonzero(np.random.default_rng(0).uniform(size=t.size - 60) < 0.03) + 30

    def read(rows):
        return read_recording(save(write(t, rates, recorded_logs.force, spoilt(speeds, rows, 2, 0.0))))

    clean, found, stopped = read([]), read(bad), read(200 + np.arange(40))  # for 0.16 s
    (note,) = set(found.notes) - set(clean.notes)
    assert note.startswith("impossible values count as not measured, in ")
    assert f": {bad.size} (" in note
    np.testing.assert_allclose(found.omega, clean.omega, atol=8)  # speeds change by 2 rad/s in a sample
    assert stopped.notes == clean.notes
    assert (stopped.omega[205:235, 2] == 0).all()


def test_zeros_in_arrays_count_as_not_measured_unless_they_are_commands():
    t = 0.004 * np.arange(500)
    omega, states = speeds(t), np.full((t.size, 12), np.nan)
    omega[100::50, 1], states[:, [7, 9, 11]] = 0, rates(t)
    flight = Recording(t, omega, states)
    found = plausible(flight)
    assert found.impossible == {"rotor 2": (8, 0.0)}
    np.testing.assert_array_equal(found.recording.omega[100::50, 1], omega[99:-1:50, 1])
    assert plausible(flight._replace(commanded=True)).impossible == {}


# How often motors and gyro were logged

ROWS, COMMANDS = 1000, [f"command{i}" for i in range(1, 5)]


def repeating(tmp_path, held, *, stagger=0, lost=0.0):
    """250 rows a second, with commands that are held for this many rows: each motor `stagger` rows after the last."""
    rng = np.random.default_rng(0)
    commands = np.repeat(rng.uniform(0.4, 0.6, (ROWS // held + 9, 4)), held, axis=0)
    commands = np.stack([commands[stagger * i :, i][:ROWS] for i in range(4)], axis=1)
    commands[1:][rng.uniform(size=ROWS - 1) < lost] = np.nan
    path = tmp_path / "log.csv"
    path.write_bytes(
        table_csv(["t", *COMMANDS, "p", "q", "r"], 0.004 * np.arange(ROWS), commands, rng.normal(size=(ROWS, 3)))
    )
    return read_recording(path, full_scale=1.0)


# The rows for which a command is held, and the rate. Motors may be held one after the other, or with empty cells.
RATES = [(25, 10.0, {}), (5, 50.0, {}), (1, 250.0, {}), (25, 10.0, {"stagger": 6}), (25, 10.0, {"lost": 0.2})]


@pytest.mark.parametrize(("held", "rate", "kind"), RATES)
def test_values_that_repeat_were_not_logged(tmp_path, held, rate, kind):
    facts = repeating(tmp_path, held, **kind).facts
    assert facts.motors.rate == pytest.approx(rate, rel=0.05 if kind else 0.01)
    assert facts.gyro.rate == pytest.approx(250.0, rel=0.01)
    words = "the motors were logged at 10 Hz (the values of command1 change so often)"
    assert (words in facts.too_slow_note) == bool(facts.too_slow_note) == (rate < 40)


@pytest.mark.parametrize("seed", range(3))
def test_commands_that_change_now_and_then_are_no_rate(save, seed):
    """A 3-2-1-1, say."""
    rng = np.random.default_rng(seed)
    commands = 0.4 + 0.2 * rng.uniform(size=(200, 4))[np.cumsum(rng.uniform(size=ROWS) < 0.05)]
    content = table_csv(["t", *COMMANDS, "p", "q", "r"], 0.004 * np.arange(ROWS), commands, rng.normal(size=(ROWS, 3)))
    facts = read_recording(save(content), full_scale=1.0).facts
    assert facts.motors.rate == pytest.approx(250.0, rel=0.01)
    assert facts.too_slow_note == ""


def slow_ulog(step):
    t = ulog.grid(step, 3.4, offset=-0.2)
    topics = (
        ulog.combined(ulog.grid(0.004)),
        ulog.vehicle_attitude(ulog.grid(0.02)),
        ulog.motors(t, ulog.thrusts(t).tolist()),
    )
    return ulog.log(*topics, SDLOG_PROFILE=131)


def slow_csv(step):
    t = ulog.grid(0.004)
    commands = ulog.thrusts(t)
    commands[np.arange(t.size) % round(step / 0.004) != 0] = np.nan
    return table_csv(["t", *COMMANDS, "p", "q", "r"], t, commands, rates(t))


def slow_crazyflie(step):
    t, slow = ulog.grid(0.004), ulog.grid(step, 3.4)
    gyro = ["gyro.x(f)", "gyro.y(f)", "gyro.z(f)"]
    events = [("g", gyro, t, np.degrees(rates(t)))]
    events.append(("m", [f"motor.m{i}(H)" for i in range(1, 5)], slow, np.rint(65535 * ulog.thrusts(slow))))
    return recorded_logs.crazyflie(events)


def slow_ardupilot(step):
    t = dataflash.T
    messages = [dataflash.imu(t), dataflash.angles(t), dataflash.outputs(t[:: round(step / 0.0025)])]
    return recorded_logs.dataflash(messages, {"LOG_BITMASK": 176126.0})


MOTORS_OF = {slow_ulog: "actuator_motors", slow_csv: "command1", slow_crazyflie: "motor.m1", slow_ardupilot: "RCOU"}
REMEDIES = {
    slow_ulog: "set SDLOG_PROFILE to 147 (which includes 16, 'high rate')",
    slow_csv: "log motors and gyro at 100 Hz or more",
    slow_crazyflie: "raise the frequency of these variables in the deck's config.txt",
    slow_ardupilot: "by ESC telemetry of bidirectional DShot (SERVO_BLH_BDMASK = 15), because RCOU is always at 10 Hz, "
    f"set LOG_BITMASK to {176126 | 1 | 1 << 18} (with fast attitude and fast IMU), and fly again",
}


@pytest.mark.parametrize("kind", REMEDIES)
def test_motors_at_10_hz_identify_nothing_and_it_is_said_first(kind, save, run, tmp_path):
    (tmp_path / "vehicle.toml").write_text(VEHICLE)
    name, remedy = save(kind(0.1)).name, REMEDIES[kind]
    words = f"the motors were logged at 10 Hz ({MOTORS_OF[kind]}), too rarely to identify a vehicle: "
    out = output_of(run("inspect", name, "--airframe", "vehicle.toml", "--out", "found.json"))
    first = out.splitlines()[1]
    assert first.startswith(f"cannot identify a vehicle: {words}")
    assert remedy in first
    assert "rotor4: 10 Hz" in out
    assert "identifiable: alpha1" not in out
    result = run("estimate", name, "--model", "flight", "--airframe", "vehicle.toml")
    refused(result, f"jaxos4: {name}: {words}", remedy)
    assert read_log(save(kind(0.1)), CRAZYFLIE)[1][-1].startswith(words)
    fast = read_recording(save(kind(0.02)), CRAZYFLIE).facts
    assert fast.motors == Sampling(MOTORS_OF[kind], pytest.approx(50.0, rel=0.01))
    assert fast.too_slow_note == ""


def rare_ulog():
    t = ulog.grid(0.01, 3.2, offset=-0.1)
    return ulog.log(ulog.combined(ulog.grid(0.005)), ulog.escs(t[::25]), ulog.motors(t, [[0.4] * 4] * t.size))


def rare_ardupilot():
    t = dataflash.T
    messages = [dataflash.imu(t), dataflash.angles(t), dataflash.escs(t[::100]), dataflash.outputs(t[::4])]
    return recorded_logs.dataflash(messages)


@pytest.mark.parametrize(("kind", "motors"), [(rare_ulog, "actuator_motors"), (rare_ardupilot, "RCOU")])
def test_measured_speeds_that_are_rare_are_not_used_if_commands_are_fast(kind, motors, save):
    found = read_recording(save(kind()), CRAZYFLIE)
    assert found.commanded
    assert any("logged at 4 Hz only: commands are used" in note for note in found.notes)
    assert found.facts.motors == Sampling(motors, pytest.approx(100.0))
