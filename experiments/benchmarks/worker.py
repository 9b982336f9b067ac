"""One contender in a process of its own: `python -m experiments.benchmarks.worker CONTENDER CASE.npz ...`.

It prepares itself, runs once, and then once more for each line on its standard input. It answers with one line of JSON
each time. A process of its own has its own peak memory, and no library disturbs another.
"""

import contextlib
import importlib
import json
import os
import resource
import sys
import time
from pathlib import Path

import numpy as np

from experiments.benchmarks.case import Case


def peak_mib() -> float:
    """The peak memory of this process [MiB]."""
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    # `ru_maxrss` begins with the memory of the parent on Linux.
    (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def serve(contender: str, path: str, flights: str, options: str = "{}") -> None:
    """Answer lines of standard input with the time of a run. The arguments are those of the command line."""
    # Libraries print: only our answers go to the real standard output.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    begin = time.perf_counter()
    module, _, function = contender.partition(":")
    make = getattr(importlib.import_module(f"experiments.benchmarks.opponents.{module}"), function)
    run = make(Case.load(Path(path)).first(int(flights)), **json.loads(options))
    answer = run()
    setup = time.perf_counter() - begin

    def say(**what) -> None:
        what["peak_mib"] = peak_mib()
        answers.write(json.dumps(what) + "\n")
        answers.flush()

    say(setup_seconds=setup, answer={name: np.asarray(value).tolist() for name, value in answer.items()})
    for _ in sys.stdin:
        begin, processor = time.perf_counter(), time.process_time()
        elsewhere = run().get("elsewhere", 0.0)  # processor time of other processes of the contender
        seconds, processor = time.perf_counter() - begin, time.process_time() - processor
        say(seconds=seconds, processor_seconds=processor + elsewhere)


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        serve(*sys.argv[1:])
