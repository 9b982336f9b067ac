"""A known flight, and writers of the log formats, made from their descriptions.

Attitude is a rotation matrix from the body (x forward, y left, z up) to the earth (x north, y west, z up). The values
in a log follow from matrices and vectors, so that no sign is written by hand.
"""

import struct
import zlib

import numpy as np
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from jaxos4.errors import InputError
from jaxos4.flight import STATE_NAMES, Flight

VEHICLE = """
mass = 0.65
inertia = [7.5e-3, 7.5e-3, 1.3e-2]
arm = 0.23
thrust_coefficient = 4.0e-6
drag_coefficient = 1e-7
rotor_inertia = 6e-5
max_rotor_speed = 1200
"""
GRAVITY = 9.80665
FRD = np.diag([1.0, -1.0, -1.0])  # x forward, y right, z down; north, east, down
RPM = 2 * np.pi / 60


def attitude(t):
    """Body to earth, shape (n, 3, 3)."""
    angles = np.column_stack([2.6 + 0.9 * t, 0.4 * np.sin(0.9 * t + 1.0), 0.5 * np.sin(1.3 * t + 0.3)])
    return Rotation.from_euler("ZYX", angles).as_matrix()


def quaternions(t, turned=False):
    """w, x, y, z, from the body to the earth, in our frame; or `turned`: both with y to the right and z down."""
    rotation = FRD @ attitude(t) @ FRD if turned else attitude(t)
    return Rotation.from_matrix(rotation).as_quat()[:, [3, 0, 1, 2]]


def commands(t):
    """Shares of full scale."""
    return 0.3 + 0.1 * np.arange(4) + 0.05 * np.sin(2 * t)[:, None]


def euler(t):
    """phi, theta, psi of the project: yaw first, then pitch, then roll."""
    return Rotation.from_matrix(attitude(t)).as_euler("ZYX")[:, ::-1]


def rates(t, h=1e-4):
    """p, q, r from R' = R [w]x."""
    spin = np.einsum("nji,njk->nik", attitude(t), (attitude(t + h) - attitude(t - h)) / (2 * h))
    return np.column_stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]])


def position(t):
    return np.column_stack([2 * np.sin(0.7 * t), 1.5 * np.cos(0.5 * t), 3 + 0.5 * np.sin(t)])


def velocity(t, h=1e-4):
    return (position(t + h) - position(t - h)) / (2 * h)


def force(t, h=1e-3):
    """Specific force, as an accelerometer measures it: R^T (a + g)."""
    acceleration = (position(t + h) - 2 * position(t) + position(t - h)) / h**2
    return np.einsum("nji,nj->ni", attitude(t), acceleration + [0, 0, GRAVITY])


def speeds(t):
    """Rotor speeds [rad/s]."""
    return 600 + np.column_stack([100 * np.sin((1.1 + 0.2 * i) * t + i) + 20 * i for i in range(4)])


def check(flight, *, names=STATE_NAMES, atol=2e-3, start=0.0, seconds=3.0, forces=True):
    """Check the measured states against the known flight. Returns the smallest number of samples of a channel."""
    t = np.asarray(flight.time) + start
    truth = np.column_stack([rates(t), np.unwrap(euler(t), axis=0), position(t), velocity(t)])
    truth = dict(zip(("p", "q", "r", "phi", "theta", "psi", "x", "y", "z", "vx", "vy", "vz"), truth.T, strict=True))
    assert t[-1] - t[0] > 0.9 * seconds
    fewest = t.size
    for i, name in enumerate(STATE_NAMES):
        values = np.asarray(flight.states)[:, i]
        measured = np.isfinite(values)
        assert measured.any() == (name in names), name
        if name not in names:
            continue
        fewest = min(fewest, np.count_nonzero(measured))
        off = (values - truth[name])[measured]
        if name in ("phi", "psi"):
            assert np.abs(np.diff(values[measured])).max() < 1  # no jump of 2 pi remains
            off -= 2 * np.pi * np.rint(np.median(off) / (2 * np.pi))
        np.testing.assert_allclose(off, 0, atol=atol, err_msg=name)
    if forces:
        measured = np.isfinite(np.asarray(flight.specific_force)).all(axis=1)
        assert measured.any()
        np.testing.assert_allclose(np.asarray(flight.specific_force)[measured], force(t[measured]), atol=20 * atol)
    return fewest


def outcome(read, path):
    """The flight, or the one-line message of an `InputError`. Any other error, and an unusable flight, is a failure."""
    try:
        flight, notes = read(path)
    except InputError as error:
        message = str(error)
        assert len(message.splitlines()) == 1
        assert message.startswith(f"{path}: ")
        assert message.isprintable()
        assert len(message) < len(str(path)) + 400
        return message
    assert isinstance(flight, Flight)
    time, omega, states = (np.asarray(a) for a in (flight.time, flight.omega, flight.states))
    assert np.isfinite(time).all()
    assert np.isfinite(omega).all()
    assert (omega >= 0).all()
    assert not np.isinf(states).any()
    assert np.isfinite(states).any()
    assert flight.specific_force is None or not np.isinf(np.asarray(flight.specific_force)).any()
    dt = (time[-1] - time[0]) / (time.size - 1)
    assert dt > 0
    assert np.abs(np.diff(time) - dt).max() <= 1e-5 * dt + 4 * np.spacing(np.abs(time).max())
    assert all(note.isprintable() for note in notes)
    return flight


ACCIDENTS = st.lists(
    st.tuples(
        st.sampled_from(["cut", "flip", "flip", "insert", "drop", "zeros"]), st.floats(0, 1), st.integers(0, 999)
    ),
    max_size=4,
)


def survives_damage(read, path, content, *, examples):
    """Up to four accidents in the bytes of a log, written to `path`: a flight, or one line. Without any: a flight."""
    path.write_bytes(content)
    assert isinstance(outcome(read, path), Flight)

    @given(accidents=ACCIDENTS)
    @settings(max_examples=examples)
    def law(accidents):
        path.write_bytes(damaged(content, accidents))
        outcome(read, path)

    law()


def damaged(content, accidents):
    """Bytes after accidents: (kind, place 0..1, value)."""
    content = bytearray(content)
    for kind, place, value in accidents:
        at = int(place * len(content))
        if kind == "cut":
            del content[at:]
        elif kind == "flip" and content:
            content[min(at, len(content) - 1)] ^= value % 255 + 1
        elif kind == "insert":
            content[at:at] = bytes([value % 256]) * (1 + value % 40)
        elif kind == "drop":
            del content[at : at + 1 + value % 40]
        elif kind == "zeros":
            content[at : at + 64] = bytes(min(64, len(content) - at))
    return bytes(content)


# ULog


def message(kind, body):
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(topics, *, extra=b"", before=b""):
    """A ULog file.

    `topics`: for each its name, the text of its format, the struct code of a sample, the rows, and times [s].
    `before`: messages before the data, such as nested formats. `extra`: messages after the 20th sample.
    """
    out = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000))
    out += message("B", bytes(40)) + message("I", b"\x0cchar[4] sys_PX4!") + before
    for name, fields, *_ in topics:
        out += message("F", f"{name}:{fields}".encode())
    for number, (name, *_) in enumerate(topics):
        out += message("A", struct.pack("<BH", 0, number) + name.encode())
    samples = []
    for number, (_, _, code, columns, times) in enumerate(topics):
        stamps = np.rint(1e6 * (np.asarray(times) + 5.0)).astype(int)
        for stamp, row in zip(stamps.tolist(), columns, strict=True):
            samples.append((stamp, message("D", struct.pack("<H" + code, number, stamp, *row))))
    for i, (_, body) in enumerate(sorted(samples, key=lambda sample: sample[0])):
        out += body
        if i == 20:
            out += extra
    return bytes(out)


# blackbox


def blackbox_csv(columns, *, settings=None):
    """`columns`: name -> values. With `settings`, in the style of Blackbox Explorer."""
    separator = "," if settings else ", "
    lines = [f'"{key}","{value}"' for key, value in (settings or {}).items()]
    names = [f'"{name}"' if settings else name for name in columns]
    lines.append(separator.join(names))
    table = [values.tolist() for values in columns.values()]
    lines += [separator.join(map(str, row)) for row in zip(*table, strict=True)]
    return "\n".join(lines) + "\n"


# CSV


def table_csv(names, *columns):
    """A flight CSV; a NaN is an empty cell."""
    lines = [",".join(map(str, row)).replace("nan", "") for row in np.column_stack(columns).tolist()]
    return "\n".join([",".join(names), *lines]).encode()


# Crazyflie


def crazyflie(events, *, version=2, checksum=True):
    """`events`: for each its name, variables as `name(type)`, times [s], columns."""
    out = bytearray(b"\xbc" + struct.pack("<HH", version, len(events)))
    for number, (name, variables, *_) in enumerate(events):
        out += struct.pack("<H", number) + name.encode() + b"\0" + struct.pack("<H", len(variables))
        out += b"".join(variable.encode() + b"\0" for variable in variables)
    rows = []
    for number, (_, variables, times, columns) in enumerate(events):
        code = "".join(variable[-2] for variable in variables)
        stamps = np.rint(np.asarray(times) * (1e6 if version == 2 else 1e3)).astype(int).tolist()
        head = "<HQ" if version == 2 else "<HI"
        for stamp, row in zip(stamps, columns.tolist(), strict=True):
            values = [value if kind in "fde" else int(value) for kind, value in zip(code, row, strict=True)]
            rows.append((stamp, struct.pack(head, number, stamp) + struct.pack("<" + code, *values)))
    for _, row in sorted(rows, key=lambda row: row[0]):
        out += row
    if checksum:
        out += struct.pack("<I", zlib.crc32(out))
    return bytes(out)


def crazyflie_2019(variables, times, columns, *, block=8):
    """The format of 2019: data sets in blocks, each with the inverse of its checksum."""

    def checked(content):
        return content + struct.pack("<I", zlib.crc32(content) ^ 0xFFFFFFFF)

    names = ["tick(I)", *variables]
    code = "<" + "".join(name[-2] for name in names)
    out = checked(bytes([len(names)]) + "".join(f"{name}," for name in names).encode())
    table = np.column_stack([np.rint(1e3 * np.asarray(times)), columns]).tolist()
    for begin in range(0, len(table), block):
        rows = (
            [x if k in "fde" else round(x) for k, x in zip(code[1:], row, strict=True)] for row in table[begin:][:block]
        )
        sets = [struct.pack(code, *row) for row in rows]
        out += checked(bytes([len(sets)]) + b"".join(sets))
    return out


# ArduPilot


def dataflash(messages, parameters=None):
    """A DataFlash log. `messages`: for each its name, letters of its format, fields after `TimeUS`, times [s], rows."""
    codes = dict(zip("BHIfcQ", "BHIfhQ", strict=True))
    described = [
        ("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", "BB4s16s64s"),
        ("PARM", "QNf", "TimeUS,Name,Value", "Q16sf"),
    ]
    described += [(n, "Q" + c, f"TimeUS,{f}", "Q" + "".join(codes[letter] for letter in c)) for n, c, f, *_ in messages]
    out, numbers = bytearray(), {}
    for number, (name, letters, fields, code) in enumerate(described, start=0x80):
        numbers[name] = number, code
        body = (number, struct.calcsize(f"<{code}") + 3, name.encode(), letters.encode(), fields.encode())
        out += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", *body)
    number, code = numbers["PARM"]
    for name, value in (parameters or {}).items():
        out += b"\xa3\x95" + bytes([number]) + struct.pack(f"<{code}", 1, name.encode(), value)
    rows = []
    for name, letters, _, times, columns in messages:
        number, code = numbers[name]
        for t, row in zip(times, np.column_stack(columns).tolist(), strict=True):
            stamp = round(1e6 * t) + 5_000_000
            values = [
                round(100 * x) if k == "c" else x if k == "f" else round(x) for k, x in zip(letters, row, strict=True)
            ]
            rows.append((stamp, b"\xa3\x95" + bytes([number]) + struct.pack(f"<{code}", stamp, *values)))
    return bytes(out) + b"".join(row for _, row in sorted(rows, key=lambda each: each[0]))
