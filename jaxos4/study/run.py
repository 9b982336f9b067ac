"""Runs a study on the devices of this process, from its specification to its Dataset."""

import concurrent.futures
import contextlib
import ctypes
import itertools
import os
import time
from collections import defaultdict, deque
from collections.abc import Callable, Container, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr

from ..errors import InputError, TrainingError
from ..networks import TrainedNetwork, encode_network
from .cell import encode, programs_of, run_cell, train_network
from .dataset import assemble, save_dataset
from .specification import Cell, Job, Study
from .store import Store, check_store, open_store

# Exceptions of a cell that cannot be computed: the cell is kept as failed, with the message, and the study goes on.
FAILURES = (TrainingError, InputError, ValueError, ArithmeticError, RuntimeError)
# A device joins the program of another device if at least this number of cells waits: it must compile the program too.
_WORTH_COMPILING = 8


class Step(NamedTuple):
    """`done` cells are finished; `label` names the running tasks."""

    done: int
    label: str


class Plan(NamedTuple):
    """The remaining work of an estimator.

    - `programs`, `networks`: how many are to be compiled, and to be trained.
    - `seconds`: for the cells on this process's devices, without the training of networks, from the mean time of this
      estimator's finished cells; `None` if none is finished.
    """

    estimator: str
    cells: int
    flights: int
    programs: int
    networks: int
    seconds: float | None


def use_all_cores() -> None:
    """Makes each core of this process a device, so that cells run side by side. Call it before any computation.

    `JAX_NUM_CPU_DEVICES` overrides the number of devices.
    """
    if os.environ.get("JAX_NUM_CPU_DEVICES"):
        return
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jax.config.update("jax_num_cpu_devices", cores)  # noqa: TID251  # only entry points call this


def device_name() -> str:
    """The devices of this process, in words."""
    devices = jax.local_devices()
    return f"{len(devices)} x {devices[0].device_kind}"


def plan(study: Study, directory: Path) -> list[Plan]:
    """A row for each estimator. Programs and networks count for the first estimator that needs them.

    Raises `InputError` as `open_store`.
    """
    store, seconds, rows = check_store(directory, study), defaultdict(list), []
    for entry in store.read_log():
        if "cell" in entry:
            seconds[study.cell(entry["cell"]).scenario.estimator].append(entry["seconds"])
    remaining = [study.cell(index) for index in store.missing()]
    trained = {job for job, number in study.jobs().items() if store.network_file(number).exists()}
    compiled: set[tuple] = set()
    for estimator in study.estimators:
        cells = [cell for cell in remaining if cell.scenario.estimator == estimator]
        flights = sum(min(study.batch, study.flights - cell.first) for cell in cells)
        programs = {program for cell in cells for program in programs_of(study, cell.scenario)} - compiled
        networks = {job for cell in cells if (job := study.job(cell.scenario))} - trained
        compiled |= programs
        trained |= networks
        times = seconds[estimator]
        expected = sum(times) / len(times) * len(cells) / len(jax.local_devices()) if times else None
        rows.append(Plan(estimator, len(cells), flights, len(programs), len(networks), expected))
    return rows


class _Program:
    """A program: the devices that run it, and the waiting cells that end with it."""

    def __init__(self) -> None:
        self.devices: set[Any] = set()
        self.waiting: deque[Cell] = deque()


def run_here(store: Store) -> Iterator[Step]:
    """Computes the remaining cells, each on one device: a divided program gives other last digits.

    A cell that cannot be computed is kept as failed; delete its file to try it again.
    """
    study, cells = store.study, [store.study.cell(index) for index in store.missing()]
    done, programs = study.count - len(cells), defaultdict(_Program)
    # Cells of IBSS first: those of the hybrid, which end with the same program, wait for a network.
    for cell in sorted(cells, key=lambda cell: study.job(cell.scenario) is not None):
        programs[programs_of(study, cell.scenario)[-1]].waiting.append(cell)
    untrained = deque(dict.fromkeys(job for cell in cells if (job := study.job(cell.scenario)) is not None))
    # A cell without a network never waits for one.
    networks: dict[Job | None, TrainedNetwork | str | None] = {None: None}
    free = deque(jax.local_devices())
    running: dict[concurrent.futures.Future, tuple[Any, Job | Cell]] = {}
    pool = concurrent.futures.ThreadPoolExecutor(len(free))
    try:
        while True:
            for device in tuple(free):
                if untrained:
                    task = untrained.popleft()
                    future = pool.submit(_train, store, task, device)
                elif task := _next_cell(study, list(programs.values()), networks, device):
                    future = pool.submit(_compute_on, device, study, task, networks[study.job(task.scenario)])
                else:  # all remaining cells wait for networks
                    continue
                free.remove(device)
                running[future] = device, task
            yield Step(done, ", ".join(dict.fromkeys(label_of(study, task) for _, task in running.values())))
            if not running:
                return
            finished, _ = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            for future in finished:
                device, task = running.pop(future)
                free.append(device)
                _give_memory_back()
                if isinstance(task, Job):
                    networks[task] = future.result()
                else:
                    store.write_cell(task.number, *future.result())
                    done += 1
    finally:
        # An interrupt does not wait for running tasks, which may last minutes; their results are lost.
        pool.shutdown(wait=False, cancel_futures=True)


def _next_cell(study: Study, programs: list[_Program], networks: Container[Job | None], device: Any) -> Cell | None:
    """A cell of the program that the device runs already, else of one that no device runs, else of the longest."""
    ready = [p for p in programs if p.waiting and study.job(p.waiting[0].scenario) in networks]
    own = [p for p in ready if device in p.devices]
    new = [p for p in ready if not p.devices]
    long = [p for p in ready if len(p.waiting) >= _WORTH_COMPILING]
    program = next(iter(own or new), None) or max(long, key=lambda p: len(p.waiting), default=None)
    if program is None:
        return None
    program.devices.add(device)
    return program.waiting.popleft()


def _compute_on(device: Any, study: Study, cell: Cell, network: TrainedNetwork | str | None) -> tuple[bytes, float]:
    with jax.default_device(device):
        return compute(study, cell, network)


def _give_memory_back() -> None:
    """Returns the compiler's freed memory to the system; the C library keeps half a gigabyte of a large program."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # not every C library can
        ctypes.CDLL(None).malloc_trim(0)


def _train(store: Store, job: Job, device: Any) -> TrainedNetwork | str | None:
    """The network, read from its file as in a resumed run; or a message that says why there is none."""
    begin, number = time.perf_counter(), store.study.jobs()[job]
    with jax.default_device(device):
        if (network := store.read_network(number)) is not None:
            return network
        data = train(store.study, job)
        if isinstance(data, str):
            return data
        store.write_network(number, data, seconds=round(time.perf_counter() - begin, 3))
        return store.read_network(number)


def train(study: Study, job: Job) -> bytes | str:
    """The bytes of a network's file, or a message that says why there is none."""
    try:
        with jax.enable_x64(study.double):
            return encode_network(train_network(study, job))
    except FAILURES as error:
        return str(error)


def compute(study: Study, cell: Cell, network: TrainedNetwork | str | None) -> tuple[bytes, float]:
    """The bytes of a cell's file, and the seconds of its computation. `network` is a message if there is none."""
    begin = time.perf_counter()
    try:
        if isinstance(network, str):
            raise TrainingError(network)
        results = run_cell(study, cell, network)
    except FAILURES as error:
        if "RESOURCE_EXHAUSTED" in str(error):  # the machine's failure, not the cell's
            raise InputError(
                "out of memory: free some and run the study again, or start another study with a smaller `batch`."
            ) from None
        results = {"failed": np.asarray(" ".join(str(error).split())[:500])}
    return encode(results), round(time.perf_counter() - begin, 3)


def label_of(study: Study, task: Job | Cell) -> str:
    """The name of a task: for a cell its estimator, and its values on the axes that have more than one."""
    if isinstance(task, Job):
        return f"training for {task.channels}"
    *shared, estimator = (f"{value:g}" if isinstance(value, float) else str(value) for value in task.scenario)
    return " ".join([estimator, *itertools.compress(shared, (length > 1 for length in study.shape))])


def carry_out(
    study: Study,
    out: Path,
    device: str,
    *,
    run: Callable[[Store], Iterator[Step]] = run_here,
    progress: Callable[[Step], None] = lambda step: None,
) -> xr.Dataset:
    """Runs the missing cells of a study and writes its Dataset.

    **Arguments:**

    - `out`: the study's folder; a new one, or one that the same study wrote.
    - `device`: what computes, in words, for the provenance.
    - `run`: `run_here`, or `run_on_cluster` with its client.
    - `progress`: is called after each step.

    **Raises:** what `open_store` and `run` raise.
    """
    with open_store(out, study, device) as store:
        for step in run(store):
            progress(step)
        progress(Step(study.count, "writing the Dataset"))
        dataset = assemble(store)
        save_dataset(dataset, out)
    return dataset
