"""`jaxos4 predict`: position, velocity, attitude and body rates of another flight, predicted from many starts."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from . import _options as options
from ._output import DRAWING, check_outputs, import_beside, in_options, option_names, stages, write_json


def predict(
    result: Annotated[Path, Argument(metavar="RESULT.json", help="A vehicle: a file of `jaxos4 estimate --out`.")],
    flight: Annotated[Path, Argument(metavar="LOG", help="The flight to predict.")],
    horizon: Annotated[float, Option(help="How far ahead to predict [s].")] = 0.5,
    sample_time: Annotated[
        float | None, Option(help="The sample time to average to [s]. Default: that of the estimate.")
    ] = None,
    spacing: Annotated[float, Option(help="Time between two starts [s]; 0: from each sample.")] = 0.1,
    seed: Annotated[int, Option(help="Random seed of the 95 % band.")] = 0,
    out: Annotated[Path | None, Option(help="The predictions, as netCDF (.nc) or CSV (.csv).")] = None,
    json: Annotated[Path | None, Option(help="The errors, as JSON.")] = None,
    figure: Annotated[Path | None, Option(help="A figure of the predictions (.svg or .pdf).")] = None,
) -> None:
    """Predict a flight with an identified vehicle, and compare with constant rates and a regression."""
    options.check_seed(seed)
    check_outputs(result, flight, out=out, json=json, figure=figure)
    with stages("loading the library") as progress, option_names():
        from ..forecast import check_suffix, predict as predict_flight, vehicle_of
        from ..recording import read_recording

        if out is not None:
            check_suffix(out, ".nc", ".csv")
        if figure is not None:
            check_suffix(figure, ".svg", ".pdf")
        progress("reading")
        vehicle = vehicle_of(result)
        recording = read_recording(flight, vehicle.model.airframe)
        progress("predicting")
        import_beside(*DRAWING * (figure is not None), netcdf=out is not None and out.suffix == ".nc")
        found = predict_flight(vehicle, recording, horizon=horizon, sample_time=sample_time, spacing=spacing, seed=seed)
        progress("writing")
        if out is not None:
            found.write(out)
        if json is not None:
            write_json(found.to_dict(), json)
        if figure is not None:
            from ..report import write_prediction_figure

            write_prediction_figure(figure, found)
    from rich.console import Console

    from ..report import print_prediction
    from ..results import meaning

    console = Console()
    print_prediction(console, found._replace(notes=tuple(in_options(note) for note in found.notes)))
    for path in filter(None, (out, json, figure)):
        console.print(f"written: {path}", markup=False, highlight=False)
    if vehicle.result != "successful":
        typer.echo(f"jaxos4: {vehicle.result}: {meaning(vehicle.result)}", err=True)
        raise typer.Exit(1)
