"""Bags of ROS 1 and 2 and MCAP, written by rosbags: the same flight as a CSV, presets, clocks, and damage."""

import bz2
import os
import shutil
import sqlite3
import struct
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from helpers import CRAZYFLIE, memory_below
from recorded_logs import (
    FRD,
    RPM,
    attitude,
    check,
    commands,
    force,
    position,
    quaternions,
    rates,
    speeds,
    survives_damage,
    table_csv,
    velocity,
)
from scipy.spatial.transform import Rotation

from jaxos4.errors import InputError
from jaxos4.logs import compression, log_format, read_log, read_recording
from jaxos4.logs.compression import check_part, check_sizes

pytest.importorskip("rosbags", reason="reading a ROS bag needs rosbags")
import lz4.frame  # noqa: E402
import recorded_bags as bags  # noqa: E402
from recorded_bags import KINDS, T, bag  # noqa: E402

zstd = import_module("compression.zstd" if find_spec("compression") else "backports.zstd")

ATTITUDE = ("p", "q", "r", "phi", "theta", "psi")
MAP = {
    **{f"omega{i + 1}": f"/motor_speed.angular_velocities[{i}]" for i in range(4)},
    **{name: f"/imu.angular_velocity.{axis}" for name, axis in zip("pqr", "xyz", strict=True)},
    **{f"a{axis}": f"/imu.linear_acceleration.{axis}" for axis in "xyz"},
    **{f"q{axis}": f"/imu.orientation.{axis}" for axis in "wxyz"},
}


def topics(t=T, motors=T, prefix=""):
    return {f"{prefix}/imu": bags.imu(t, quaternions(t)), f"{prefix}/motor_speed": bags.motors(motors)}


@pytest.fixture(scope="module")
def bagged(tmp_path_factory):
    """A bag of each kind, as its path."""
    folder = tmp_path_factory.mktemp("bags")
    return {kind: bag(folder / f"flight.{kind}", kind, topics()) for kind in KINDS}


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_the_same_flight_as_the_csv(kind, bagged, tmp_path, save):
    names = ["t", *(f"omega{i}" for i in range(1, 5)), "p", "q", "r", "ax", "ay", "az", "phi", "theta", "psi"]
    angles = Rotation.from_matrix(attitude(T)).as_euler("ZYX")[:, ::-1]
    csv = read_recording(save(table_csv(names, T, speeds(T), rates(T), force(T), angles)))
    other = shutil.copy(bagged[kind], tmp_path / "flight.log")  # its name says nothing
    folder = bagged[kind].parent
    for place in {bagged[kind], Path(other)} | ({folder, folder / "metadata.yaml"} if kind != "bag" else set()):
        read = read_recording(place, columns={"columns": MAP})
        np.testing.assert_allclose(read.time, csv.time, atol=2e-7)  # the format counts in ns
        np.testing.assert_allclose(read.states, csv.states, atol=1e-9)
        np.testing.assert_allclose(read.specific_force, csv.specific_force, atol=1e-9)
        np.testing.assert_allclose(read.omega[:-1], np.sqrt((csv.omega[1:] ** 2 + csv.omega[:-1] ** 2) / 2), atol=1e-6)
        check(read.flight, names=ATTITUDE)
        assert log_format(place).name == "ROS"


def test_topics_have_rates_and_names_of_their_own(tmp_path):
    slow = T[::4] + 0.001
    path = bag(tmp_path / "slow.bag", "bag", topics(motors=slow, prefix="/hummingbird"))
    flight, notes = read_log(path, columns={"columns": MAP})
    check(flight, names=ATTITUDE, start=0.004)
    np.testing.assert_allclose(flight.omega[:-1], speeds(np.asarray(flight.time)[:-1] + 0.006), atol=0.5)
    assert not any("recorder" in note for note in notes)
    path = bag(tmp_path / "twice.bag", "bag", topics(T[:9], T[:9], "/bee") | topics(T[:9], T[:9], "/other"))
    with pytest.raises(InputError, match=r"there is no '/motor_speed\..*' names for omega1\. There are '/bee/imu', "):
        read_log(path, columns={"columns": MAP})


def test_times_are_stamps_if_all_topics_have_some_of_one_clock(tmp_path, bagged):
    """The recorder adds 3 ms to each: nothing changes but the first time, which is 0."""
    stamped = read_recording(bagged["mcap"], columns={"columns": MAP})
    recorded = read_recording(bagged["mcap"], columns={"columns": MAP, "time": "recorded"})
    np.testing.assert_allclose(stamped.states, recorded.states, atol=1e-9)
    definitions = {"other/msg/Speeds": "float64[4] speeds"}
    without = {
        "/imu": bags.imu(T, quaternions(T)),
        "/s": ("other/msg/Speeds", T, lambda row: {"speeds": speeds(T)[row]}),
    }
    path = bag(tmp_path / "without", "mcap", without, definitions)
    own = {f"omega{i + 1}": f"/s.speeds[{i}]" for i in range(4)}
    flight, notes = read_log(path, columns={"columns": MAP | own})
    check(flight, names=ATTITUDE)
    assert any("times are those of the recorder" in note for note in notes)
    definitions = {"other/msg/All": "float64[4] speeds\nfloat64[3] gyro"}
    gyro, turning = rates(T), speeds(T)
    alone = {"/s": ("other/msg/All", T, lambda row: {"speeds": turning[row], "gyro": gyro[row]})}
    own |= {name: f"/s.gyro[{i}]" for i, name in enumerate("pqr")}
    flight, notes = read_log(bag(tmp_path / "alone", "mcap", alone, definitions), columns={"columns": own})
    check(flight, names=ATTITUDE[:3], forces=False)
    assert any("times are those of the recorder" in note for note in notes)


def test_each_rotor_may_have_a_topic_of_its_own(tmp_path):
    """At times of its own, which are brought to those of the first."""
    late = [T[::2] + 0.001 * i for i in range(4)]
    messages = {"/imu": bags.imu(T, quaternions(T))}
    for i, t in enumerate(late):
        messages[f"/motor_speed/{i}"] = ("other/msg/One", t, lambda k, i=i: {"data": speeds(late[i])[k, i]})
    path = bag(tmp_path / "four.bag", "bag", messages, {"other/msg/One": "std_msgs/Header header\nfloat64 data"})
    given = {"columns": MAP | {f"omega{i + 1}": f"/motor_speed/{i}.data" for i in range(4)}}
    flight, notes = read_log(path, columns=given)
    t = np.asarray(flight.time)[2:-4] + 0.002
    np.testing.assert_allclose(flight.omega[2:-4], speeds(t), atol=0.1)
    # A zero of the telemetry is none of the rotor, and is not spread over its neighbours.
    messages["/motor_speed/2"] = (
        *messages["/motor_speed/2"][:2],
        lambda k: {"data": speeds(late[2])[k, 2] * (k % 20 != 10)},
    )
    path = bag(tmp_path / "zeros.bag", "bag", messages, {"other/msg/One": "std_msgs/Header header\nfloat64 data"})
    flight, more = read_log(path, columns=given)
    np.testing.assert_allclose(flight.omega[2:-4], speeds(t), atol=1)
    (note,) = set(more) - set(notes)
    assert note.startswith("impossible values count as not measured, in /motor_speed/2.data: ")


# Presets

PX4 = {
    "px4_msgs/msg/SensorCombined": "uint64 timestamp\nfloat32[3] gyro_rad\nfloat32[3] accelerometer_m_s2",
    "px4_msgs/msg/VehicleAttitude": "uint64 timestamp\nuint64 timestamp_sample\nfloat32[4] q",
    "px4_msgs/msg/ActuatorMotors": "uint64 timestamp\nuint64 timestamp_sample\nfloat32[12] control",
    "px4_msgs/msg/VehicleLocalPosition": "uint64 timestamp\n"
    + "".join(f"float32 {n}\n" for n in "x y z vx vy vz".split()),
    "px4_msgs/msg/BatteryStatus": "uint64 timestamp\nfloat32 voltage_v",
}
COMMANDS = commands(T)


def px4():
    """Topics of PX4: forward, right, down; commands are not a number before the vehicle is armed."""
    gyro, specific, turn = rates(T) @ FRD, force(T) @ FRD, quaternions(T, turned=True)
    place = np.column_stack([position(T) @ FRD, velocity(T) @ FRD])
    names = ("x", "y", "z", "vx", "vy", "vz")
    messages = {
        "sensor_combined": ("SensorCombined", lambda k: {"gyro_rad": gyro[k], "accelerometer_m_s2": specific[k]}),
        "vehicle_attitude": ("VehicleAttitude", lambda k: {"q": turn[k]}),
        "actuator_motors": ("ActuatorMotors", lambda k: {"control": [*COMMANDS[k], *[np.nan] * 8]}),
        "vehicle_local_position_v1": ("VehicleLocalPosition", lambda k: dict(zip(names, place[k], strict=True))),
        "battery_status": ("BatteryStatus", lambda k: {"voltage_v": 16.0}),
    }

    def stamped(values):
        return lambda k: values(k) | {"timestamp": int(round(1e6 * T[k])) + 5_000_000}

    return {f"/fmu/out/{name}": (f"px4_msgs/msg/{what}", T, stamped(v)) for name, (what, v) in messages.items()}


def test_topics_of_px4_are_recognised(tmp_path):
    flight, notes = read_log(bag(tmp_path / "px4", "mcap", px4(), PX4), CRAZYFLIE)
    check(flight)
    np.testing.assert_allclose(flight.omega[:-1], 2500 * COMMANDS[:-1], rtol=1e-5)
    np.testing.assert_allclose(flight.voltage, 16.0)
    text = " ".join(notes)
    assert "the preset 'px4-ros2'" in text
    assert "commands are /fmu/out/actuator_motors.control[0].." in text


MAVROS = {
    "mavros_msgs/msg/ESCStatusItem": "std_msgs/Header header\nint32 rpm",
    "mavros_msgs/msg/ESCStatus": "std_msgs/Header header\nmavros_msgs/ESCStatusItem[] esc_status",
}


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_topics_of_mavros_are_recognised(kind, tmp_path):
    pose, twist = bags.moving(T)
    definitions = {"mavros_msgs/msg/RCOut": "std_msgs/Header header\nuint16[] channels"} | MAVROS
    messages = {
        "/mavros/imu/data": bags.imu(T, quaternions(T)),
        "/mavros/local_position/pose": pose,
        "/mavros/local_position/velocity_local": twist,
        "/mavros/battery": ("sensor_msgs/msg/BatteryState", T[::50], lambda row: {"voltage": 15.5}),
        "/mavros/rc/out": ("mavros_msgs/msg/RCOut", T, lambda k: {"channels": 1000 + 1000 * COMMANDS[k]}),
    }
    flight, _ = read_log(bag(tmp_path / "commands", kind, messages, definitions), CRAZYFLIE)
    check(flight)
    assert flight.commanded
    np.testing.assert_allclose(flight.omega[:-1], 2500 * COMMANDS[:-1], atol=2.5)
    rpm = np.rint(speeds(T) / RPM).astype(int)
    messages["/mavros/esc_status"] = (
        "mavros_msgs/msg/ESCStatus", T, lambda k: {"esc_status": [{"rpm": each} for each in rpm[k]]}
    )  # fmt: skip
    flight, notes = read_log(bag(tmp_path / "measured", kind, messages, definitions))
    assert not flight.commanded
    np.testing.assert_allclose(flight.omega[:-1], speeds(np.asarray(flight.time)[:-1] + 0.002), atol=0.2)
    assert any("the preset 'mavros'" in note for note in notes)


def test_the_state_of_agilicious_is_recognised(tmp_path):
    gyro, place, moving, turn = rates(T), position(T), velocity(T), quaternions(T)

    def values(k):
        pose = {"position": bags.vector(place[k]), "orientation": dict(zip("wxyz", turn[k], strict=True))}
        return {
            "pose": pose,
            "velocity": {"linear": bags.vector(moving[k]), "angular": bags.vector(gyro[k])},
            "motors": speeds(T)[k],
        }

    text = "std_msgs/Header header\nfloat64 t\ngeometry_msgs/Pose pose\ngeometry_msgs/Twist velocity\nfloat64[] motors"
    messages = {"/kingfisher/agiros_pilot/state": ("agiros_msgs/msg/QuadState", T, values)}
    flight, _ = read_log(bag(tmp_path / "a.bag", "bag", messages, {"agiros_msgs/msg/QuadState": text}))
    check(flight, forces=False)
    assert flight.specific_force is None


# What is refused


def test_what_a_bag_lacks_is_said(bagged, tmp_path, save):
    path = bagged["mcap"]
    with pytest.raises(InputError, match=r"none of its presets \(agil.*\)\. Its topics are '/imu', '/motor_speed'"):
        read_log(path)
    wrong = {
        "/motor_speed.speeds[0]": "has no speeds there, but header, angular_velocities; correct the column map",
        "/motor_speed.angular_velocities": "is not a number; name one of its fields",
        "/imu.orientation.x.y": "has no y there, but a number",
        "/motor.x": r"there is no '/motor\.x'",
        f"/motor_speed.angular_velocities[{'9' * 4400}]": "has no 9999.*there",
    }
    for source, words in wrong.items():
        with pytest.raises(InputError, match=words):
            read_log(path, columns={"columns": MAP | {"omega1": source}})
    short = {"columns": MAP | {"omega4": "/motor_speed.angular_velocities[4]"}}
    with pytest.raises(InputError, match="holds no rotor speeds or commands; name omega1..4"):
        read_log(path, columns=short)
    dead = {f"command{i + 1}": f"/motor_speed.angular_velocities[{i}]" for i in range(3)}
    dead |= {"command4": "/imu.orientation_covariance[0]"}
    with pytest.raises(InputError, match="holds no rotor speeds or commands; name omega1..4 or command1..4"):
        read_log(path, columns={"columns": {n: s for n, s in MAP.items() if "omega" not in n} | dead})
    with pytest.raises(InputError, match="holds no body rates; name p, q and r"):
        read_log(path, columns={"columns": {n: s for n, s in MAP.items() if n != "q"}})
    with pytest.raises(InputError, match="is a folder, not a file"):
        read_log(tmp_path)
    with pytest.raises(InputError, match="metadata"):
        read_log(save("rosbag2_bagfile_information: 3", "metadata.yaml").parent)


def bomb(kind):
    """A bag of a few kilobytes with one part of 300 MB, as its name and content."""
    megabyte = bytes(1 << 20)
    packed = 300 * {"bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": zstd.compress}[kind.split()[1]](megabyte)
    if kind.startswith("ros1"):
        fields = b"op=\x05", b"compression=" + kind.split()[1].encode(), b"size=" + struct.pack("<I", 300 << 20)
        header = b"".join(struct.pack("<I", len(field)) + field for field in fields)
        record = struct.pack("<I", len(header)) + header + struct.pack("<I", len(packed)) + packed
        return "flight.bag", b"#ROSBAG V2.0\n" + record
    if kind.startswith("mcap"):
        name = kind.split()[1].encode()
        chunk = struct.pack("<QQQII", 0, 1, 300 << 20, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
        return "flight.mcap", b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(chunk)) + chunk
    return "flight.db3.zstd", packed


@pytest.mark.parametrize("kind", ["ros1 bz2", "ros1 lz4", "mcap lz4", "mcap zstd", "mcap zstd, compressed again"])
def test_a_small_file_does_not_fill_the_memory(kind, tmp_path):
    kind, _, again = kind.partition(", ")
    name, content = bomb(kind)
    assert len(content) < 400_000 or "lz4" in kind
    name, content = (f"{name}.zstd", zstd.compress(content)) if again else (name, content)
    (tmp_path / name).write_bytes(content)
    with memory_below(30 << 20), pytest.raises(InputError, match="holds a part of more than 268,435,456 bytes"):
        check_sizes(tmp_path) if again else read_log(tmp_path / name)
    # Parts of a usual size are no bomb, and neither is what cannot be decompressed.
    for kind, part in [("zstd", zstd.compress(bytes(1 << 20))), ("zstd", b"damaged"), ("", bytes(9)), ("none", b"")]:
        check_part("bag", kind, part)


def test_a_file_that_is_compressed_as_a_whole_may_be_larger(tmp_path, monkeypatch):
    """`ros2 bag record --compression-mode file`: 300 MB, in memory a megabyte at a time."""
    name, content = bomb("folder zstd")
    (tmp_path / name).write_bytes(content)
    with memory_below(30 << 20):
        check_sizes(tmp_path)
        monkeypatch.setattr(compression, "MAX_FILE", 1 << 20)
        with pytest.raises(InputError, match=r"has more than 1,048,576 bytes when it is decompressed; record it again"):
            check_sizes(tmp_path)
    # Pieces that end anywhere in a frame are joined.
    noise = np.random.default_rng(0).bytes(3 << 20)
    (tmp_path / name).write_bytes(2 * zstd.compress(noise))
    monkeypatch.setattr(compression, "MAX_FILE", 6 << 20)
    check_sizes(tmp_path)
    monkeypatch.setattr(compression, "MAX_FILE", (6 << 20) - 1)
    with pytest.raises(InputError, match="6,291,455"):
        check_sizes(tmp_path)


def record(kind, content):
    return struct.pack("<BQ", kind, len(content)) + content


def test_an_mcap_that_is_compressed_as_a_whole_is_decompressed_once(tmp_path, monkeypatch):
    """Records that a reader holds in memory are bounded, whether they are compressed again or not."""
    made = []
    for name in ("ZstdFile", "ZstdDecompressor"):
        usual = getattr(zstd, name)
        monkeypatch.setattr(zstd, name, lambda *given, usual=usual: made.append(usual) or usual(*given))
    monkeypatch.setattr(compression, "MAX_PART", 1 << 20)
    monkeypatch.setattr(compression, "MAX_FILE", 8 << 20)
    chunk = struct.pack("<QQQIIQ", 0, 1, 1 << 19, 0, 0, 1 << 19) + bytes(1 << 19)
    parts = {"chunks": 3 * record(6, chunk), "a large attachment": record(9, bytes(4 << 20)) + record(6, chunk)}
    for name, content in parts.items():
        (tmp_path / "flight.mcap.zstd").write_bytes(zstd.compress(b"\x89MCAP0\r\n" + content))
        made.clear()
        check_sizes(tmp_path)
        assert len(made) == 1, name
    large = {"chunk": record(6, chunk[:40] + bytes(2 << 20)), "message": record(6, chunk) + record(5, bytes(2 << 20))}
    for content in large.values():
        (tmp_path / "flight.mcap.zstd").write_bytes(zstd.compress(b"\x89MCAP0\r\n" + content))
        with pytest.raises(InputError, match="holds a part of more than 1,048,576 bytes"):
            check_sizes(tmp_path)
    for content in (record(9, bytes(9 << 20)), struct.pack("<BQ", 9, (1 << 64) - 1) + bytes(9 << 20)):
        (tmp_path / "flight.mcap.zstd").write_bytes(zstd.compress(b"\x89MCAP0\r\n" + content))
        with pytest.raises(InputError, match="has more than 8,388,608 bytes when it is decompressed"):
            check_sizes(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_bag(kind, bagged, tmp_path):
    content = bag(tmp_path / f"short.{kind}", kind, topics(T[:25], T[:25])).read_bytes()

    def read(path):
        return read_log(path, columns={"columns": MAP})

    survives_damage(read, tmp_path / "damaged", content, examples=40)


@pytest.mark.parametrize("cell", [b"\x17", "soon", "9" * 400])
def test_a_time_of_another_type_in_a_database_is_refused(bagged, tmp_path, cell):
    path = Path(shutil.copy(bagged["db3"], tmp_path / "flight.db3"))
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET timestamp = ? WHERE id = 9", (cell,))
    with pytest.raises(InputError) as refused:
        read_log(path, columns={"columns": MAP, "time": "recorded"})
    assert str(refused.value).isprintable()


# Bags that somebody made to harm


def compressed(folder, bagged, content):
    """A folder whose database is compressed as a whole."""
    shutil.copytree(bagged["db3"].parent, folder)
    metadata = folder / "metadata.yaml"
    text = metadata.read_text().replace("mode: ''", "mode: file").replace("format: ''", "format: zstd")
    metadata.write_text(text.replace(".db3.db3", ".db3.db3.zstd"))
    (database,) = folder.glob("*.db3")
    database.with_name(f"{database.name}.zstd").write_bytes(content)
    database.unlink()
    return folder


def view(database):
    database.execute("ALTER TABLE message_definitions RENAME TO kept")
    endless = "WITH RECURSIVE g(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM g)"
    database.execute(f"CREATE VIEW message_definitions AS {endless} SELECT kept.* FROM kept, g")


def fields(database, count=20_000):
    text = "".join(f"float64 a{i}\n" for i in range(count))
    database.execute("UPDATE message_definitions SET encoded_message_definition = ?", (text,))


@pytest.mark.parametrize(
    ("harm", "words"),
    [(view, "holds 'message_definitions', which is no table"), (fields, "are longer than 65,536 characters")],
)
def test_a_database_cannot_keep_the_reader_busy(harm, words, bagged, tmp_path):
    path = Path(shutil.copy(bagged["db3"], tmp_path / "flight.db3"))
    with sqlite3.connect(path) as database:
        harm(database)
    with pytest.raises(InputError, match=words):
        read_log(path, columns={"columns": MAP})
    packed = compressed(tmp_path / "packed", bagged, zstd.compress(path.read_bytes()))
    with pytest.raises(InputError, match=words):
        read_log(packed, columns={"columns": MAP})


def test_pages_that_are_used_again_and_again_end(bagged, tmp_path):
    """70 entries of a page lead to the same next page, whose entries do the same: 70^8 rows in 5 kB."""
    path = Path(shutil.copy(bagged["db3"], tmp_path / "flight.db3"))
    with sqlite3.connect(path) as database:
        (root,) = database.execute("SELECT rootpage FROM sqlite_schema WHERE name = 'messages'").fetchone()
        (size,) = database.execute("PRAGMA page_size").fetchone()
        (count,) = database.execute("PRAGMA page_count").fetchone()
    content, cells = bytearray(path.read_bytes()), 70
    leaf = count + 8
    for number, child in ((root, count + 1), *((count + i, count + i + 1) for i in range(1, 8))):
        cell = struct.pack(">IB", child, 1)
        at = [size - 5 * (i + 1) for i in range(cells)]
        page = struct.pack(">BHHHBI", 5, 0, cells, at[-1], 0, child) + struct.pack(f">{cells}H", *at)
        content[size * (number - 1) : size * number] = page.ljust(size - 5 * cells, b"\0") + cells * cell
    row = bytes([7, 1, 5, 0, 1, 1, 12, 1, 1])  # of seven bytes: the key, topic 1 at time 1, without data
    head = struct.pack(">BHHHBH", 13, 0, 1, size - len(row), 0, size - len(row))
    content += head.ljust(size - len(row), b"\0") + row
    content[28:32] = struct.pack(">I", leaf)
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot be decoded .*interrupted"):
        read_log(path, columns={"columns": MAP})


def test_a_folder_holds_files_of_a_usual_size(bagged, tmp_path):
    pipe = compressed(tmp_path / "pipe", bagged, b"")
    os.mkfifo(pipe / "more.db3.zstd")
    with pytest.raises(InputError, match="is a pipe or a device in the folder of a bag; remove it"):
        read_log(pipe)
    long = compressed(tmp_path / "long", bagged, b"")
    with open(long / "metadata.yaml", "a") as file:
        file.writelines(f"    k{i}: v\n" for i in range(60_000))
    with pytest.raises(InputError, match="has more than 524,288 bytes; make it anew"):
        read_log(long)
    names = compressed(tmp_path / "names", bagged, b"")
    text = (names / "metadata.yaml").read_text()
    lists = "".join(f"  x{i}: &x{i} [{', '.join(9 * [f'*x{i - 1}'])}]\n" for i in range(1, 9))
    (names / "metadata.yaml").write_text(text.replace("format: zstd\n", f"format: *x8\n  x0: &x0 a\n{lists}"))
    with pytest.raises(InputError, match="names parts of itself"):
        read_log(names)
    # 200 kB that would be 6 GB on the disk.
    bomb = compressed(tmp_path / "bomb", bagged, 6000 * zstd.compress(bytes(1 << 20)))
    with pytest.raises(InputError, match="has more than 536,870,912 bytes when it is decompressed"):
        read_log(bomb)
