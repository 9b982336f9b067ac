"""`jaxos4 train`: train a network for a flight's inputs, and keep it in a file."""

import time
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ..errors import named
from . import _options as options
from ._output import check_outputs, option_names, stages

# The defaults of `NetworkEstimator`, written out because its import takes seconds; a test compares them.
NOISE, STEPS = (0.1, 10.0), 4000


def train(
    flight: Annotated[Path, Argument(metavar="FLIGHT.csv", help="A flight with the inputs to train for.")],
    out: Annotated[Path, Option(help="The network file to write.")],
    model: options.ModelOption = options.Model["published"],
    airframe: options.AirframeOption = "os4",
    bracket: options.BracketOption = None,
    initial_state: options.InitialStateOption = options.InitialState["free"],
    features: Annotated[options.Features, Option(help="What the network sees.")] = options.Features["score"],
    noise: Annotated[
        tuple[float, float],
        Option(help="Lowest and highest noise to train for, in multiples of the standard sensors' noise."),
    ] = NOISE,
    channels: Annotated[
        options.Channels | None,
        Option(
            help="The channels that the network sees. Default: the rates, and the attitude if a rate was not measured."
        ),
    ] = None,
    steps: Annotated[int, Option(help="Number of training steps.")] = STEPS,
    seed: Annotated[int, Option(help="Random seed for training.")] = 0,
) -> None:
    """Train a network that identifies any flight with the inputs of this one."""
    options.check_seed(seed)
    with stages("loading the library") as progress:
        from ..airframe import load_airframe
        from ..identification.problem import train_network
        from ..models import MODELS
        from ..networks import NetworkEstimator, save_network
        from ..recording import read_recording

        with named("options"):
            settings = NetworkEstimator(features=features.value, noise=noise, steps=steps)
        check_outputs(flight, airframe, bracket, out=out)
        progress("reading")
        subject = MODELS[model](load_airframe(airframe))
        recording = read_recording(flight, subject.airframe)
    for note in recording.notes:
        typer.echo(f"note: {note}")
    begin = time.perf_counter()
    with stages("training the network"), option_names(bracket=bracket):
        network = train_network(
            recording,
            subject,
            settings,
            bracket=options.read_bracket(bracket),
            channels=options.chosen(channels),
            initial_state=str(initial_state.value),
            seed=seed,
        )
    save_network(network, out)
    low, high = noise
    typer.echo(
        f"{out}: {features.value} features of the {network.channels}, noise {low:g} to {high:g} times the standard "
        f"one, {model.value} model, {recording.flight.time.shape[0]} samples, loss "
        f"{network.history[:, 1].min():.4g}, {time.perf_counter() - begin:.0f} s"
    )
