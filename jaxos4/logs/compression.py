"""Compressed parts of a bag, measured before they are decompressed: a small file must not fill memory or disk."""

import io
import pkgutil
import re
import struct
import sys
from pathlib import Path
from typing import IO, NoReturn

from ..errors import InputError
from .table import LogPath, opened, refuse

MAX_PART = 1 << 28  # bytes of a chunk or a message, in memory; recorders write about a megabyte, a bomb has gigabytes
MAX_FILE = 1 << 34  # bytes, on the disk, of a file compressed as a whole; a bag of an hour has a few gigabytes
MAX_TIMES, SMALL = 100, 1 << 29  # such a file may grow so many times, or to so many bytes; bags shrink 2 to 20 times
MAX_METADATA = 1 << 19  # bytes of metadata.yaml, whose parser takes 14 s for a megabyte; a topic has about a kilobyte
_ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
_FILES = {"bz2": "bz2:BZ2File", "lz4": "lz4.frame:LZ4FrameFile", "zstd": f"{_ZSTD}:ZstdFile"}
_MCAP, _CHUNK_OF_MCAP, _ATTACHMENT_OF_MCAP, _CHUNK_OF_ROS1 = b"\x89MCAP", 6, 9, b"\x05"


def check_sizes(path: LogPath) -> None:
    """Raises `InputError` for a bag, file or folder, that is too large when it is decompressed. Readers report damage.

    What is in a folder must be files: a pipe or a device has no end.
    """
    place = Path(path)
    for each in sorted(place.iterdir()) if place.is_dir() else [place]:
        if each.is_dir() or not each.exists():
            continue
        if each.parent == place and not each.is_file():
            refuse(each, "is a pipe or a device in the folder of a bag; remove it")
        with opened(each, "rb") as file:
            begin = file.read(8)
            if each.name == "metadata.yaml":
                _check_metadata(each, begin + file.read(MAX_METADATA))
            elif begin.startswith(_MCAP):
                _check_mcap(path, file, end=1 << 62)
            elif begin == b"#ROSBAG ":
                file.readline()
                _check_ros1(path, file)
            else:
                file.seek(0)
                _check_whole(each, file)


def _check_metadata(path: Path, content: bytes) -> None:
    """Refuse a text in YAML that is too long or refers to itself: lists of its own lists could have any length."""
    if len(content) > MAX_METADATA:
        refuse(path, f"has more than {MAX_METADATA:,} bytes; make it anew by `ros2 bag reindex`")
    if re.search(rb"[:,[{-]\s*[*&]\w", content):
        refuse(path, "names parts of itself (& and *), which no recorder does; make it anew by `ros2 bag reindex`")


def _check_whole(path: Path, packed: IO[bytes]) -> None:
    """Refuse a file that grows too much. If it is compressed as a whole, it is decompressed once, a part at a time."""
    most = min(MAX_FILE, max(SMALL, MAX_TIMES * path.stat().st_size))
    end = most + 1
    try:
        with pkgutil.resolve_name(_FILES["zstd"])(packed) as file:
            if file.read(8).startswith(_MCAP):
                _check_mcap(path, file, end=end)
            too_large = file.seek(end) == end
    except InputError:
        raise
    except Exception:  # noqa: BLE001 - of a damaged file, a decompressor raises any
        return
    if too_large:
        what = f"has more than {most:,} bytes when it is decompressed"
        refuse(path, f"{what}; record it again in several files (--max-bag-size)")


def check_part(path: LogPath, kind: str, content: bytes) -> None:
    """Refuse a part of a bag that has more than `MAX_PART` bytes when it is decompressed.

    `kind`: the name of its compression. Any other name: the part is not compressed, or its reader refuses it.
    """
    if kind not in _FILES:
        return
    try:
        with pkgutil.resolve_name(_FILES[kind])(io.BytesIO(content)) as file:
            too_large = file.seek(MAX_PART + 1) > MAX_PART
    except Exception:  # noqa: BLE001 - of a damaged part, a decompressor raises any
        return
    if too_large:
        _refuse_part(path)


def _refuse_part(path: LogPath) -> NoReturn:
    refuse(path, f"holds a part of more than {MAX_PART:,} bytes; record it again in parts of a few megabytes")


def _check_mcap(path: LogPath, file: IO[bytes], *, end: int) -> None:
    """Check the records of a file that is open behind its first eight bytes, up to the byte `end`.

    A reader holds each record in memory, except attachments.
    """
    while file.tell() < end and len(head := file.read(9)) == 9:
        kind, length = struct.unpack("<BQ", head)
        if kind != _ATTACHMENT_OF_MCAP and length > MAX_PART:
            _refuse_part(path)
        if kind != _CHUNK_OF_MCAP:
            file.seek(min(file.tell() + length, end))
            continue
        chunk = file.read(length)
        (size,) = struct.unpack_from("<I", chunk.ljust(32), 28)
        check_part(path, chunk[32 : 32 + size].decode(errors="replace"), chunk[40 + size :])


def _check_ros1(path: LogPath, file: IO[bytes]) -> None:
    """Check the chunks of a bag of ROS 1 that is open behind its first line."""
    while len(head := file.read(4)) == 4:
        header = file.read(struct.unpack("<I", head)[0])
        (length,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
        if b"op=" + _CHUNK_OF_ROS1 not in header:
            file.seek(length, 1)
            continue
        if length > MAX_PART:
            _refuse_part(path)
        kind = re.search(rb"compression=(none|bz2|lz4)", header)
        check_part(path, "" if kind is None else kind[1].decode(), file.read(length))
