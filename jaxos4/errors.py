"""Errors that the user can fix, and the words of messages: in one line what is wrong, where, and what to do."""

import contextlib
import re
from collections.abc import Collection, Iterable, Iterator


class InputError(ValueError):
    """A file or an argument cannot be used. The message is one printable line of at most `longest` characters."""

    longest = 5000

    def __init__(self, message: str):
        text, half = printable(message), (self.longest - 3) // 2
        super().__init__(text if len(text) <= self.longest else f"{text[:half]}...{text[-half:]}")


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Raises `InputError` if the value of an argument is not one of its choices."""
    if value not in choices:
        raise InputError(f"`{name}` must be one of {', '.join(choices)}, got {value!r}.")


class TrainingError(RuntimeError):
    """A network could not be trained."""


def printable(text: str) -> str:
    """`text` on one line, with unprintable characters escaped: line breaks, controls, bytes that are not UTF-8."""
    return text if text.isprintable() else "".join(x if x.isprintable() else repr(x)[1:-1] for x in text)


def shortened(text: str, most: int) -> str:
    """The text, cut to `most` characters with "..." at its end if it is longer."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def quoted(text: str) -> str:
    """`text` in quotes, on one line, with at most 40 characters."""
    return repr(shortened(text, 40))


def listed(names: Iterable[str], most: int = 20) -> str:
    """The first names in quotes."""
    every = [*names]
    return ", ".join(map(quoted, every[:most])) + ", ..." * (len(every) > most)


def counted(number: int, noun: str) -> str:
    """`1 gap`, or `2 gaps`."""
    return f"{number} {noun}{'s' * (number != 1)}"


def percent(share: float, digits: int = 2) -> str:
    """A share in percent with `digits` significant digits, and never as a power of ten above 1: "0.36 %", "110 %"."""
    value = float(f"{100 * share:.{digits}g}")
    return f"{value:.0f} %" if abs(value) >= 10**digits else f"{value:g} %"


def in_words(error: Exception, most: int = 120) -> str:
    """The message of an error on one line, at most this many characters; the name of its type if it has none."""
    return " ".join(str(error).split())[:most] or type(error).__name__


def of_schema(error: Exception) -> str:
    """A message of msgspec with the place first, and types in plain words."""
    complaint, _, place = " ".join(str(error).split()).partition(" - at `$")
    words = {"object": "a table", "array": "a list", "int": "a whole number", "null": "nothing"}
    words |= {"float": "a number", "str": "a string", "bool": "true or false"}
    types = "|".join(words)  # one, or several with bars between them
    for found in re.findall(rf"`((?:{types})(?: \| (?:{types}))*)`", complaint):
        complaint = complaint.replace(f"`{found}`", " or ".join(words[each] for each in found.split(" | ")))
    complaint = f"{complaint[:1].lower()}{complaint[1:]}"
    return f"`{place.strip('.`')}`: {complaint}" if place.strip(".`") else complaint


@contextlib.contextmanager
def named(place: object) -> Iterator[None]:
    """Raises a `ValueError` of the block again, as an `InputError` that begins with its place."""
    try:
        yield
    except ValueError as error:
        raise InputError(f"{place}{': ' if place else ''}{error}") from None
