"""An output file is checked before the work that fills it, and is never one of the inputs."""

from pathlib import Path

from .._files import check_writable
from ..errors import InputError


def check_output(out: Path, *inputs: Path | None) -> None:
    """Refuses an output that cannot be written, or that would overwrite an input."""
    target = check_writable(out)
    for source in inputs:
        if source is not None and source.exists() and target.exists() and source.samefile(target):
            raise InputError(f"{out}: would overwrite an input; give the output another name.")
