"""The report of a study, as files."""

import re
from pathlib import Path

import xarray as xr

from .._files import check_writable, write_atomically
from . import figures
from .page import MOST_DRAWN, page
from .scenario import count, scenarios

REPORT_FILE = "report.html"
FIGURES_FOLDER = "figures"


def write_report(dataset: xr.Dataset, directory: Path, *, with_pdf: bool = True) -> list[Path]:
    """Writes `report.html`, `figures/*.svg` and `figures/*.pdf` into `directory`; returns their paths, the page first.

    **Arguments:**

    - `with_pdf`: if false, figures are SVG only, which takes half the time.

    All figures are drawn before the first file is written. Each file is written completely or not at all. Figures of an
    older report that this report does not have are removed.
    """
    target = directory / REPORT_FILE
    check_writable(target)
    numbered = count(dataset) > 1
    sections = [
        (
            scenario,
            list(figures.of_scenario(scenario, numbered=numbered, with_pdf=with_pdf))
            if scenario.number <= MOST_DRAWN
            else [],
        )
        for scenario in scenarios(dataset)
    ]
    once = list(figures.of_example(dataset, with_pdf=with_pdf))
    text = page(dataset, sections, once)
    folder = directory / FIGURES_FOLDER
    folder.mkdir(exist_ok=True)
    written: list[Path] = []
    for drawn in [drawn for _, of_scenario in sections for drawn in of_scenario] + once:
        for suffix, content in (("svg", drawn.svg), ("pdf", drawn.pdf)):
            if content is not None:
                written.append(_write(folder / f"{drawn.stem}.{suffix}", content))
    _write(target, text.encode())
    _remove_others(folder, written)
    return [target, *written]


def _write(path: Path, content: bytes) -> Path:
    with write_atomically(path) as beside:
        beside.write_bytes(content)
    return path


def _remove_others(folder: Path, written: list[Path]) -> None:
    kinds = "|".join(kind.name for kind in (*figures.OF_SCENARIOS, *figures.OF_EXAMPLE))
    for path in folder.iterdir():
        if path not in written and re.fullmatch(rf"({kinds})(-\d+)?\.(svg|pdf)", path.name):
            path.unlink()
