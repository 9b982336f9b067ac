"""How long do whole commands take, with an empty cache of compiled programs, and once more?

Each command runs in a process of its own, as a user runs it. `import jax` shows how fast the machine is. `--flights`
adds a log of a real vehicle.
"""

import os
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from experiments.monte_carlo import print_table
from experiments.shared import Flights, flight_files

REAL = "arpl_crazyflie_rollpitch.csv"
PREPARED = {
    "flight.csv": "simulate --out flight.csv",
    "log.csv": "simulate --closed-loop --airframe crazyflie --out log.csv",
}
COMMANDS = (
    "--help",
    "estimate flight.csv",
    "identifiability flight.csv",
    "train flight.csv --out flight.net",
    "estimate flight.csv --estimator hybrid --network flight.net",
    "estimate log.csv --airframe crazyflie --report page.html",
    "inspect log.csv",
    "compare --quick",
    "compare",
    "design --out speeds.csv",
    "design --closed-loop --airframe crazyflie --out references.csv",
)


def seconds_of(arguments: str, folder: Path, cache: Path) -> float:
    """The wall time of `python ARGUMENTS`. Ends the script if it fails by an exception or a user's mistake."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)}
    begin = time.perf_counter()
    ended = subprocess.run(
        [sys.executable, *shlex.split(arguments)],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if ended.returncode > ("jaxos4" in arguments):  # whose code 1 is a verdict
        raise SystemExit(f"python {arguments}: {ended.stderr}")
    return time.perf_counter() - begin


def main(repeats: int = 3, commands: list[str] = COMMANDS, flights: Flights = None) -> None:
    """Time commands in processes of their own.

    - `repeats`: Number of runs once more. `commands`: The commands.
    """
    real = flight_files(flights, [REAL])[0] if flights or os.environ.get("JAXOS4_FLIGHTS") else None
    chosen = [*commands, *([f"estimate {REAL} --airframe crazyflie --report real.html"] if real else [])]

    def rows(folder: Path) -> Iterator[tuple[str, ...]]:
        if real is not None:
            (folder / REAL).symlink_to(real.resolve())
        for name, command in PREPARED.items():
            if any(name in each.split() for each in chosen):
                seconds_of(f"-m jaxos4 {command}", folder, folder / "prepared")
        timed = {"import jax": "-c 'import jax'"} | {f"jaxos4 {each}": f"-m jaxos4 {each}" for each in chosen}
        for number, (name, arguments) in enumerate(timed.items()):
            cache = folder / f"cache{number}"
            cold = seconds_of(arguments, folder, cache)
            again = [seconds_of(arguments, folder, cache) for _ in range(repeats)]
            spread = f"{statistics.median(again):.1f} ({min(again):.1f} to {max(again):.1f})"
            yield name, f"{cold:.1f}", spread

    with tempfile.TemporaryDirectory() as folder:
        headings = "command", "cold [s]", "again [s]"
        print_table(f"times of commands, median of {repeats} (least to most)", headings, rows(Path(folder)), width=140)
