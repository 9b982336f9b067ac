"""A race: each contender is a process of its own, is checked, and is then timed in turns with the others."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmarks.case import Case
from experiments.benchmarks.contenders import Contender

ROOT = Path(__file__).resolve().parents[2]


class Racer:
    """The process of one contender: it has prepared itself and run once.

    **Raises:** `RuntimeError` with the last line that the process said, if it fails.
    """

    def __init__(self, contender: Contender, case: Path, flights: int):
        self.contender, self.flights = contender, flights
        self.laps: list[dict[str, float]] = []
        self._errors = tempfile.TemporaryFile("w+")
        arguments = [contender.entry, str(case), str(flights), json.dumps(contender.options)]
        command = [sys.executable, "-m", "experiments.benchmarks.worker", *arguments]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command,
            stdin=pipe,
            stdout=pipe,
            stderr=self._errors,
            text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))},
            cwd=case.parent,  # some libraries write logs where they run
        )
        ready = self._read()
        self.setup, self.peak = ready["setup_seconds"], ready["peak_mib"]
        self.answer: dict[str, Any] = {name: np.asarray(value) for name, value in ready["answer"].items()}

    def lap(self) -> None:
        """Runs once more, and notes the time."""
        print(file=self._process.stdin, flush=True)
        self.laps.append(self._read())
        self.peak = self.laps[-1]["peak_mib"]

    def stop(self) -> None:
        """Ends the process."""
        with self._errors, self._process:  # closes their pipes, and waits
            pass

    def row(self) -> dict[str, Any]:
        """Times of one flight, and memory. The times of all laps are in order, for ratios lap by lap."""
        laps = np.array([lap["seconds"] for lap in self.laps]) / self.flights
        return {
            "flights": self.flights,
            "setup_seconds": self.setup,
            "laps": laps.tolist(),
            "median_seconds": float(np.median(laps)),
            "min_seconds": float(laps.min()),
            "max_seconds": float(laps.max()),
            "processor_seconds": float(np.median([lap["processor_seconds"] for lap in self.laps])) / self.flights,
            "peak_mib": self.peak,
        }

    def _read(self) -> dict[str, Any]:
        line = self._process.stdout.readline() if self._process.stdout else ""
        if line:
            return json.loads(line)
        self._process.wait()
        self._errors.seek(0)
        said = self._errors.read().strip().splitlines() or [f"exit code {self._process.returncode}"]
        self.stop()
        raise RuntimeError(said[-1])


def line_up(contenders: dict[str, Contender], case: Case, alone: int, skipped: list[str]) -> dict[str, Racer]:
    """The racers that can take part, prepared one after another. `skipped` gets a line for each of the others."""
    racers = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "case.npz"
        case.save(path)
        for name, contender in contenders.items():
            if contender.missing:
                skipped.append(f"{name}: {contender.missing}")
                continue
            try:
                racers[name] = Racer(contender, path, min(alone, case.flights) if contender.alone else case.flights)
            except RuntimeError as error:
                skipped.append(f"{name}: failed: {error}")
    return racers


def race(racers: dict[str, Racer], repeats: int) -> dict[str, dict[str, Any]]:
    """Times all racers in turns, so that each lap sees the same load of the machine, and ends them."""
    for _ in range(repeats):
        for racer in racers.values():
            racer.lap()
    for racer in racers.values():
        racer.stop()
    return {name: racer.row() for name, racer in racers.items()}


def ratios(rows: dict[str, dict[str, Any]], contenders: dict[str, Contender]) -> None:
    """Adds how many times as fast as each of its rivals each one is: median, smallest and largest of all laps."""
    for name, row in rows.items():
        row["ratios"] = {}
        for rival in contenders[name].rivals:
            if "laps" in row and "laps" in rows.get(rival, {}):
                ratio = np.array(rows[rival]["laps"]) / np.array(row["laps"])
                row["ratios"][rival] = [float(np.median(ratio)), float(ratio.min()), float(ratio.max())]
