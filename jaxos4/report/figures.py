"""All figures of a study: their names, captions, and the variables of the Dataset that they show."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import xarray as xr
from matplotlib.figure import Figure

from . import figures_example, figures_noise, figures_spread
from .scenario import Scenario
from .style import drawing, pdf, svg


class Kind(NamedTuple):
    """A figure that a study can have.

    - `draw`: returns nothing if the data are absent.
    - `of_scale`: it shows one noise scale: the files the one nearest 1, the page the one that the reader chooses. Then
      `draw` also takes the figure of another scale, and draws into it.
    """

    name: str
    title: str
    caption: str
    source: str
    draw: Callable[..., Figure | None]
    of_scale: bool = False


class Drawn(NamedTuple):
    """A figure of one study as the bytes of its two files.

    - `choices`: the figures among which the page lets the reader choose, by label; `svg` is one of them.
    """

    stem: str
    kind: Kind
    svg: bytes
    pdf: bytes | None
    choices: dict[str, bytes]


OF_SCENARIOS = (
    Kind(
        "error",
        "Error against noise",
        "Root-mean-square error over the converged flights, with the Cramer-Rao bound of the channels used.",
        "estimate, truth, bound, seen, result",
        figures_noise.errors,
    ),
    Kind(
        "efficiency",
        "Efficiency against noise",
        "RMSE / bound, each estimator relative to its own bound, with 95 % Monte-Carlo intervals. 1 is the best that "
        "an unbiased estimator can do.",
        "estimate, truth, bound, result",
        figures_noise.efficiency,
    ),
    Kind(
        "distribution",
        "Distribution of the errors",
        "Error / bound: median, quartiles, and 95 % of the flights. The line of an efficient estimator reaches from "
        "one dashed line to the other. The file shows the noise scale nearest 1.",
        "estimate, truth, bound, result",
        figures_spread.distribution,
        of_scale=True,
    ),
    Kind(
        "rollouts",
        "Accuracy against rollouts",
        "RMSE / least bound of any estimator (geometric mean over the parameters) against simulated flights.",
        "estimate, truth, bound, rollouts, result",
        figures_spread.rollouts,
    ),
    Kind(
        "coverage",
        "Coverage by level",
        "Share of intervals that hold the truth, averaged over the parameters, with 95 % Monte-Carlo intervals. Long "
        "lines: the level that the intervals claim.",
        "estimate, truth, half_width, result",
        figures_spread.coverage,
    ),
    Kind(
        "frontier",
        "The noise below which a parameter can be distinguished from 0",
        "Below its noise scale, a parameter is larger than 1.96 Cramer-Rao bounds. Above it, no estimator can "
        "distinguish the parameter from 0.",
        "truth, bound, seen",
        figures_noise.frontier,
    ),
)
"""The figures of each scenario."""

OF_EXAMPLE = (
    Kind(
        "trajectories",
        "Measured and simulated",
        "Dots: measured. Black, or white on a dark page: true. Coloured: simulated with each estimate.",
        "example_measured, example_true, example_simulated",
        figures_example.trajectories,
    ),
    Kind(
        "deviations",
        "Simulated minus true",
        "Deviation of each simulation from the truth, on the same flight.",
        "example_simulated, example_true",
        figures_example.deviations,
    ),
    Kind(
        "path",
        "The path in space",
        "Dots: measured. Black, or white on a dark page: true. Coloured: simulated with each estimate.",
        "example_measured, example_true, example_simulated",
        figures_example.path,
    ),
    Kind(
        "search",
        "The search of IBSS",
        "Half-widths and centres of the brackets after each sweep, on the example flight.",
        "search_half_width, search_estimate",
        figures_example.search,
    ),
    Kind(
        "training",
        "Training",
        "Loss of the networks during training.",
        "training_loss, validation_loss, training_step",
        figures_example.training,
    ),
)
"""The figures of the study's one example flight and of its networks."""


def of_scenario(scenario: Scenario, *, numbered: bool, with_pdf: bool = True) -> Iterator[Drawn]:
    """The figures of one scenario. `numbered`: file names hold the number of the scenario."""
    for kind in OF_SCENARIOS:
        stem = f"{kind.name}-{scenario.number}" if numbered else kind.name
        yield from _draw(kind, scenario.data, stem, with_pdf)


def of_example(dataset: xr.Dataset, *, with_pdf: bool = True) -> Iterator[Drawn]:
    """The figures that do not belong to a scenario."""
    for kind in OF_EXAMPLE:
        yield from _draw(kind, dataset, kind.name, with_pdf)


def _draw(kind: Kind, data: xr.Dataset, stem: str, with_pdf: bool) -> Iterator[Drawn]:
    with drawing():
        figure = kind.draw(data)
        if figure is None:
            return
        as_svg, as_pdf = svg(figure), pdf(figure) if with_pdf else None
        choices = _of_each_scale(kind, data, figure, as_svg) if kind.of_scale else {"": as_svg}
    yield Drawn(stem, kind, as_svg, as_pdf, choices)


def _of_each_scale(kind: Kind, data: xr.Dataset, figure: Figure, nearest: bytes) -> dict[str, bytes]:
    """The figure of each noise scale. `figure`: of the scale nearest 1, and `nearest`, its bytes."""
    choices = {}
    for place, scale in enumerate(data["scale"].values):
        label = f"noise x {scale:g}"
        if place == figures_spread.nearest_scale(data):
            choices[label] = nearest
        elif kind.draw(data.isel(scale=[place]), figure) is not None:
            choices[label] = svg(figure)
    return choices
