"""Runs a study from its specification to its Dataset: in this process, or on a Dask cluster.

The results are the same bit for bit. Workers of a cluster need only this package. If a worker is lost, another worker
repeats its tasks.
"""

import concurrent.futures
import contextlib
import ctypes
import functools
import io
import itertools
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
import xarray as xr

from .._files import write_file
from ..errors import InputError, TrainingError
from ..networks import TrainedNetwork, encode_network, load_network
from ..shooting import cores
from .cell import blank_problem, fleet_of, key_of, program_of, run_cell
from .dataset import Store, assemble, check_store, open_store, save_dataset
from .specification import Cell, Job, Study

if TYPE_CHECKING:
    from distributed import Client

# The bytes of a network's file, or a message that says why there is none; `None` for an estimator without a network.
Trained = bytes | str | None

# Exceptions of a cell that cannot be computed: the cell is kept as failed, with the message, and the study goes on.
FAILURES = (TrainingError, InputError, ValueError, ArithmeticError, RuntimeError)
# How often a task that raises an unexpected exception is repeated. The cluster itself counts lost workers.
_RETRIES = 2


class Step(NamedTuple):
    """`done` cells are finished; `label` names the running tasks."""

    done: int
    label: str


def workers() -> list[Any]:
    """The device of each cell that this process computes at a time.

    A CPU is one device for all its cores: their threads share compiled programs, and so the results' last digits.
    """
    devices = jax.local_devices()
    return devices if devices[0].platform != "cpu" else devices[:1] * cores()


def device_name() -> str:
    """The workers of this process, in words."""
    return f"{len(workers())} x {jax.local_devices()[0].device_kind}"


def plan(study: Study, directory: Path) -> dict[str, tuple[int, int]]:
    """The numbers of cells and flights that remain, by estimator. Raises as `open_store`."""
    rows: dict[str, tuple[int, int]] = dict.fromkeys(study.estimators, (0, 0))
    for cell in map(study.cell, check_store(directory, study).missing()):
        cells, flights = rows[cell.scenario.estimator]
        rows[cell.scenario.estimator] = cells + 1, flights + min(study.batch, study.flights - cell.first)
    return rows


def run_here(store: Store) -> Iterator[Step]:
    """Computes the remaining cells, each by one worker: a divided program gives other last digits.

    A cell that cannot be computed is kept as failed; delete its file to try it again.
    """
    study, cells = store.study, [store.study.cell(index) for index in store.missing()]
    done, waiting = study.count - len(cells), defaultdict[tuple, deque[Cell]](deque)
    # Cells of IBSS first: those of the hybrid, which end with the same program, wait for a network.
    for cell in sorted(cells, key=lambda cell: study.job(cell.scenario) is not None):
        waiting[program_of(cell.scenario)].append(cell)
    untrained = deque(dict.fromkeys(job for cell in cells if (job := study.job(cell.scenario)) is not None))
    # A cell without a network never waits for one.
    networks: dict[Job | None, Trained] = {None: None}
    free = deque(workers())
    # Whether each program is compiled on a device, or its first cell is still running there.
    compiled: dict[tuple[tuple, Any], bool] = {}
    running: dict[concurrent.futures.Future, tuple[Any, Job | Cell]] = {}
    pool = concurrent.futures.ThreadPoolExecutor(len(free))

    def next_cell(device: Any) -> Cell | None:
        """The next cell: of a program that is not compiled yet, else of one that waits for no compiler, else of any."""
        ready = [p for p, cells in waiting.items() if cells and study.job(cells[0].scenario) in networks]
        ready = [p for p in ready if compiled.get((p, device), True)]
        started = {program for program, _ in compiled}
        program = min(ready, key=lambda p: (p in started, (p, device) not in compiled), default=None)
        if program is None:
            return None
        compiled.setdefault((program, device), False)
        return waiting[program].popleft()

    try:
        while True:
            for device in tuple(free):
                if untrained:
                    task = untrained.popleft()
                    future = pool.submit(_train, store, task, device)
                elif task := next_cell(device):
                    future = pool.submit(compute, study, task, networks[study.job(task.scenario)], device)
                else:  # all remaining cells wait for networks or programs
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
                    compiled[program_of(task.scenario), device] = True
                    write_file(store.cell_file(task.number), future.result())
                    done += 1
    finally:
        # An interrupt does not wait for running tasks, which may last minutes; their results are lost.
        pool.shutdown(wait=False, cancel_futures=True)


def _give_memory_back() -> None:
    """Returns the compiler's freed memory to the system; the C library keeps half a gigabyte of a large program."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # not every C library can
        ctypes.CDLL(None).malloc_trim(0)


def _train(store: Store, job: Job, device: Any) -> bytes | str:
    """`train` on a device, or the file of an earlier run."""
    number = store.study.jobs()[job]
    if store.read_network(number) is None:
        with jax.default_device(device):
            data = train(store.study, job)
        if isinstance(data, str):
            return data
        write_file(store.network_file(number), data)
    return store.network_file(number).read_bytes()


def train(study: Study, job: Job) -> bytes | str:
    """The bytes of a network's file, or a message that says why there is none. It serves all noises and scales.

    The numbers are the same bit for bit only on the same number of cores, which share the products of matrices.
    """
    scales = [scale or 1.0 for scale in study.scales]
    try:
        with jax.enable_x64(True):
            fleet, key = fleet_of(study, job), key_of(study.network.seed, study.jobs()[job])
            settings = study.network.estimator(job.channels, (min(scales), max(scales)))
            return encode_network(settings.fit(blank_problem(study, fleet, 1.0, job.channels), fleet.bracket, key=key))
    except FAILURES as error:
        return str(error)


def compute(study: Study, cell: Cell, network: Trained, device: Any = None) -> bytes:
    """The bytes of a cell's file. Equal results give equal bytes."""
    try:
        if isinstance(network, str):
            raise TrainingError(network)
        with jax.default_device(device):
            results = run_cell(study, cell, None if network is None else _loaded(network))
    except FAILURES as error:
        if "RESOURCE_EXHAUSTED" in str(error):  # the machine's failure, not the cell's
            remedy = "free some and run the study again, or start another study with a smaller `batch`"
            raise InputError(f"out of memory: {remedy}.") from None
        results = {"failed": np.asarray(" ".join(str(error).split())[:500])}
    file = io.BytesIO()
    np.savez(file, **results)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


def label_of(study: Study, task: Job | Cell) -> str:
    """The name of a task: for a cell its estimator, and its values on the axes that have more than one."""
    if isinstance(task, Job):
        return f"training for {task.channels}"
    *shared, estimator = (f"{value:g}" if isinstance(value, float) else str(value) for value in task.scenario)
    return " ".join([estimator, *itertools.compress(shared, (length > 1 for length in study.shape))])


def run_on_cluster(store: Store, client: "Client") -> Iterator[Step]:
    """Computes the remaining cells on a cluster, in the order in which they finish.

    `client` must be made with `set_as_default=False`: under a default client, xarray would write the Dataset under a
    lock of the cluster. Raises `InputError` if the cluster has no workers, or loses a cell more often than it allows.
    """
    from distributed import as_completed

    study, cells, numbers = store.study, [store.study.cell(index) for index in store.missing()], store.study.jobs()
    if cells and not client.nthreads():
        raise InputError("--scheduler: the cluster has no workers; start some, and run the study again.")

    def network_of(job: Job) -> Any:
        if store.read_network(numbers[job]) is None:
            return client.submit(train, study, job, retries=_RETRIES, pure=False)
        # Read here, and not on a worker, because it may be damaged. As a task: data of a lost worker are lost with it.
        return client.submit(bytes, store.network_file(numbers[job]).read_bytes(), pure=False)

    jobs = [study.job(cell.scenario) for cell in cells]
    networks: dict[Job | None, Any] = {job: network_of(job) for job in dict.fromkeys(jobs) if job is not None} | {
        None: None
    }
    running = {
        client.submit(compute, study, cell, networks[job], retries=_RETRIES, pure=False): (cell, job)
        for cell, job in zip(cells, jobs, strict=True)
    }
    finished = as_completed(list(running), loop=client.loop, raise_errors=False)
    for done, future in enumerate(finished, start=study.count - len(cells) + 1):
        cell, job = running.pop(future)
        try:
            data = future.result()
            trained = None if job is None or store.network_file(numbers[job]).exists() else networks[job].result()
        except Exception as error:  # noqa: BLE001  # whatever a cluster raises, finished cells are kept
            what = " ".join(str(error).split())[:300] or type(error).__name__
            lost = f"cell {cell.number}: lost by the cluster ({what})"
            raise InputError(f"{lost}; run the study again to resume.") from None
        if job is not None and isinstance(trained, bytes):
            write_file(store.network_file(numbers[job]), trained)
        write_file(store.cell_file(cell.number), data)
        yield Step(done, label_of(study, cell))


@functools.lru_cache(maxsize=8)
def _loaded(network: bytes) -> TrainedNetwork:
    with jax.enable_x64(True):
        return load_network(io.BytesIO(network))


def carry_out(
    study: Study,
    out: Path,
    device: str,
    *,
    run: Callable[[Store], Iterator[Step]] = run_here,
    progress: Callable[[Step], None] = lambda step: None,
) -> xr.Dataset:
    """Runs the missing cells of a study and writes its Dataset. Raises what `open_store` and `run` raise.

    - `out`: the study's folder; a new one, or one that the same study wrote.
    - `device`: what computes, in words, for the provenance.
    - `run`: `run_here`, or `run_on_cluster` with its client.
    - `progress`: is called after each step.
    """
    with open_store(out, study, device) as store:
        for step in run(store):
            progress(step)
        progress(Step(study.count, "writing the Dataset"))
        dataset = assemble(store)
        save_dataset(dataset, out)
    return dataset
