"""Output files: checked before the work that fills them, never one of the inputs, and written whole or not at all."""

import json
import secrets
import shutil
from pathlib import Path
from typing import Any

from .._files import check_writable, write_atomically
from ..errors import InputError


def check_output(out: Path, *inputs: Path | None) -> None:
    """Refuses an output that cannot be written, or that would overwrite an input."""
    target = check_writable(out)
    for source in inputs:
        if source is not None and source.exists() and target.exists() and source.samefile(target):
            raise InputError(f"{out}: would overwrite an input; give the output another name.")


def check_different(**outputs: Path | None) -> None:
    """Refuses two outputs that are one file. Takes options by their names in Python."""
    names: dict[Path, str] = {}
    for name, out in outputs.items():
        option = f"--{name.replace('_', '-')}"
        if out is not None and (other := names.setdefault(out.resolve(), option)) != option:
            raise InputError(f"{out}: {other} and {option} name one file; give them two.")


def write_text(text: str, out: Path) -> None:
    """Writes a text file."""
    with write_atomically(out) as beside:
        beside.write_text(text, encoding="utf-8")


def check_new_folder(folder: Path) -> None:
    """Refuses a folder that exists, or that cannot be made."""
    if folder.exists():
        raise InputError(f"{folder}: exists; remove it, or give the output another name.")
    check_writable(folder)


def write_folder(texts: dict[str, str], folder: Path) -> None:
    """Writes text files, by name, into a new folder. It appears when all files are in it."""
    beside = folder.with_name(f".{folder.name[:40]}.{secrets.token_hex(4)}.part")
    try:
        beside.mkdir()
        for name, text in texts.items():
            (beside / name).write_text(text, encoding="utf-8")
        beside.rename(folder)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def write_json(report: dict[str, Any], out: Path) -> None:
    """Writes a JSON file. A number that is not finite is an error of the program."""
    write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", out)
