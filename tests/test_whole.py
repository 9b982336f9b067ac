"""Tables in a terminal: no cell is cut, whatever the numbers and the width."""

import io

from hypothesis import given, strategies as st
from rich.console import Console

from jaxos4.report.text import Listing

NUMBERS = st.floats(allow_nan=False, allow_infinity=False).map(lambda x: f"{x:.5g}")
NOTES = st.sampled_from(
    ["", "not excited", "below noise: cannot be distinguished from 0, or at the edge of the bracket"]
)


def printed(listing, width):
    console = Console(width=width, file=io.StringIO())
    listing.print_on(console)
    assert console.width == width
    return console.file.getvalue()


@given(rows=st.lists(st.tuples(NUMBERS, NUMBERS, NOTES), min_size=1, max_size=4), width=st.integers(20, 120))
def test_no_cell_is_cut(rows, width):
    names = [f"thrust_gain_{i}" for i in range(len(rows))]
    cells = [(name, low, f"[{low}, {high}]") for name, (low, high, _) in zip(names, rows, strict=True)]
    text = printed(
        Listing(("parameter", "estimate", "95 % interval"), cells, ("estimate",), [note for *_, note in rows]), width
    )
    assert "…" not in text
    for row in cells:
        assert all(cell in text for cell in row)
    words = " ".join(text.split())
    for *_, note in rows:
        assert all(word in words for word in note.split())


def test_a_wide_table_stays_as_wide_as_the_terminal_if_it_fits():
    listing = Listing(
        ("name", "use"), [("a", "rotor 1, 2, 3, 4 at rest or idle, for a long time, in the air")], wraps=("use",)
    )
    lines = printed(listing, 40).splitlines()
    assert max(map(len, lines)) <= 40
    assert len(lines) > 3
    listing = Listing(("name",), [("a",)], notes=["not excited"])
    assert printed(listing, 40).splitlines()[-1].split() == ["a", "not", "excited"]
    assert "a: not" in printed(listing, 12)
