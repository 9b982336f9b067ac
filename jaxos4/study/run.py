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
    """One compiled program: the devices that run it, and the waiting cells that end with it."""

    def __init__(self) -> None:
        self.devices: set[Any] = set()
        self.waiting: deque[_Waiting] = deque()


class _Waiting(NamedTuple):
    """A cell that waits, the number of the network that it needs, and the programs that it runs."""

    cell: Cell
    network: int | None
    programs: list[_Program]


class _Work:
    """The remaining work of a study, and the choice of the next task for a free device."""

    def __init__(self, store: Store):
        self.store, self.study, missing = store, store.study, store.missing()
        self.needed, self.done = jobs(self.study), self.study.count - len(missing)
        programs: dict[tuple, _Program] = {}
        waiting, untrained = [], {}
        for cell in map(self.study.cell, missing):
            keys, network = programs_of(self.study, cell), job_number(self.study, cell, self.needed)
            one = _Waiting(cell, network, [programs.setdefault(key, _Program()) for key in keys])
            waiting.append(one)
            if network is not None:
                untrained.setdefault((network, *keys), one)
        # Cells of IBSS first: those of the hybrid, which end with the same program, wait for a network.
        for one in sorted(waiting, key=lambda one: one.network is not None):
            one.programs[-1].waiting.append(one)
        self.programs = list(programs.values())
        # A cell without a network never waits for one.
        self.networks: dict[int | None, TrainedNetwork | str | None] = {None: None}
        self.untrained = deque(dict.fromkeys(number for number, *_ in untrained))
        kept = {number for number in self.untrained if store.network_file(number).exists()}  # soon read
        # For each network and its programs one cell. First the hybrid's: its programs compile for longest.
        self.blocked = sorted(
            (one for one in untrained.values() if one.network not in kept),
            key=lambda one: (one.network, -len(one.programs)),
        )
        self.begun: set[int | None] = set()  # networks of which programs were compiled

    def task(self, device: Any) -> _Task | None:
        """The next task for a free device, or `None` if all remaining work waits for other tasks."""
        if self.untrained:
            return self._training(self.untrained.popleft())
        ahead = self._ahead()
        # Programs of each network before any cell. Compiled after the training, they would hold up the end.
        first = next((one for one in ahead if one.network not in self.begun), None)
        ready = None if first else self._ready(device)
        one = ready.waiting.popleft() if ready else first or next(iter(ahead), None)
        if one is None:
            return None
        for program in one.programs:
            program.devices.add(device)
        if ready:
            return self._cell(one)
        self.begun.add(one.network)
        return self._compilation(one)

    def _ahead(self) -> list[_Waiting]:
        """Cells whose network is being trained, and whose programs are not all compiled."""
        return [
            one
            for one in self.blocked
            if one.network not in self.networks and not all(program.devices for program in one.programs)
        ]

    def _ready(self, device: Any) -> _Program | None:
        """The program that the device runs already, else one that no device runs, else the one with most cells."""
        ready = [p for p in self.programs if p.waiting and p.waiting[0].network in self.networks]
        own = [p for p in ready if device in p.devices]
        new = [p for p in ready if not p.devices]
        long = [p for p in ready if len(p.waiting) >= _WORTH_COMPILING]
        return next(iter(own or new), None) or max(long, key=lambda p: len(p.waiting), default=None)

    def _training(self, number: int) -> _Task:
        job = self.needed[number]
        return _Task(
            f"training for {job.channels}",
            lambda device: _train(self.store, number, job, device),
            lambda network: self.networks.update({number: network}),
        )

    def _compilation(self, one: _Waiting) -> _Task:
        label = f"compiling {one.cell.scenario.estimator}"
        return _Task(label, lambda device: _compile(self.study, one.cell, device), lambda _: None)

    def _cell(self, one: _Waiting) -> _Task:
        cell, network = one.cell, self.networks[one.network]

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
