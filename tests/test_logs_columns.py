"""Column maps: names, units, signs and frames of any CSV, presets, arrays in Python; and what a map may not hold."""

import json

import numpy as np
import pytest
import xarray as xr
from column_logs import T, neurobem_csv
from helpers import CRAZYFLIE, CRAZYFLIE_TOML, output_of, refused
from recorded_logs import FRD, GRAVITY, RPM, check, force, position, quaternions, rates, speeds, table_csv, velocity
from synthetic_results import predicting_result

import jaxos4
from jaxos4.errors import InputError
from jaxos4.logs import log_format, read_log, read_recording

SPEEDS = tuple(f"omega{i}" for i in range(1, 5))
STATES = ("p", "q", "r", "phi", "theta", "psi", "x", "y", "z", "vx", "vy", "vz")


ODD = """
frame = "FRD"
[columns]
t = {source = "time", unit = "ms"}
omega1 = {source = "rpm 1", unit = "rpm"}
omega2 = {source = "rpm 2", unit = "rpm"}
omega3 = {source = "rpm 3", unit = "rpm"}
omega4 = {source = "rpm 4", unit = "rpm"}
p = {source = ["missing", "gyro x"], unit = "deg/s"}
q = {source = "gyro y", unit = "deg/s"}
r = {source = "gyro z", unit = "deg/s", sign = -1}
ax = {source = "acc x", unit = "g"}
ay = {source = "acc y", unit = "g"}
az = {source = "acc z", unit = 9.80665}
qw = "q0"
qx = "q1"
qy = "q2"
qz = "q3"
x = {source = "n", unit = "mm"}
y = "e"
z = "d"
voltage = {unit = "mV"}
"""


def odd_csv():
    """A flight in other names, units and frame; `vx, vy, vz` keep their names."""
    gyro, motors = np.rad2deg(rates(T)) @ FRD * [1, 1, -1], speeds(T) / RPM * [1, 1, -1, 1]
    place = position(T) @ FRD * [1000, 1, 1]
    names = ["time", "rpm 1", "rpm 2", "rpm 3", "rpm 4", "gyro x", "gyro y", "gyro z", "acc x", "acc y", "acc z"]
    names += ["q0", "q1", "q2", "q3", "n", "e", "d", "vx", "vy", "vz", "voltage", "note"]
    columns = (1e3 * T, motors, gyro, force(T) @ FRD / GRAVITY, quaternions(T, turned=True), place, velocity(T) @ FRD)
    return table_csv(names, *columns, 11_100 - T, T)


def test_any_csv_is_the_same_flight(save):
    flight, notes = read_log(save(odd_csv()), columns=save(ODD, "map.toml"))
    check(flight)
    np.testing.assert_allclose(flight.omega, speeds(T), rtol=1e-12)
    np.testing.assert_allclose(flight.voltage, 11.1 - 1e-3 * T)
    assert notes == tuple(n for n in notes if "unknown columns are ignored: 'note'" in n or "jump" in n)


@pytest.mark.parametrize("column", ["q", "theta", "psi", "y", "vz"])
def test_each_sign_of_the_frame_counts(column, save):
    """Without the frame, the attitude, position and velocity are those of another flight."""
    flight, _ = read_log(save(odd_csv()), columns=save(ODD.replace('frame = "FRD"', ""), "map.toml"))
    with pytest.raises(AssertionError):
        check(flight, names=(column,), forces=False)


def test_a_command_in_microseconds_is_a_fraction(save):
    names = ("t", "p", "pwm1", "pwm2", "pwm3", "pwm4")
    commands = np.column_stack([1300 + 100 * i + 50 * np.sin(T) for i in range(4)])
    commands[:9] = 900  # not armed
    table = {"columns": {f"command{i}": {"source": f"pwm{i}", "unit": "PWM"} for i in range(1, 5)}}
    flight, _ = read_log(save(table_csv(names, T, rates(T)[:, 0], commands)), CRAZYFLIE, columns=table)
    np.testing.assert_allclose(flight.omega, 2500 * np.clip((commands - 1000) / 1000, 0, 1), atol=1e-9)


def test_a_csv_of_neurobem_is_recognised(save):
    path = save(neurobem_csv())
    flight, notes = read_log(path)
    check(flight, names=STATES[:9])
    np.testing.assert_array_equal(flight.omega, speeds(T))
    np.testing.assert_allclose(flight.voltage, 16 - 0.1 * T)
    assert log_format(path).name == "NeuroBEM"
    assert any("'vel x'" in note for note in notes)
    mine, _ = read_log(path, columns={"preset": "neurobem", "columns": {"p": {"source": "ang vel x", "sign": -1}}})
    np.testing.assert_array_equal(np.asarray(mine.states)[:, 7], -np.asarray(flight.states)[:, 7])
    turned = {"preset": "neurobem", "frame": "FRD", "columns": {"q": "ang vel y"}}  # the frame of what is named here
    mine, _ = read_log(path, columns=turned)
    np.testing.assert_array_equal(np.asarray(mine.states)[:, [9, 11]], np.asarray(flight.states)[:, [9, 11]] * [-1, 1])


def arrays():
    states = np.column_stack([rates(T), force(T)]).T
    return {"t": T, "omega": speeds(T), **dict(zip(("p", "q", "r", "ax", "ay", "az"), states, strict=True))}


MOTORS = {"columns": {f"omega{i + 1}": f"omega[{i}]" for i in range(4)}}


def test_arrays_and_objects_like_them_are_read():
    data = arrays()
    single = {name: x for name, x in data.items() if x.ndim == 1} | {
        f"omega{i + 1}": data["omega"][:, i] for i in range(4)
    }
    wide = read_recording(data, columns=MOTORS)
    dataset = xr.Dataset({n: ("time", x) for n, x in single.items() if n != "t"}, coords={"time": T, "name": "Bee"})
    dated = dataset.assign_coords(time=np.datetime64("2026-01-01", "ns") + (1e9 * T).round().astype("timedelta64[ns]"))
    matrices = single | {"p": single["p"][:, None]}  # of one column
    read = [
        read_recording(single),
        read_recording(matrices),
        *(read_recording(d, columns={"columns": {"t": "time"}}) for d in (dataset, dated)),
    ]
    for each in read:
        for found in (each.omega, each.states, each.specific_force):
            assert found is not None
        np.testing.assert_allclose(each.time, wide.time, atol=1e-9)
        np.testing.assert_array_equal(each.omega, wide.omega)
        np.testing.assert_array_equal(each.states, wide.states)
    flight, _ = jaxos4.read_log(single)
    check(flight, names=("p", "q", "r"))


def test_a_data_frame_is_read():
    pandas = pytest.importorskip("pandas", reason="pandas is not needed by jaxos4")
    data = arrays()
    frame = pandas.DataFrame({name: x for name, x in data.items() if x.ndim == 1})
    frame[list(SPEEDS)] = data["omega"]
    np.testing.assert_array_equal(read_recording(frame).states, read_recording(data, columns=MOTORS).states)


BAD_ARRAYS = {
    "lengths": (arrays() | {"p": T[:-1]}, MOTORS, "as many in each column (t has 750"),
    "nothing": ({}, None, "there are none"),
    "no motors": ({"t": T, "p": T}, None, "omega1: is missing"),
    "infinite": (arrays() | {"p": np.where(T == T[3], np.inf, 0)}, MOTORS, "array p: holds an infinity"),
    "no source": (
        arrays(),
        {"columns": {"p": "gyro"}},
        "there is no 'gyro', which 'columns' names for p. There are 't'",
    ),
    "no mapping": ([T, T], None, "is of type list; give the path of a log, or a mapping of arrays"),
}


BAD_MAPS = {
    "no TOML": ("[columns", "not a TOML file"),
    "other key": ('speed = "FRD"\n[columns]', "'speed' cannot be used"),
    "other frame": ('frame = "NED"', "frame is 'NED'; give one of FLU, FRD"),
    "other preset": ('preset = "mine"', "preset is 'mine'; give one of agilicious, mavros"),
    "other time": ('time = "now"', "time is 'now'; give one of stamp, recorded"),
    "other column": ('[columns]\nw = "w"', "there is no column 'w'"),
    "other unit": (
        '[columns]\np = {source = "a", unit = "deg"}',
        "column p: may have a source, a unit (rad/s, deg/s, rpm",
    ),
    "zero": ('[columns]\np = {source = "a", unit = 0}', "column p: may have"),
    "other sign": ('[columns]\np = {source = "a", sign = 2}', "a sign (1 or -1)"),
    "other entry": ('[columns]\np = {sourc = "a"}', "column p: may have"),
    "number": ("[columns]\np = 3", "column p: has no source"),
    "no columns": ("columns = 3", "'columns' cannot be used"),
    "absent": ("[columns]\np = 'gyro'", "there is no 'gyro'"),
}


@pytest.mark.parametrize("case", [*BAD_ARRAYS, *BAD_MAPS])
def test_arrays_that_are_no_flight_and_a_map_that_cannot_be_used_are_refused(case, save):
    if case in BAD_ARRAYS:
        data, columns, words = BAD_ARRAYS[case]
    else:
        content, words = BAD_MAPS[case]
        data, columns = save(odd_csv(), "flight.csv"), save(content, "map.toml")
    with pytest.raises(InputError) as caught:
        read_log(data, columns=columns)
    assert words in str(caught.value)
    assert str(caught.value).isprintable()


def test_the_commands_take_a_map_or_the_name_of_a_preset(save, run):
    save(odd_csv(), "flight.csv")
    save(ODD, "map.toml")
    save(neurobem_csv(), "bem.csv")
    out = output_of(run("inspect", "flight.csv", "--columns", "map.toml"))
    assert "  p q r: " in out
    out = output_of(run("inspect", "bem.csv", "--columns", "neurobem"))
    words = "neither a file nor a preset; give a TOML file or one of agilicious"
    refused(run("estimate", "flight.csv", "--columns", "nothing.toml"), words)


def test_every_log_of_a_command_is_read_by_the_map(save, run):
    """Each of these lacks a column of the map, which is said before anything is fitted."""
    save(json.dumps(predicting_result()), "found.json")
    save(odd_csv(), "flight.csv")
    save(neurobem_csv(), "bem.csv")
    save(CRAZYFLIE_TOML, "mine.toml")
    save(ODD, "map.toml")
    estimate = ("estimate", "--airframe", "mine.toml")
    for command in (
        (*estimate, "bem.csv"),
        (*estimate, "flight.csv", "--validate", "bem.csv"),
        ("predict", "found.json", "bem.csv"),
    ):
        refused(run(*command, "--columns", "map.toml"), "bem.csv: there is no 'time', which 'map.toml' names for t")


def test_a_format_with_columns_of_its_own_takes_no_map(save):
    with pytest.raises(InputError, match="takes no column map"):
        read_log(save(b"\xbc\x02\0"), columns="mavros")
