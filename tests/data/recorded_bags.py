"""Bags of the known flight, by rosbags' own writers."""

import pathlib
import shutil

import numpy as np
from recorded_logs import force, position, rates, speeds, velocity
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

T = 0.004 * np.arange(750)
EPOCH = 1_700_000_000_000_000_000  # [ns]
KINDS = ("bag", "db3", "mcap")
ACTUATORS = {"mav_msgs/msg/Actuators": "std_msgs/Header header\nfloat64[] angular_velocities"}


def message(store, what, values, at):
    """A message with these values, zeros elsewhere, and the time `at` [ns] in its header."""
    made = {name: value_of(store, node, values.get(name), at) for name, node in store.fielddefs[what][1]}
    if "header" in made:
        made["header"].stamp.sec, made["header"].stamp.nanosec = divmod(at, 10**9)
    return store.types[what](**made)


def value_of(store, node, value, at):
    kind, what = node
    if kind == Nodetype.NAME:
        return message(store, what, value or {}, at)
    if kind == Nodetype.BASE:
        return value if value is not None else "" if what[0] == "string" else 0
    inner, size = what
    if inner[0] == Nodetype.NAME:
        return [message(store, inner[1], each, at) for each in value or [{}] * size]
    return np.array(np.zeros(size) if value is None else value, inner[1][0])


def bag(path, kind, topics, definitions=None):
    """Write a bag, and return the path to read.

    `topics`: by name, the type, times [s], and a function from row to the values of its message. A time of the message
    is that of the row, plus `EPOCH`; it is recorded 3 ms later.
    """
    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    for name, text in (definitions or ACTUATORS).items():
        store.register(get_types_from_msg(text, name))
    shutil.rmtree(path, ignore_errors=True)
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Writer1(path) if kind == "bag" else Writer2(path, version=9, storage_plugin=plugin)
    encode = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
    rows = []
    with writer:
        for name, (what, times, values) in topics.items():
            connection = writer.add_connection(name, what, typestore=store)
            for row, t in enumerate(np.rint(1e9 * np.asarray(times)).astype(int).tolist()):
                rows.append((EPOCH + t, connection, encode(message(store, what, values(row), EPOCH + t), what)))
        for at, connection, content in sorted(rows, key=lambda each: each[0]):
            writer.write(connection, at + 3_000_000, content)
    return pathlib.Path(path) if kind == "bag" else next(pathlib.Path(path).glob(f"*.{kind}"))


def vector(values):
    return dict(zip("xyz", values, strict=True))


def imu(t, quaternions):
    """Values of sensor_msgs/Imu at the rows of `t`; `quaternions`: w, x, y, z."""
    gyro, specific = rates(t), force(t)

    def values(row):
        turn = dict(zip("wxyz", quaternions[row], strict=True))
        return {
            "orientation": turn,
            "angular_velocity": vector(gyro[row]),
            "linear_acceleration": vector(specific[row]),
        }

    return "sensor_msgs/msg/Imu", t, values


def motors(t):
    return "mav_msgs/msg/Actuators", t, lambda row: {"angular_velocities": speeds(t)[row]}


def moving(t):
    """Pose and velocity at the rows of `t`, as MAVROS has them."""
    pose = ("geometry_msgs/msg/PoseStamped", t, lambda row: {"pose": {"position": vector(position(t)[row])}})
    twist = ("geometry_msgs/msg/TwistStamped", t, lambda row: {"twist": {"linear": vector(velocity(t)[row])}})
    return pose, twist
