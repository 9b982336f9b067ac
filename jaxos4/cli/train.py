"""`jaxos4 train`: a network for a flight's inputs, kept in a file."""

import dataclasses
import time
from pathlib import Path
from typing import Annotated

import typer

from ..airframe import load_airframe
from ..bracket import Bracket
from ..dynamics import MODELS
from ..errors import InputError
from ..estimators import NetworkEstimator, save_network
from ..logs import read_flight_and_notes
from ._bracket_file import load_bracket
from ._check_output import check_output
from ._choices import Approximator, Channels, Features, InitialState, Model
from .estimate import fit_network, problem_of, seen_channels


def train(
    flight: Annotated[Path, typer.Argument(metavar="FLIGHT.csv", help="A flight with the inputs to train for.")],
    out: Annotated[Path, typer.Option(help="The network file to write.")],
    model: Annotated[Model, typer.Option(help="The equations: as printed, or corrected.")] = Model["published"],
    airframe: Annotated[str, typer.Option(help="os4, os4-simulator, voos, or a TOML file.")] = "os4",
    bracket: Annotated[Path | None, typer.Option(help="TOML file: alpha1 = \\[lower, upper], ...")] = None,
    initial_state: Annotated[
        InitialState, typer.Option(help="free: estimated too; known: the first sample is exact.")
    ] = InitialState["free"],
    features: Annotated[Features, typer.Option(help="What the network sees.")] = Features["score"],
    approximator: Annotated[Approximator, typer.Option(help="What it is made of.")] = Approximator["mlp"],
    noise: Annotated[
        tuple[float, float], typer.Option(help="Least and largest noise, in multiples of the standard one.")
    ] = NetworkEstimator.noise,
    channels: Annotated[
        Channels | None, typer.Option(help="What it looks at; the rates without it, or the attitude without rates.")
    ] = None,
    steps: Annotated[int, typer.Option(help="Length of the training.")] = NetworkEstimator.steps,
    seed: Annotated[int, typer.Option(help="Of the training.")] = 0,
) -> None:
    """Train a network for a flight's inputs, to identify any flight of the same inputs at once."""
    if not 0 <= seed < 2**63:
        raise InputError(f"--seed: must lie in 0 to 2^63 - 1, got {seed}.")
    try:
        settings = NetworkEstimator(features=features.value, approximator=approximator.value, noise=noise, steps=steps)
    except ValueError as error:
        raise InputError(f"options: {error}") from None
    check_output(out, flight, Path(airframe), bracket)
    vehicle = MODELS[model](load_airframe(airframe))
    where = Bracket.default(vehicle) if bracket is None else load_bracket(bracket, vehicle)
    recorded, notes = read_flight_and_notes(flight, vehicle.airframe)
    for note in notes:
        typer.echo(f"note: {note}")
    problem = problem_of(flight, vehicle, recorded, channels, known=initial_state == "known")
    seen = seen_channels(problem) if channels is None else channels.value
    training = dataclasses.replace(settings, channels=seen)
    begin = time.perf_counter()
    network = fit_network(training, flight, problem, where, seed=seed)
    save_network(network, out)
    low, high = training.noise
    typer.echo(
        f"{out}: {features.value} features of the {seen}, noise {low:g} to {high:g} times the standard one, "
        f"{model.value} model, {recorded.time.shape[0]} samples, loss {network.history[:, 1].min():.4g}, "
        f"{time.perf_counter() - begin:.0f} s"
    )
