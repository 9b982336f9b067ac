"""The report of a study, as files."""

import re
from pathlib import Path

import xarray as xr

from .._files import check_writable, write_atomically
from . import figures
from .page import MOST_DRAWN, page
from .scenario import Scenario, count, scenarios


def write_report(dataset: xr.Dataset, directory: Path, *, with_pdf: bool = True) -> list[Path]:
    """Writes `report.html`, `figures/*.svg` and `figures/*.pdf` into `directory`; returns their paths, the page first.

    **Arguments:**

    - `with_pdf`: if false, figures are SVG only, which takes half the time.

    All figures are drawn before the first file is written. Figures that only an older report has are removed.
    """
    target = directory / "report.html"
    check_writable(target)
    numbered = count(dataset) > 1
    sections: list[tuple[Scenario, list[figures.Drawn]]] = []
    for scenario in scenarios(dataset):
        drawn = figures.of_scenario(scenario, numbered=numbered, with_pdf=with_pdf)
        sections.append((scenario, list(drawn) if scenario.number <= MOST_DRAWN else []))
    once = list(figures.of_example(dataset, with_pdf=with_pdf))
    text = page(dataset, sections, once)
    folder = directory / "figures"
    folder.mkdir(exist_ok=True)
    written: list[Path] = []
    for drawn in [drawn for _, of_scenario in sections for drawn in of_scenario] + once:
        for suffix, content in (("svg", drawn.svg), ("pdf", drawn.pdf)):
            if content is not None:
                written.append(_write(folder / f"{drawn.stem}.{suffix}", content))
    _write(target, text.encode())
    kinds = "|".join(kind.name for kind in (*figures.OF_SCENARIOS, *figures.OF_EXAMPLE))
    for path in folder.iterdir():
        if path not in written and re.fullmatch(rf"({kinds})(-\d+)?\.(svg|pdf)", path.name):
            path.unlink()
    return [target, *written]


def _write(path: Path, content: bytes) -> Path:
    with write_atomically(path) as beside:
        beside.write_bytes(content)
    return path
