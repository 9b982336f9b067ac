"""`jaxos4 train`: a network for a flight's inputs, kept in a file."""

import dataclasses
import time
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from ..networks import NetworkEstimator, save_network
from ._check_output import check_output
from ._choices import (
    AirframeOption,
    Approximator,
    BracketOption,
    Channels,
    Features,
    InitialState,
    InitialStateOption,
    Model,
    ModelOption,
)
from ._fitting import fit_network, load_job, seen_channels


def train(
    flight: Annotated[Path, typer.Argument(metavar="FLIGHT.csv", help="A flight with the inputs to train for.")],
    out: Annotated[Path, typer.Option(help="The network file to write.")],
    model: ModelOption = Model["published"],
    airframe: AirframeOption = "os4",
    bracket: BracketOption = None,
    initial_state: InitialStateOption = InitialState["free"],
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
    problem, where, notes = load_job(flight, model, airframe, bracket, channels, initial_state)
    for note in notes:
        typer.echo(f"note: {note}")
    seen = seen_channels(problem) if channels is None else channels.value
    training = dataclasses.replace(settings, channels=seen)
    begin = time.perf_counter()
    network = fit_network(training, flight, problem, where, seed=seed)
    save_network(network, out)
    low, high = training.noise
    typer.echo(
        f"{out}: {features.value} features of the {seen}, noise {low:g} to {high:g} times the standard one, "
        f"{model.value} model, {problem.flight.time.shape[0]} samples, loss {network.history[:, 1].min():.4g}, "
        f"{time.perf_counter() - begin:.0f} s"
    )
