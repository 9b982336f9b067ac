"""The tutorials of the documentation run, and their answers hold the truth."""

import contextlib
import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

import jaxos4
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
"""


def near(found: jaxos4.Identification, **truth: float) -> bool:
    """Whether the moments of inertia are identified, and within three standard deviations."""
    values = found.rigid_body.constants
    return all(
        found.verdicts[name].status == "identified" and abs(values[name].estimate - true) < 3 * values[name].std
        for name, true in truth.items()
    )


def own_drone(has):
    assert near(has["found"], Ix=1.66e-5, Iy=1.7e-5)
    assert jaxos4.recording.self_checks(has["recording"], has["airframe"]) == ()
    assert "units of g" in str(jaxos4.recording.self_checks(has["wrong"], has["airframe"])[0])


def betaflight(has):
    assert near(has["found"], Ix=2.4e-3, Iy=2.8e-3)
    assert has["wrong"].verdicts["Iz"].status == "contradicted"


def study(has):
    assert all(0.7 < has["ratio"][name].min() and has["ratio"][name].max() < 1.3 for name in ("IBSS", "hybrid"))


def term(has):
    truth = has["truth"][7], has["truth"][8]
    off = [(value - true) / std for (value, std), true in zip(list(has["within"].values())[7:], truth, strict=True)]
    assert np.abs(off).max() < 3
    value, std = has["without"]["alpha8"]
    assert value < truth[0] - 10 * std


def predict(has):
    assert (has["quality"].error < has["quality"].constant).all()
    assert ElementTree.fromstring(has["exported"].text).tag == "mujoco"


CLAIMS = {claim.__name__: claim for claim in (own_drone, betaflight, study, term, predict)}


def test_every_tutorial_is_run():
    assert CLAIMS.keys() == {path.stem for path in TUTORIALS.glob("*.py")}


@pytest.mark.slow
@pytest.mark.parametrize("name", CLAIMS)
def test_a_tutorial_runs(name, monkeypatch):
    monkeypatch.setitem(jaxos4.TERMS.data, "friction", None)
    monkeypatch.delitem(jaxos4.TERMS.data, "friction")
    _, defined = executed((TUTORIALS / f"{name}.py").read_text(encoding="utf-8"))
    CLAIMS[name](defined)


def test_cells_show_what_they_print_and_draw():
    assert [cell.is_text for cell in cells(SCRIPT)] == [True, False, True, False]
    ran, defined = executed(SCRIPT)
    assert defined["x"] == 2
    assert ran[0] == Cell("# Title\n\nIntroduction.", is_text=True)
    assert (ran[1].said, ran[1].pictures) == ("printed\n3", ())
    assert (ran[3].said, len(ran[3].pictures)) == ("", 1)
    assert page("it", ran).count("(it-0.svg){ .panel }") == 1
    kinds = [(cell["cell_type"], len(cell.get("outputs", ()))) for cell in json.loads(notebook(ran))["cells"]]
    assert kinds == [("markdown", 0), ("code", 1), ("markdown", 0), ("code", 1)]


def test_a_tutorial_that_fails_leaves_the_folder_and_names_the_error():
    before = Path.cwd()
    with contextlib.suppress(ZeroDivisionError):
        executed("# %%\n1 / 0\n")
        pytest.fail("no error")
    assert Path.cwd() == before
