"""Kills a study again and again and resumes it: are the results those of an uninterrupted run?

    python -m experiments resilience.run SPEC.toml --out FOLDER

Writes FOLDER/whole, an uninterrupted run; FOLDER/killed, killed ten times; and FOLDER/report.json.
"""

import importlib.metadata
import json
import os
import platform
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import typer
import xarray as xr

from jaxos4.study import load_study
from jaxos4.study.dataset import RESULTS_FILE

COMMAND = "from jaxos4.cli import main; main()"


def main(
    specification: Annotated[Path, typer.Argument(help="Specification of a study with some hundred cells.")],
    out: Annotated[Path, typer.Option(help="Folder for both runs and the report.")],
    kills: Annotated[int, typer.Option(help="Number of kills.", min=1)] = 10,
    seed: Annotated[int, typer.Option(help="Random seed for the moments of the kills.")] = 0,
) -> None:
    """Kill a study at random moments until it was killed often enough; finish it; compare."""
    out.mkdir(parents=True)
    # Compiled programs are kept, so that a resumed run soon reaches its cells.
    environment = {
        "JAX_COMPILATION_CACHE_DIR": str(out / "programs"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    count = load_study(specification).count
    begin = time.perf_counter()
    _run(specification, out / "whole", environment)
    seconds = time.perf_counter() - begin
    moments, rows = random.Random(seed), []
    while len(rows) < kills:
        before, begin = _finished(out / "killed"), time.perf_counter()
        process = _start(specification, out / "killed", environment)
        # Every second kill comes at any moment of a run, the others after some more cells.
        end = time.perf_counter() + moments.uniform(0, seconds if len(rows) % 2 else 3600)
        more = moments.uniform(0, 2 * (count - before) / (kills + 1 - len(rows)))
        while process.poll() is None and time.perf_counter() < end and _finished(out / "killed") < before + more:
            time.sleep(0.002)
        process.kill()
        process.wait()
        if process.returncode != -signal.SIGKILL:
            raise SystemExit(f"{specification}: the study ended after {len(rows)} kills; give a longer one.")
        after, lasted = _finished(out / "killed"), round(time.perf_counter() - begin, 3)
        rows.append({"seconds": lasted, "before": before, "after": after})
        typer.echo(f"kill {len(rows)}: {after} of {count} cells")
    before = _written(out / "killed")
    _run(specification, out / "killed", environment)
    report = {
        "identical": _results(out / "whole").identical(_results(out / "killed")),
        "identical_files": all(_bytes(out / "whole", f) == _bytes(out / "killed", f) for f in ("cells", "networks")),
        "cells": count,
        "computed_twice": sum(_written(out / "killed")[name] != time for name, time in before.items()),
        "kills": rows,
        "provenance": {
            "specification": specification.read_text(),
            "seed": seed,
            "jaxos4": importlib.metadata.version("jaxos4"),
            "jax": importlib.metadata.version("jax"),
            "machine": platform.machine(),
        },
    }
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    typer.echo(json.dumps({name: value for name, value in report.items() if name not in ("kills", "provenance")}))
    if not (report["identical"] and report["identical_files"]) or report["computed_twice"]:
        raise SystemExit(1)


def _start(specification: Path, folder: Path, environment: dict[str, str]) -> subprocess.Popen:
    command = [sys.executable, "-c", COMMAND, "study", str(specification), "--out", str(folder)]
    return subprocess.Popen(command, env=os.environ | environment)


def _run(specification: Path, folder: Path, environment: dict[str, str]) -> None:
    code = _start(specification, folder, environment).wait()
    if code != 0:
        raise SystemExit(f"{folder}: the study ended with exit code {code}.")


def _finished(folder: Path) -> int:
    return len(list(folder.glob("cells/[0-9]*.npz")))


def _written(folder: Path) -> dict[str, int]:
    """When each finished cell was written."""
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("cells/[0-9]*.npz")}


def _bytes(folder: Path, kind: str) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / kind).iterdir()}


def _results(folder: Path) -> xr.Dataset:
    with xr.open_dataset(folder / RESULTS_FILE) as dataset:
        return dataset.load()
