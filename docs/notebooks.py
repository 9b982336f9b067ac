"""The tutorials: scripts in cells, executed when the site is built, and shown with what they print and draw.

A cell begins with `# %%`, or with `# %% [markdown]` if it is text: the percent format, which editors open as a
notebook. The last cell, `# %% [check]`, asserts that the answers are right; it is executed, but not shown. Each page
offers the script, and a notebook with the outputs.
"""

import ast
import contextlib
import functools
import io
import json
import re
import tempfile
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt

from jaxos4._xla import add_flags

add_flags(quick=True, brief=True)  # before JAX computes: tutorials compile for longer than they compute
TUTORIALS = Path(__file__).resolve().parent / "tutorials"


class Cell(NamedTuple):
    """Text or code, with what the code printed and the pictures that it drew (SVG)."""

    source: str
    is_text: bool = False
    is_check: bool = False
    said: str = ""
    pictures: tuple[str, ...] = ()


def cells(script: str) -> list[Cell]:
    """The cells of a script."""
    found = []
    for kind, source in re.findall(r"^# %%(.*)\n((?:(?!# %%).*\n?)*)", script, flags=re.MULTILINE):
        text = re.sub(r"^# ?", "", source, flags=re.MULTILINE) if "[markdown]" in kind else source
        found.append(Cell(text.strip(), "[markdown]" in kind, "[check]" in kind))
    return found


@functools.cache  # `mkdocs serve` builds again after each change
def executed(script: str) -> tuple[list[Cell], dict]:
    """The cells that are shown, with their outputs, and the names that all define. Runs in an empty folder."""
    defined: dict = {"__name__": "tutorial"}
    plt.switch_backend("agg")
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), plt.rc_context({"svg.hashsalt": "jaxos4"}):
        ran = [cell if cell.is_text else _executed(cell, defined) for cell in cells(script)]
    return [cell for cell in ran if not cell.is_check], defined


def _executed(cell: Cell, defined: dict) -> Cell:
    """Runs a cell as a notebook does: the value of a last expression is shown."""
    tree, pictures = ast.parse(cell.source), []
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(io.StringIO()) as said:
        exec(compile(tree, "<tutorial>", "exec"), defined)
        shown = eval(compile(ast.Expression(last.value), "<tutorial>", "eval"), defined) if last else None
        if shown is not None and not plt.get_fignums():
            said.write(str(shown))
    for number in plt.get_fignums():
        plt.figure(number).savefig(svg := io.StringIO(), format="svg", bbox_inches="tight", metadata={"Date": None})
        pictures.append(svg.getvalue()[svg.getvalue().index("<svg") :])
    plt.close("all")
    return cell._replace(said=said.getvalue().rstrip(), pictures=tuple(pictures))


def page(name: str, ran: list[Cell]) -> str:
    """The Markdown of a tutorial, with links to its script, its notebook and its pictures."""
    title, _, introduction = ran[0].source.partition("\n")
    offer = f"Executed when this site was built: [notebook]({name}.ipynb), [script]({name}.py)."
    parts, drawn = [title, offer, introduction.strip()], 0
    for cell in ran[1:]:
        parts.append(cell.source if cell.is_text else f"```python\n{cell.source}\n```")
        parts += [f"```\n{cell.said}\n```"] if cell.said else []
        for _ in cell.pictures:
            parts.append(f"![A figure of the code above.]({name}-{drawn}.svg){{ .panel }}")
            drawn += 1
    return "\n\n".join(parts) + "\n"


def notebook(ran: list[Cell]) -> str:
    """The JSON of a notebook with its outputs."""
    made = []
    for number, cell in enumerate(ran):
        one = {"id": f"cell-{number}", "metadata": {}, "source": cell.source}
        if cell.is_text:
            made.append({"cell_type": "markdown", **one})
            continue
        said = [{"output_type": "stream", "name": "stdout", "text": cell.said + "\n"}] if cell.said else []
        drawn = [
            {"output_type": "display_data", "metadata": {}, "data": {"image/svg+xml": each}} for each in cell.pictures
        ]
        made.append({"cell_type": "code", **one, "execution_count": None, "outputs": said + drawn})
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return json.dumps({"cells": made, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}, indent=1)


def on_files(files, config):
    """Adds the page, the notebook and the pictures of each tutorial."""
    from mkdocs.structure.files import File  # the tests run the tutorials without it

    for path in sorted(TUTORIALS.glob("*.py")):
        ran, _ = executed(path.read_text(encoding="utf-8"))
        at, pictures = f"tutorials/{path.stem}", [each for cell in ran for each in cell.pictures]
        made = {f"{at}.md": page(path.stem, ran), f"{at}.ipynb": notebook(ran)}
        made |= {f"{at}-{number}.svg": picture for number, picture in enumerate(pictures)}
        for name, content in made.items():
            files.append(File.generated(config, name, content=content))
    return files
