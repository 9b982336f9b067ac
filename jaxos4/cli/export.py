"""`jaxos4 export`: an identified vehicle as a model for a simulator."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from .._files import check_writable, write_file
from ..errors import InputError
from . import _options as options
from ._output import check_outputs, option_names, stages, write_folder

MOST_SAMPLES = 100_000


def export(
    result: Annotated[Path, Argument(metavar="RESULT.json", help="A file of `jaxos4 estimate --out`, of a vehicle.")],
    to: Annotated[options.Simulator, Option(help="MuJoCo (MJCF), RotorPy (Python) or SDF (Gazebo).")],
    out: Annotated[Path | None, Option(help="The file to write. Default: standard output.")] = None,
    samples: Annotated[
        int, Option(help="Also draw N vehicles from the covariance, into the folder OUT-samples.", metavar="N")
    ] = 0,
    seed: Annotated[int, Option(help="Random seed of the samples.")] = 0,
) -> None:
    """Write an identified vehicle as a model for a simulator, and vehicles drawn from its uncertainty."""
    if samples > MOST_SAMPLES:
        raise InputError(f"--samples: must be at most {MOST_SAMPLES}, got {samples}.")
    if samples and out is None:
        raise InputError("--samples: are written into a folder beside --out; give that too.")
    check_outputs(result, out=out)
    folder = out.with_name(f"{out.stem}-samples") if samples and out is not None else None
    if folder is not None:
        if folder.exists():
            raise InputError(f"{folder}: exists; remove it, or give the output another name.")
        check_writable(folder)
    with stages("loading the library") as progress, option_names():
        from ..export import TARGETS, export_vehicle, read_result

        progress("reading")
        found, target = read_result(result), TARGETS[to.value]
        progress("drawing and writing")
        written = export_vehicle(found, to.value, samples=samples, seed=seed)
    if folder is not None:
        files = {f"{number:06}{target.suffix}": text for number, text in enumerate(written.samples, start=1)}
        write_folder(files, folder)
        again = f"; {written.impossible} impossible draws were repeated" if written.impossible else ""
        typer.echo(f"{folder}: {samples} vehicles, drawn with seed {seed}{again}")
    if out is None:
        typer.echo(written.text, nl=False)
    else:
        write_file(out, written.text)
        typer.echo(f"{out}: {target.label}")
    for doubt in found.doubts:
        typer.echo(doubt, err=True)
    for note in written.notes:
        typer.echo(f"note: {note}", err=True)
    if not found.successful:
        typer.echo(f"jaxos4: {found.result}: {found.reason}", err=True)
        raise typer.Exit(1)
