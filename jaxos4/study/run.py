"""Runs the cells of a study that are not there yet, on the devices of this process."""

import concurrent.futures
import contextlib
import ctypes
import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from ..errors import InputError, TrainingError
from ..networks.file import save_network
from ..networks.network import TrainedNetwork
from .cell import Job, blank_network, encode, job_of, jobs, program_of, run_cell, train
from .specification import Cell, Study
from .store import Store

# What a cell that cannot be computed raises: it is kept as failed, with the message, and the study goes on.
FAILURES = (TrainingError, InputError, ValueError, ArithmeticError, RuntimeError)
# A device helps with what another one has compiled where at least so many cells are left: fewer are done sooner than
# compiled.
_WORTH_COMPILING = 8


class Step(NamedTuple):
    """`done` cells are there, and what is at work now, in words."""

    done: int
    label: str


class _Task(NamedTuple):
    """What a device is given to do: in words, the call that does it, and what becomes of its result."""

    label: str
    call: Callable[[Any], Any]
    keep: Callable[[Any], None]


class _Program:
    """Cells that one compiled program can identify, and the network that they need."""

    def __init__(self, cells: list[Cell], study: Study, needed: list[Job]):
        self.waiting, self.network = deque(cells), network_number(study, cells[0], needed)
        self.devices: set[Any] = set()


class _Work:
    """What is missing of a study, and what a free device should do of it."""

    def __init__(self, store: Store):
        self.store, self.study, missing = store, store.study, store.missing()
        self.needed, self.done = jobs(self.study), self.study.count - len(missing)
        grouped: dict[tuple, list[Cell]] = {}
        for cell in map(self.study.cell, missing):
            grouped.setdefault(program_of(self.study, cell), []).append(cell)
        self.programs = [_Program(cells, self.study, self.needed) for cells in grouped.values()]
        self.networks: dict[int, TrainedNetwork | str | None] = {}
        self.untrained = deque(dict.fromkeys(p.network for p in self.programs if p.network is not None))

    def task(self, device: Any) -> _Task | None:
        """The next for a device that is free, or `None` where all that is left waits for others."""
        if self.untrained:
            return self._training(self.untrained.popleft())
        if (program := self._ready(device)) is not None:
            program.devices.add(device)
            return self._cell(program.waiting.popleft(), program)
        if (program := self._untried()) is not None:
            program.devices.add(device)
            return self._compilation(program.waiting[0])
        return None

    def _ready(self, device: Any) -> _Program | None:
        """What the device was at, what nobody is at, or what is the longest."""
        ready = [p for p in self.programs if p.waiting and (p.network is None or p.network in self.networks)]
        own = [p for p in ready if device in p.devices]
        new = [p for p in ready if not p.devices]
        long = [p for p in ready if len(p.waiting) >= _WORTH_COMPILING]
        return next(iter(own or new), None) or max(long, key=lambda p: len(p.waiting), default=None)

    def _untried(self) -> _Program | None:
        """What waits for its network, and can be compiled meanwhile: a hybrid first, which takes longer."""
        untried = [p for p in self.programs if p.waiting and not p.devices]
        return min(untried, key=lambda p: (p.network, p.waiting[0].scenario.estimator != "hybrid"), default=None)

    def _training(self, number: int) -> _Task:
        job = self.needed[number]
        return _Task(
            f"training for {job.channels}",
            lambda device: _train(self.store, number, job, device),
            lambda network: self.networks.update({number: network}),
        )

    def _cell(self, cell: Cell, program: _Program) -> _Task:
        network = None if program.network is None else self.networks[program.network]

        def keep(result: tuple[bytes, float]) -> None:
            data, seconds = result
            self.store.write(self.store.cell_file(cell.number), data, cell=cell.number, seconds=seconds)
            self.done += 1

        return _Task(label_of(self.study, cell), lambda device: _compute(self.study, cell, network, device), keep)

    def _compilation(self, cell: Cell) -> _Task:
        return _Task(
            f"compiling {cell.scenario.estimator}",
            lambda device: _compile(self.study, cell, device),
            lambda _: None,
        )


def run_here(store: Store) -> Iterator[Step]:
    """Computes the cells that are missing, each device at its own.

    A device compiles and runs programs by itself: a program that was divided among devices would be another program,
    and differ in the last digits. First each device takes a program that no other has; then it helps with the longest;
    while a network is trained, what waits for it is compiled.
    A cell that cannot be computed is kept as failed, and stays so: delete its file to try it again.
    """
    work, free = _Work(store), deque(jax.local_devices())
    running: dict[concurrent.futures.Future, tuple[Any, _Task]] = {}
    pool = concurrent.futures.ThreadPoolExecutor(len(free))
    try:
        while True:
            for device in tuple(free):
                if (task := work.task(device)) is not None:
                    free.remove(device)
                    running[pool.submit(task.call, device)] = device, task
            yield Step(work.done, ", ".join(dict.fromkeys(task.label for _, task in running.values())))
            if not running:
                return
            finished, _ = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            for future in finished:
                device, task = running.pop(future)
                free.append(device)
                _give_memory_back()
                task.keep(future.result())
    finally:
        # Who ends it early does not wait for what is at work, a training of minutes maybe: nothing of that is kept.
        pool.shutdown(wait=False, cancel_futures=True)


def _compile(study: Study, cell: Cell, device: Any) -> None:
    with jax.default_device(device), contextlib.suppress(*FAILURES):  # the cell itself will say what is wrong
        run_cell(study, cell, blank_network(study, job_of(study, cell.scenario)))


def _give_memory_back() -> None:
    """To the system what the compiler has freed: half a gigabyte for a large program, which the C library keeps."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # another C library does without
        ctypes.CDLL(None).malloc_trim(0)


def _train(store: Store, number: int, job: Job, device: Any) -> TrainedNetwork | str | None:
    """The network, kept and read back as any later run reads it; or why there is none."""
    begin = time.perf_counter()
    with jax.default_device(device):
        if (network := store.read_network(number)) is not None:
            return network
        try:
            network = train(store.study, job)
        except FAILURES as error:
            return str(error)
        with jax.enable_x64(store.study.precision == "float64"):
            save_network(network, store.network_file(number))
        store.log(network=number, seconds=round(time.perf_counter() - begin, 3))
        return store.read_network(number)


def _compute(study: Study, cell: Cell, network: TrainedNetwork | str | None, device: Any) -> tuple[bytes, float]:
    with jax.default_device(device):
        return compute(study, cell, network)


def compute(study: Study, cell: Cell, network: TrainedNetwork | str | None) -> tuple[bytes, float]:
    """The bytes of a cell's file, and the seconds that it took. A network that is a string says why there is none."""
    begin = time.perf_counter()
    try:
        results = failed(network) if isinstance(network, str) else run_cell(study, cell, network)
    except FAILURES as error:
        if "RESOURCE_EXHAUSTED" in str(error):  # the machine's failure, not the cell's
            raise InputError(
                "out of memory: free some and run the study again, or give it a smaller `batch`."
            ) from None
        results = failed(str(error))
    return encode(results), round(time.perf_counter() - begin, 3)


def failed(message: str) -> dict[str, np.ndarray]:
    """What is kept of a cell that could not be computed."""
    return {"failed": np.asarray(" ".join(message.split())[:500])}


def network_number(study: Study, cell: Cell, needed: list[Job]) -> int | None:
    """The place among the study's networks of the one that a cell needs."""
    return needed.index(job_of(study, cell.scenario)) if cell.scenario.needs_network else None


def label_of(study: Study, cell: Cell) -> str:
    """What a cell does, in a word or two: what it shares with the whole study is left out."""
    *shared, estimator = (f"{value:g}" if isinstance(value, float) else str(value) for value in cell.scenario)
    return " ".join([estimator, *itertools.compress(shared, (length > 1 for length in study.shape))])
