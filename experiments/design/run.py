"""What does a designed input gain, and do estimates reach the bounds that the design promises?

For each model and each choice of channels: an input of 5 s is designed within the envelope of the standard multisine,
for all vehicles of the default bracket and for the airframe's vehicle alone. Its bounds are compared with those of the
standard inputs. Then IBSS identifies simulated flights of the designed input. The initial state is known.
"""

import itertools
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, continued, fill, in_words, print_table
from experiments.shared import DT, fit_noisy, scores, standard_problem
from jaxos4.design import Design
from jaxos4.design.rotor_speeds import drawn, fly_finely
from jaxos4.models import MODELS

# Widths of the bracket, in multiples of the default: that of all vehicles, and almost none.
WIDTHS = {"default": 1.0, "airframe": 1e-3}
# In the default bracket of this model some vehicles turn over in the standard multisine.
ONLY_AIRFRAME = ("corrected",)


def designed(model: jaxos4.AbstractModel, channels: str, width: float, duration: float, seed: int) -> Design:
    """The input, and the standard inputs in the same envelope."""
    return jaxos4.design_input(
        model,
        bracket=jaxos4.Bracket.around(model.alpha, width * np.asarray(model.half_width)),
        duration=duration,
        dt=DT,
        channels=channels,
        start_is_known=True,
        compare=True,
        key=seed,
    )


def excess(model: jaxos4.AbstractModel, found: Design, width: float, seed: int) -> float:
    """The largest share of a limit that other vehicles from the bracket use, at a tenth of the step."""
    bracket = jaxos4.Bracket.around(model.alpha, width * np.asarray(model.half_width))
    others = drawn(bracket, jax.random.key(seed + 1000), found.task.vehicles)
    states = fly_finely(model, others, jnp.asarray(found.designed.inputs), jnp.asarray(DT))
    return max(found.task.envelope.shares(found.designed.inputs, states, DT).values())


def efficiency(model: jaxos4.AbstractModel, found: Design, channels: str, flights: int, seed: int) -> Row:
    """RMSE / bound of each parameter over simulated flights, by IBSS."""
    problem = standard_problem(model, channels, omega=jnp.asarray(found.designed.inputs))
    row = scores(problem, fit_noisy(jaxos4.IBSS(), problem, flights, seed)[0])
    return {name: row[name] for name in ("efficiency", "results", "flights")}


def main(
    models: Annotated[list[str], typer.Option(help="Names of the models.")] = ("published", "corrected"),
    channels: Annotated[list[str], typer.Option(help="Choices of channels.")] = ("all", "rates"),
    widths: Annotated[list[str], typer.Option(help="Names of the brackets.")] = tuple(WIDTHS),
    flights: Annotated[int, typer.Option(help="Number of flights of each designed input.")] = 256,
    duration: Annotated[float, typer.Option(help="Length of a flight [s].")] = 5.0,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Measure what designed inputs gain."""

    def row_of(model: str, channels: str, vehicles: str) -> Row:
        subject, width = MODELS[model](jaxos4.OS4), WIDTHS[vehicles]
        found = designed(subject, channels, width, duration, seed)
        return {
            "gains": {key: found.gain(key) for key in found.standard},
            "bounds": found.designed.bounds.tolist(),
            "uses": found.designed.uses,
            "others": excess(subject, found, width, seed),
            **efficiency(subject, found, channels, flights, seed),
        }

    report = continued(out, {"seed": seed, "duration": duration}, "cases")
    trials = (
        {"model": name, "channels": some, "vehicles": vehicles}
        for name, some, vehicles in itertools.product(models, channels, widths)
        if vehicles == "airframe" or name not in ONLY_AIRFRAME
    )
    fill(out, report, report["cases"], trials, row_of)
    cells = (
        (
            *(case["model"], case["channels"], case["vehicles"]),
            *("{:.3g} ({})".format(*case["gains"][name]) for name in ("multisine", "doublet")),
            f"{case['others']:.3f}",
            f"{min(case['efficiency']):.2f} to {max(case['efficiency']):.2f}",
            in_words(case["results"]),
        )
        for case in report["cases"]
    )
    headings = "model", "channels", "vehicles", "/ multisine", "/ doublet", "largest use", "RMSE / bound", "results"
    print_table(f"geometric mean of the bounds, of {duration:g} s", headings, cells, width=140)
