"""All figures of a study: what each is called, what it shows, and which variables of the Dataset it is drawn from."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import xarray as xr
from matplotlib.figure import Figure

from . import figures_example, figures_noise, figures_spread
from .scenario import Scenario
from .style import drawing, pdf, svg


class Kind(NamedTuple):
    """A figure that a study can have; `draw` gives nothing where its data are absent."""

    name: str
    title: str
    caption: str
    source: str
    draw: Callable[[xr.Dataset], Figure | None]


class Drawn(NamedTuple):
    """A figure of one study, as the bytes of its two files."""

    stem: str
    kind: Kind
    svg: bytes
    pdf: bytes | None


OF_SCENARIOS = (
    Kind(
        "error",
        "Error against noise",
        "Root-mean-square error over the flights told, with the Cramer-Rao bound of what each estimator looks at.",
        "estimate, truth, bound, seen, result",
        figures_noise.errors,
    ),
    Kind(
        "efficiency",
        "Efficiency against noise",
        "RMSE / bound, each estimator against its own bound, with 95 % Monte-Carlo intervals; 1 is the best that an "
        "unbiased estimator can do.",
        "estimate, truth, bound, result",
        figures_noise.efficiency,
    ),
    Kind(
        "distribution",
        "Distribution of the errors",
        "Errors in bounds: median, quartiles, and 95 % of the flights; an efficient estimator fills the space between "
        "the dashed lines. The file shows the noise scale nearest 1.",
        "estimate, truth, bound, result",
        figures_spread.distribution,
    ),
    Kind(
        "rollouts",
        "Accuracy against rollouts",
        "RMSE / least bound of any estimator (geometric mean over the parameters) against simulated flights spent.",
        "estimate, truth, bound, rollouts, result",
        figures_spread.rollouts,
    ),
    Kind(
        "coverage",
        "Coverage by level",
        "Intervals that hold the truth, averaged over the parameters, against what they claim (long lines), with 95 % "
        "Monte-Carlo intervals.",
        "estimate, truth, half_width, result",
        figures_spread.coverage,
    ),
    Kind(
        "frontier",
        "The noise below which a parameter can be told from 0",
        "Below its noise scale a parameter is larger than 1.96 Cramer-Rao bounds; above it no estimator can tell it "
        "from 0.",
        "truth, bound, seen",
        figures_noise.frontier,
    ),
)
"""The figures of each scenario."""

OF_EXAMPLE = (
    Kind(
        "trajectories",
        "Measured and simulated",
        "Dots: measured; black: the truth; coloured: simulated with each estimate.",
        "example_measured, example_true, example_simulated",
        figures_example.trajectories,
    ),
    Kind(
        "deviations",
        "Simulated less true",
        "The same flight, less the truth.",
        "example_simulated, example_true",
        figures_example.deviations,
    ),
    Kind(
        "path",
        "The path in space",
        "Dots: measured; black: the truth; coloured: simulated with each estimate.",
        "example_measured, example_true, example_simulated",
        figures_example.path,
    ),
    Kind(
        "search",
        "The search of IBSS",
        "Brackets of the example flight after each sweep.",
        "search_half_width, search_estimate",
        figures_example.search,
    ),
    Kind(
        "training",
        "Training",
        "Loss of the networks while they were trained.",
        "training_loss, validation_loss, training_step",
        figures_example.training,
    ),
)
"""The figures of the study's one example flight and of its networks."""


def of_scenario(scenario: Scenario, *, numbered: bool, with_pdf: bool = True) -> Iterator[Drawn]:
    """The figures of one scenario; `numbered`: there are others, and the files say which one this is."""
    for kind in OF_SCENARIOS:
        drawn = _draw(kind, scenario.data, f"{kind.name}-{scenario.number}" if numbered else kind.name, with_pdf)
        if drawn is not None:
            yield drawn


def of_example(dataset: xr.Dataset, *, with_pdf: bool = True) -> Iterator[Drawn]:
    """The figures that a study has once."""
    for kind in OF_EXAMPLE:
        drawn = _draw(kind, dataset, kind.name, with_pdf)
        if drawn is not None:
            yield drawn


def _draw(kind: Kind, data: xr.Dataset, stem: str, with_pdf: bool) -> Drawn | None:
    with drawing():
        figure = kind.draw(data)
        if figure is None:
            return None
        as_svg = svg(figure)
        figure.set_layout_engine("none")  # it has its place now; to find it takes as long as to draw
        return Drawn(stem, kind, as_svg, pdf(figure) if with_pdf else None)
