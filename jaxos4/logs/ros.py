"""Bags of ROS 1 and ROS 2, and MCAP files of ROS 2, decoded by rosbags. Topics, times and presets: docs/logs.md.

A column's source is `/topic.field.field[0]`. A topic may have a namespace before the name in the column map.
"""

import contextlib
import functools
import itertools
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._files import reading
from ..errors import listed, quoted, shortened
from ..flight import ANGLE_NAMES, COMMAND_NAMES, RATE_NAMES, SPEED_NAMES
from ..rotations import euler_angles
from .columns import QUATERNION, ColumnMap, column_map, presets
from .compression import check_part, check_sizes
from .messages import Fields, Messages, Rotors
from .sampling import Series
from .table import MAX_ROWS, LogFormat, LogPath, Table, opened, refuse

_ROS1, _MCAP, _SQLITE, _FOLDER = b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\0", b"rosbag2_bagfile_information:"
_TYPE = re.compile(r"\w+(/\w+)+", re.ASCII)  # rosbags makes program code from it
_FIELD = re.compile(r"[^.\[\]]+")
_STAMPS = ("timestamp_sample", "timestamp")  # of PX4 [us]
_RECORDED, _STAMPED = "recorded", "stamp"  # the times of a message; the names of fields have a dot
_ONE_CLOCK = 0.5  # s; stamps of one clock differ by less from the times of the recorder
_REPAIR = "copy it again, or repair it (`rosbag reindex`, `ros2 bag reindex`, `mcap recover`)"
_REMEDY = 'correct unit or sign in the column map, or give time = "recorded" in it'
_LONGEST_DEFINITIONS = 1 << 16  # characters: usual definitions have a few thousand, and their parser is slow
_STEPS = 10_000  # of a database, between two looks at their number
_NO_TYPES = "holds no definition of its messages; record it as MCAP (`ros2 bag record -s mcap`), or convert it"


def read_ros(path: LogPath, columns: ColumnMap | None = None) -> tuple[Table, tuple[str, ...]]:
    """Read columns of a bag by a column map, or by the first preset that fits. Raises `InputError`."""
    try:
        import rosbags  # noqa: F401
    except ImportError:
        refuse(path, "reading a ROS bag needs rosbags; install jaxos4[ros]")
    with _damage(path):
        reader = _reader(path)
        with _only_tables(path):
            reader.open()
        if getattr(getattr(reader, "metadata", None), "compression_mode", "") == "message":
            for store in reader.storages:
                for *_, message in store.messages(store.connections):
                    check_part(path, "zstd", message)
    try:
        return _read(path, reader, columns)
    finally:
        reader.close()


ROS = LogFormat(
    "ROS", "ROS bag or MCAP", lambda begin: begin.startswith((_ROS1, _MCAP, _SQLITE, _FOLDER)), read_ros, read_ros
)


def _reader(path: LogPath) -> Any:
    """The reader of rosbags for a file or folder, before it is opened. Raises `InputError` if the bag is too large."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    place, begin = Path(path), b""
    if not place.is_dir():
        with opened(path, "rb") as file:
            begin = file.read(len(_FOLDER))
        place = place.parent if begin.startswith(_FOLDER) else place
    check_sizes(place)
    if place.is_dir():
        return Reader2(place)
    kinds = {_ROS1: Reader1, _MCAP: McapReader, _SQLITE: Sqlite3Reader}
    return next(reader for magic, reader in kinds.items() if begin.startswith(magic))(place)


@contextlib.contextmanager
def _only_tables(path: LogPath) -> Iterator[None]:
    """Refuses SQLite databases, opened in the block, that hold a view or take more steps than their size explains.

    A view can have endless rows, and so can damaged pages. A sound bag takes less than two steps for each byte.
    """
    import apsw

    def check(database: apsw.Connection) -> None:
        most = 1_000_000 + 100 * os.path.getsize(database.filename)
        done = itertools.count(_STEPS, _STEPS)
        database.set_progress_handler(lambda: next(done) > most, _STEPS)
        tables = ("TABLE", "INDEX", "UNIQUE INDEX")
        others = " AND ".join(f"sql NOT LIKE 'CREATE {each} %'" for each in tables)
        for (name,) in database.execute(f"SELECT name FROM sqlite_schema WHERE {others}"):
            refuse(path, f"its database holds {quoted(str(name))}, which is no table; {_REPAIR}")

    apsw.connection_hooks.append(check)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(check)


def _damage(path: LogPath) -> contextlib.AbstractContextManager[None]:
    return reading(path, "cannot be decoded", _REPAIR)


def _read(path: LogPath, reader: Any, columns: ColumnMap | None) -> tuple[Table, tuple[str, ...]]:
    topics = sorted({each.topic for each in reader.connections})

    def find(source: str) -> str | None:
        """The source with the whole name of its topic: the only topic that ends like the source's."""
        name, _, field = source.partition(".")
        found = [name] if name in topics else [topic for topic in topics if topic.endswith(name)]
        return f"{found[0]}.{field}" if len(found) == 1 and name.startswith("/") and field else None

    notes: list[str] = []
    if columns is None:
        for columns in map(column_map, presets()):
            found = columns.chosen(path, find, topics).keys()
            if found >= {*RATE_NAMES} and found & {"omega1", "command1"}:
                break
        else:
            what = f"is for none of its presets ({', '.join(presets())}). Its topics are {listed(topics) or 'none'}"
            refuse(path, f"{what}: say in a column map which hold rates and motors, and give that map as `columns`")
        notes.append(f"columns are those of the preset {columns.name}")
    chosen = columns.chosen(path, find, topics)
    found = _timed(_messages(path, reader, {*chosen.values()}), notes, recorded=columns.recorded)
    return _table(Messages(path, found, _REMEDY, notes, prefixed=False), columns, chosen)


def _messages(path: LogPath, reader: Any, places: set[str]) -> dict[str, dict[str, list[float]]]:
    """For each topic, the values at these places, the stamps, and the recorder's times [ns]. Raises `InputError`."""
    getters: dict[str, dict[str, Callable[[Any], float]]] = {}
    for place in sorted(places):
        topic, _, field = place.partition(".")
        getters.setdefault(topic, {_STAMPED: _stamp})[place] = _getter(path, place, field)
    found: dict[str, dict[str, list[float]]] = {
        topic: {name: [] for name in (_RECORDED, *fields)} for topic, fields in getters.items()
    }
    wanted = [each for each in reader.connections if each.topic in getters]
    with _damage(path):
        decode = _decoder(path, wanted, ros1=type(reader).__module__.startswith("rosbags.rosbag1"))
        for number, (connection, at, content) in enumerate(reader.messages(connections=wanted)):
            if number > MAX_ROWS:
                refuse(path, f"has more than {MAX_ROWS:,} messages of these topics; cut it into flights")
            message, values = decode(content, connection.msgtype), found[connection.topic]
            values[_RECORDED].append(float(at))  # in SQLite, a time can be of any type
            for name, get in getters[connection.topic].items():
                values[name].append(get(message))
    return found


def _timed(
    found: dict[str, dict[str, list[float]]], notes: list[str], *, recorded: bool
) -> dict[str, dict[int, Fields]]:
    """The topics as `Messages` holds them. Times are stamps if all topics have stamps of one clock.

    Otherwise they are the times of the recorder.
    """
    found = {topic: values for topic, values in found.items() if values[_RECORDED]}
    times = [(np.array(each[_RECORDED], float), np.array(each[_STAMPED], float)) for each in found.values()]
    apart = [float(np.median(stamps - at)) for at, stamps in times]
    stamped = all((stamps > 0).all() for _, stamps in times)
    if not recorded and not (stamped and np.ptp(apart or [0.0]) < _ONE_CLOCK * 1e9):
        notes.append("times are those of the recorder, because not all topics have stamps of one clock")
        recorded = True
    kind = _RECORDED if recorded else _STAMPED
    begin = min((min(values[kind]) for values in found.values()), default=0)
    messages = {}
    for topic, values in found.items():
        fields = {name: np.array(x, float) for name, x in values.items() if name not in (_RECORDED, _STAMPED)}
        messages[topic] = {0: fields | {"t": 1e-9 * np.array([each - begin for each in values[kind]], float)}}
    return messages


def _decoder(path: LogPath, connections: list[Any], *, ros1: bool) -> Callable[[bytes, str], Any]:
    """A decoder of these connections' messages, by the definitions in the file or, without them, by those of ROS 2."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = dict(get_typestore(Stores.LATEST).fielddefs)
    if sum(len(text) for text in {each.msgdef.data for each in connections}) > _LONGEST_DEFINITIONS:
        refuse(path, f"the definitions of its messages are longer than {_LONGEST_DEFINITIONS:,} characters; {_REPAIR}")
    for each in connections:
        if not _TYPE.fullmatch(each.msgtype):
            refuse(path, f"has a type of messages {quoted(each.msgtype)}; {_REPAIR}")
        if each.msgdef.format == MessageDefinitionFormat.MSG:
            types |= get_types_from_msg(each.msgdef.data, each.msgtype)
        elif each.msgtype not in types:
            refuse(path, f"{_NO_TYPES}", column=each.topic, kind="topic")
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store.deserialize_ros1 if ros1 else store.deserialize_cdr


def _getter(path: LogPath, place: str, field: str) -> Callable[[Any], float]:
    """A function that takes a number out of a message; NaN if an array is shorter. It raises `InputError`."""
    steps = [int(each) if each.isdecimal() and len(each) < 10 else each for each in _FIELD.findall(field)]
    wrong = functools.partial(refuse, path, column=place, kind="field")

    def get(message: Any) -> float:
        value = message
        for step in steps:
            try:
                value = value[step] if isinstance(step, int) else getattr(value, step)
            except IndexError:
                return math.nan
            except (AttributeError, TypeError):
                fields = [name for name in getattr(value, "__dataclass_fields__", ()) if name[:2] != "__"]
                what = f"has no {shortened(str(step), 40)} there, but {', '.join(fields) or 'a number'}"
                wrong(f"{what}; correct the column map")
        try:
            return float(value)
        except (TypeError, ValueError):
            wrong("is not a number; name one of its fields in the column map")

    return get


def _stamp(message: Any) -> int:
    """The time stamp of a message [ns]; 0 if it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is not None:
        return stamp.sec * 10**9 + stamp.nanosec
    return next((1000 * t for name in _STAMPS if (t := getattr(message, name, 0))), 0)


def _table(log: Messages, columns: ColumnMap, chosen: dict[str, str]) -> tuple[Table, tuple[str, ...]]:
    """The table of the columns that a map has `chosen`. Raises `InputError` if body rates or rotors are missing."""
    found: dict[str, Series] = {}
    for topic in sorted({place.partition(".")[0] for place in chosen.values()}):
        own = {column: place for column, place in chosen.items() if place.partition(".")[0] == topic}
        series = log.series(topic, [*own.values()])
        if series is not None:
            numbers = {column: columns.converted(column, x) for column, x in zip(own, series.values.T, strict=True)}
            found |= {column: Series(series.t, x[:, None]) for column, x in numbers.items()}

    def together(names: Sequence[str]) -> Series | None:
        """Several columns at the times of the first."""
        if not found.keys() >= set(names):
            return None
        log.names.update((name, chosen[name]) for name in names)
        t = found[names[0]].t

        def at(name: str) -> np.ndarray:
            series = found[name]
            if series.t is not t and name in SPEED_NAMES:
                return log.speeds_at(t, series, chosen[name])
            return series.values[:, 0] if series.t is t else np.interp(t, series.t, series.values[:, 0])

        return Series(t, np.column_stack([at(name) for name in names]))

    def rotors(names: Sequence[str]) -> Rotors | None:
        """The samples that have all four rotors. `None` if a rotor, measured or commanded, never turns."""
        found = together(names)
        if found is None or not (found.values > 0).any(axis=0).all():
            return None
        return Rotors.of(found, [chosen[name] for name in names], is_measured=names == SPEED_NAMES)

    quaternion, angles = together(QUATERNION), together(ANGLE_NAMES)
    if angles is None and quaternion is not None:
        angles = Series(quaternion.t, euler_angles(quaternion.values))
        log.names.update(dict.fromkeys(ANGLE_NAMES, chosen["qw"]))
    single = found.keys() - {*SPEED_NAMES, *COMMAND_NAMES, *QUATERNION, *ANGLE_NAMES, *RATE_NAMES, "t"}
    return log.table(
        {RATE_NAMES: together(RATE_NAMES), ANGLE_NAMES: angles}
        | {(name,): together((name,)) for name in sorted(single)},
        rotors(SPEED_NAMES) or rotors(COMMAND_NAMES),
        remedies=(f"name p, q and r in {columns.name}", f"name omega1..4 or command1..4 in {columns.name}"),
    )
