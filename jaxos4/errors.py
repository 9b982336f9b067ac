"""Errors that the user can fix. The message says in one line what is wrong, where, and what to do."""

import contextlib
from collections.abc import Iterator


class InputError(ValueError):
    """A file or an argument cannot be used."""


class TrainingError(RuntimeError):
    """A network could not be trained."""


def shortened(text: str, most: int) -> str:
    """The text, cut to `most` characters with "..." at its end if it is longer."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


@contextlib.contextmanager
def named(place: object) -> Iterator[None]:
    """Raises a `ValueError` of the block again, as an `InputError` that begins with its place."""
    try:
        yield
    except ValueError as error:
        raise InputError(f"{place}{': ' if place else ''}{error}") from None
