"""Messages of the library in the words of the command line."""

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path

from ..errors import InputError

_PHRASES = {
    "an `Airframe` as `subject`": "--model flight",
    "`subject`": "--model",
    "`begin`": "--from",
    "`end`": "--to",
}
_OPTIONS = (
    "angle|bandwidth|bracket|channels|criterion|distance|dt|duration|estimator|fastest|gust|holdout|initial_state|loss|"
    "network|rate|sample_time|samples|seed|slew|slowest|terms|validate|velocity|window"
)


def in_options(text: str, **files: Path | None) -> str:
    """A message with options for the library's arguments: `--from` for `` `begin` ``.

    `files`: file names to print behind an option.
    """
    for phrase, option in _PHRASES.items():
        text = text.replace(phrase, option)

    def option_of(match: re.Match[str]) -> str:
        path = files.get(match[1])
        return f"--{match[1].replace('_', '-')}{'' if path is None else f' {path}'}"

    return re.sub(f"`({_OPTIONS})`", option_of, text)


@contextlib.contextmanager
def option_names(**files: Path | None) -> Iterator[None]:
    """Raises an `InputError` of the library again, in the words of the command line; `files` as of `in_options`."""
    try:
        yield
    except InputError as error:
        raise InputError(in_options(str(error), **files)) from None
