"""Runs the remaining cells of a study on the devices of this process."""

import concurrent.futures
import contextlib
import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax

from ..errors import InputError, TrainingError
from ..estimators import ESTIMATORS
from ..networks import TrainedNetwork, save_network
from .cell import compile_cell, programs_of, run_cell
from .cell_file import encode, failed
from .devices import give_memory_back
from .network_jobs import blank_network, job_number, job_of, jobs, train_network
from .specification import Cell, Job, Study
from .store import Store

# Exceptions of a cell that cannot be computed: the cell is kept as failed, with the message, and the study goes on.
FAILURES = (TrainingError, InputError, ValueError, ArithmeticError, RuntimeError)
# A device joins the program of another device if at least this number of cells waits: it must compile the program too.
_WORTH_COMPILING = 8


class Step(NamedTuple):
    """`done` cells are finished; `label` names the running tasks."""

    done: int
    label: str


class _Task(NamedTuple):
    """A task for a device: its name, the call with the device, and what to do with the result."""

    label: str
    call: Callable[[Any], Any]
    keep: Callable[[Any], None]


class _Program:
    """The waiting cells of one compiled program, with the networks that they need, and the devices that run it."""

    def __init__(self) -> None:
        self.waiting: deque[tuple[Cell, int | None]] = deque()
        self.devices: set[Any] = set()

    @property
    def network(self) -> int | None:
        """The network that the next cell needs."""
        return self.waiting[0][1] if self.waiting else None


class _Work:
    """The remaining work of a study, and the choice of the next task for a free device."""

    def __init__(self, store: Store):
        self.store, self.study, missing = store, store.study, store.missing()
        self.needed, self.done = jobs(self.study), self.study.count - len(missing)
        grouped: dict[tuple, _Program] = {}
        # Cells without a network first: others of their program, the hybrid's beside those of IBSS, must wait for it.
        for cell in sorted(map(self.study.cell, missing), key=lambda cell: cell.scenario.needs_network):
            program = grouped.setdefault(programs_of(self.study, cell)[-1], _Program())
            program.waiting.append((cell, job_number(self.study, cell, self.needed)))
        self.programs = list(grouped.values())
        self.networks: dict[int, TrainedNetwork | str | None] = {}
        needed = (network for program in self.programs for _, network in program.waiting if network is not None)
        self.untrained = deque(dict.fromkeys(needed))
        self.kept = {number for number in self.untrained if store.network_file(number).exists()}

    def task(self, device: Any) -> _Task | None:
        """The next task for a free device, or `None` if all remaining work waits for other tasks."""
        if self.untrained:
            return self._training(self.untrained.popleft())
        ahead = self._ahead()
        # One program of each network before any cell. Compiled after the training, it would hold up the end.
        begun = {p.network for p in self.programs if p.devices}
        first = next((p for p in ahead if p.network not in begun), None)
        program = first or self._ready(device) or next(iter(ahead), None)
        if program is None:
            return None
        program.devices.add(device)
        return self._compilation(program) if program in ahead else self._cell(*program.waiting.popleft())

    def _ready(self, device: Any) -> _Program | None:
        """The program that the device runs already, else one that no device runs, else the one with most cells."""
        ready = [p for p in self.programs if p.waiting and self._has_network(p)]
        own = [p for p in ready if device in p.devices]
        new = [p for p in ready if not p.devices]
        long = [p for p in ready if len(p.waiting) >= _WORTH_COMPILING]
        return next(iter(own or new), None) or max(long, key=lambda p: len(p.waiting), default=None)

    def _ahead(self) -> list[_Program]:
        """The programs to compile while their network is trained. First those that shoot: they compile for longest.

        A network that a file holds is soon read.
        """
        unbegun = [
            p for p in self.programs if not p.devices and not self._has_network(p) and p.network not in self.kept
        ]
        shoots = {name: kind.shoots for name, kind in ESTIMATORS.items()}
        return sorted(unbegun, key=lambda p: (p.network, not shoots[p.waiting[0][0].scenario.estimator]))

    def _has_network(self, program: _Program) -> bool:
        return program.network is None or program.network in self.networks

    def _training(self, number: int) -> _Task:
        job = self.needed[number]
        return _Task(
            f"training for {job.channels}",
            lambda device: _train(self.store, number, job, device),
            lambda network: self.networks.update({number: network}),
        )

    def _compilation(self, program: _Program) -> _Task:
        cell, _ = program.waiting[0]
        label = f"compiling {cell.scenario.estimator}"
        return _Task(label, lambda device: _compile(self.study, cell, device), lambda _: None)

    def _cell(self, cell: Cell, number: int | None) -> _Task:
        network = None if number is None else self.networks[number]

        def call(device: Any) -> tuple[bytes, float]:
            with jax.default_device(device):
                return compute(self.study, cell, network)

        def keep(result: tuple[bytes, float]) -> None:
            data, seconds = result
            self.store.write(self.store.cell_file(cell.number), data, cell=cell.number, seconds=seconds)
            self.done += 1

        return _Task(label_of(self.study, cell), call, keep)


def run_here(store: Store) -> Iterator[Step]:
    """Computes the remaining cells, each on one device: a divided program gives other last digits.

    While a network is trained, the programs that wait for it are compiled. A cell that cannot be computed is kept as
    failed; delete its file to try it again.
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
                give_memory_back()
                task.keep(future.result())
    finally:
        # An interrupt does not wait for running tasks, which may last minutes; their results are lost.
        pool.shutdown(wait=False, cancel_futures=True)


def _compile(study: Study, cell: Cell, device: Any) -> None:
    with jax.default_device(device), contextlib.suppress(*FAILURES):  # the cell itself will report the failure
        compile_cell(study, cell, blank_network(study, job_of(study, cell.scenario)))


def _train(store: Store, number: int, job: Job, device: Any) -> TrainedNetwork | str | None:
    """The network, read from its file as in a resumed run; or a message that says why there is none."""
    begin = time.perf_counter()
    with jax.default_device(device):
        if (network := store.read_network(number)) is not None:
            return network
        try:
            network = train_network(store.study, job)
        except FAILURES as error:
            return str(error)
        with jax.enable_x64(store.study.double):
            save_network(network, store.network_file(number))
        store.log(network=number, seconds=round(time.perf_counter() - begin, 3))
        return store.read_network(number)


def compute(study: Study, cell: Cell, network: TrainedNetwork | str | None) -> tuple[bytes, float]:
    """The bytes of a cell's file, and the seconds of its computation. `network` is a message if there is none."""
    begin = time.perf_counter()
    try:
        results = failed(network) if isinstance(network, str) else run_cell(study, cell, network)
    except FAILURES as error:
        if "RESOURCE_EXHAUSTED" in str(error):  # the machine's failure, not the cell's
            raise InputError(
                "out of memory: free some and run the study again, or start another study with a smaller `batch`."
            ) from None
        results = failed(str(error))
    return encode(results), round(time.perf_counter() - begin, 3)


def label_of(study: Study, cell: Cell) -> str:
    """The name of a cell: its estimator, and its values on the axes that have more than one."""
    *shared, estimator = (f"{value:g}" if isinstance(value, float) else str(value) for value in cell.scenario)
    return " ".join([estimator, *itertools.compress(shared, (length > 1 for length in study.shape))])
