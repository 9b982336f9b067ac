"""Tutorials as cells, pages and notebooks. They are executed, and their answers checked, when the site is built."""

import json
from pathlib import Path

import pytest

from docs.notebooks import TUTORIALS, Cell, cells, executed, notebook, page

SCRIPT = """# %% [markdown]
# # Title
#
# Introduction.

# %%
import matplotlib.pyplot as plt

x = 2
print("printed")
x + 1

# %% [markdown]
# Text.

# %%
plt.plot([x, 1])

# %% [check]
assert x == 2
"""


def test_every_tutorial_checks_its_answers():
    """They run when the site is built."""
    for path in TUTORIALS.glob("*.py"):
        *_, last = cells(path.read_text(encoding="utf-8"))
        assert last.is_check, path.stem
        assert "assert " in last.source, path.stem


def test_cells_show_what_they_print_and_draw():
    assert [cell.is_text for cell in cells(SCRIPT)] == [True, False, True, False, False]
    ran, defined = executed(SCRIPT)
    assert defined["x"] == 2
    assert ran[0] == Cell("# Title\n\nIntroduction.", is_text=True)
    assert (ran[1].said, ran[1].pictures) == ("printed\n3", ())
    assert (ran[3].said, len(ran[3].pictures)) == ("", 1)
    assert page("it", ran).count("(it-0.svg){ .panel }") == 1
    kinds = [(cell["cell_type"], len(cell.get("outputs", ()))) for cell in json.loads(notebook(ran))["cells"]]
    assert kinds == [("markdown", 0), ("code", 1), ("markdown", 0), ("code", 1)]


@pytest.mark.parametrize(
    ("script", "error"), [("# %%\n1 / 0\n", ZeroDivisionError), ("# %% [check]\nassert 1 == 2\n", AssertionError)]
)
def test_a_tutorial_that_fails_leaves_the_folder_and_names_the_error(script, error):
    before = Path.cwd()
    with pytest.raises(error):
        executed(script)
    assert Path.cwd() == before
