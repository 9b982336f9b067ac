"""`jaxos4 export` and `jaxos4 predict`: an identified vehicle as a model for a simulator, and on another flight."""

import contextlib
import errno
import os
import secrets
import shutil
from pathlib import Path

import typer

import jaxos4

from .._files import check_writable, read_json, write_file
from ..errors import InputError
from . import options
from ._shared import check_outputs, command, console, end, json_text, showing_stages, write_json

_MANIFEST = "manifest.json"


def export(
    result: options.Result,
    to: options.Target,
    out: options.ExportOut = None,
    samples: options.Samples = 0,
    inertia_z: options.InertiaZ = None,
    seed: options.Seed = 0,
) -> None:
    """Write an identified vehicle for a simulator.

    With --samples, vehicles that are drawn from its uncertainty instead, to vary them in training or in tests.
    """
    if samples > (most := 100_000):
        raise InputError(f"--samples: must be at most {most}, got {samples}.")
    if samples and out is None:
        raise InputError("--samples: vehicles are written into a folder; give --out too.")
    folder = out if samples > 0 else None
    check_outputs(result, out=out if folder is None else None)
    if folder is not None:
        _check_folder(folder)
    with showing_stages("loading the library") as progress:
        from ..export import TARGETS, export_vehicle, read_result

        target = TARGETS[to]
        if folder is not None and folder.suffix == target.suffix:
            raise InputError(f"--out {out}: with --samples, this is a folder; give a name without {folder.suffix}.")
        progress("reading")
        found = read_result(result, inertia_z=inertia_z)
        progress("drawing and writing")
        written = export_vehicle(found, to, samples=samples, seed=seed)
    if out is None:
        typer.echo(written.text, nl=False)
    elif folder is not None:
        files = (each["file"] for each in written.manifest["vehicles"])
        _write_folder(dict(zip(files, written.samples, strict=True)) | {_MANIFEST: json_text(written.manifest)}, folder)
        again = f"; {written.impossible} draws that no vehicle can have were repeated" if written.impossible else ""
        typer.echo(f"{out}: {samples} vehicles, {target.label}, drawn with seed {seed}{again}")
    else:
        write_file(out, written.text)
        typer.echo(f"{out}: {target.label}")
    for line in (*found.identification.warnings, *(f"note: {note}" for note in written.notes)):
        typer.echo(options.as_typed(line), err=True)
    end(found.identification.result)


def _check_folder(folder: Path) -> list[str]:
    """Refuses a folder to write that cannot be made, or that holds files besides those that its manifest lists.

    Returns the names of the files that it holds.
    """
    if not os.path.lexists(folder):
        check_writable(folder)
        return []
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; give the output another name.")
    if not os.access(folder, os.W_OK):
        raise PermissionError(errno.EACCES, "is not writable", str(folder))
    ours = {_MANIFEST}
    with contextlib.suppress(OSError, InputError, LookupError, TypeError):
        ours |= {each["file"] for each in read_json(folder / _MANIFEST, "")["vehicles"]}
    names = sorted(each.name for each in folder.iterdir())
    complete = _MANIFEST in names and len(ours) > 1
    others = [name for name in names if not complete or name not in ours or not (folder / name).is_file()]
    if others:
        raise InputError(
            f"{folder}: holds {others[0]}, which no manifest there lists; give another folder, or empty it."
        )
    return names


def _write_folder(texts: dict[str, str], folder: Path) -> None:
    """Writes text files, by name; the last is the manifest. A new folder appears when all files are in it.

    In a folder that `_check_folder` allows, new files replace those of the manifest, which is gone until all are there.
    """
    old, exists = _check_folder(folder), folder.exists()
    beside = (folder if exists else folder.parent) / f".{folder.name[:40]}.{secrets.token_hex(4)}.part"
    try:
        beside.mkdir()
        for name, text in texts.items():
            (beside / name).write_text(text, encoding="utf-8")
        if exists:
            for name in sorted(old, key=lambda name: name != _MANIFEST):
                (folder / name).unlink()
            for name in texts:
                (beside / name).rename(folder / name)
        else:
            beside.rename(folder)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def predict(
    result: options.Result,
    flight: options.Log,
    columns: options.Columns = None,
    horizon: options.Horizon = 0.5,
    sample_time: options.AveragedTo = None,
    spacing: options.Spacing = 0.1,
    seed: options.Seed = 0,
    out: options.Predictions = None,
    json: options.Json = None,
    figure: options.Figure = None,
    report: options.Page = None,
) -> None:
    """Predict another flight with an identified vehicle.

    Compares the errors with those of constant rates and of a regression.
    """
    check_outputs(result, flight, columns, out=out, json=json, figure=figure, report=report)
    with showing_stages("loading the library") as progress:
        from ..recording import read_recording

        if out is not None:
            jaxos4.forecast.check_suffix(out, ".nc", ".csv")
        progress("reading")
        vehicle = jaxos4.forecast.vehicle_of(result)
        recording = read_recording(flight, vehicle.model.airframe, columns=columns)
        progress("predicting")
        found = jaxos4.predict(vehicle, recording, horizon=horizon, sample_time=sample_time, spacing=spacing, seed=seed)
        progress("writing")
        if out is not None:
            found.write(out)
        if json is not None:
            write_json(found.to_dict(), json)
        if figure is not None:
            jaxos4.report.write_prediction_figure(figure, found)
        if report is not None:
            jaxos4.report.write_prediction(report, found, command=command())
    shown = console()
    jaxos4.report.print_prediction(shown, found)
    for path in filter(None, (out, json, figure, report)):
        shown.print(f"written: {path}")
    end(vehicle.result)
