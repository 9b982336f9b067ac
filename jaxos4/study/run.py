"""Runs a study from its specification to its Dataset, here or on a Dask cluster: with the same results, bit for bit."""

import functools
import io
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
import xarray as xr

from .._files import write_file, write_netcdf
from ..batching import cores
from ..errors import InputError, TrainingError, in_words
from ..networks import NetworkEstimator, TrainedNetwork, encode_network, load_network
from .cell import blank_problem, key_of, run_cell, setup_of
from .dataset import RESULTS_FILE, Store, assemble, check_store, open_store
from .specification import Cell, Scenario, Study

if TYPE_CHECKING:
    from distributed import Client

# The bytes of a network's file, or a message that says why there is none; `None` for an estimator without a network.
Trained = bytes | str | None

# Exceptions of a cell that cannot be computed: the cell is kept as failed, with the message, and the study goes on.
FAILURES = (TrainingError, InputError, ValueError, ArithmeticError, RuntimeError)


def device_name() -> str:
    """The device of this process in words: an accelerator, or the cores of the CPU."""
    device = jax.local_devices()[0]
    return f"{cores() if device.platform == 'cpu' else 1} x {device.device_kind}"


def plan(study: Study, directory: Path) -> dict[str, tuple[int, int]]:
    """The numbers of cells and flights that remain, by estimator. Raises as `open_store`."""
    rows: dict[str, tuple[int, int]] = dict.fromkeys(study.estimators, (0, 0))
    for cell in map(study.cell, check_store(directory, study).missing()):
        cells, flights = rows[cell.scenario.estimator]
        rows[cell.scenario.estimator] = cells + 1, flights + min(study.batch, study.flights - cell.first)
    return rows


def run_here(store: Store) -> Iterator[tuple[str, int]]:
    """Computes the remaining cells one after another, each on all cores.

    Yields the label of each cell that is finished, and the number of finished cells. A cell that cannot be computed is
    kept as failed; delete its file to try it again.
    """

    def submit(function: Callable[..., Any], *arguments: Any) -> Any:
        return functools.cache(lambda: function(*(x() if callable(x) else x for x in arguments)))

    def results(tasks: list[Any]) -> Iterator[tuple[Any, Any]]:
        while tasks:  # a task keeps its result
            task = tasks.pop(0)
            yield task, task()

    yield from _run(store, submit, results)


RETRIES = 2  # of a task that raises an unexpected exception


def run_on_cluster(store: Store, client: "Client") -> Iterator[tuple[str, int]]:
    """Computes the remaining cells on a cluster, in the order in which they finish. Yields as `run_here`.

    `client`: made with `set_as_default=False`, or xarray would write under a lock of the cluster. Raises `InputError`
    without workers, or if a task is lost too often.
    """
    from distributed import as_completed

    if store.missing() and not client.nthreads():
        raise InputError("--scheduler: the cluster has no workers; start some, and run the study again.")

    def results(futures: list[Any]) -> Iterator[tuple[Any, Any]]:
        finished = as_completed(futures, loop=client.loop, raise_errors=False)
        futures.clear()  # a cluster keeps the result of each future that we keep
        for future in finished:
            try:
                result = future.result()
            except Exception as error:  # noqa: BLE001  # whatever a cluster raises, finished cells are kept
                what = in_words(error, 300)
                raise InputError(f"lost by the cluster ({what}); run the study again to resume.") from None
            yield future, result

    yield from _run(store, functools.partial(client.submit, retries=RETRIES, pure=False), results)


def _run(
    store: Store, submit: Callable[..., Any], results: Callable[[list[Any]], Iterator[tuple[Any, Any]]]
) -> Iterator[tuple[str, int]]:
    """Trains the missing networks and computes the missing cells. Files are written by this process.

    - `submit`: takes a function and its arguments, some of which may be futures; returns a future.
    - `results`: the finished futures with their results.
    """
    study, numbers = store.study, store.study.jobs()
    cells = [study.cell(number) for number in store.missing()]

    def turn(task: tuple[Any, Scenario | Cell]) -> int:
        """First the cells without a network, then the training."""
        return 1 if isinstance(task[1], Scenario) else 2 * (study.job(task[1].scenario) is not None)

    networks: dict[Scenario | None, Any] = {None: None}
    tasks: dict[Any, Scenario | Cell] = {}
    for job in dict.fromkeys(job for cell in cells if (job := study.job(cell.scenario)) is not None):
        if store.read_network(numbers[job]) is None:
            networks[job] = submit(train, study, job)
            tasks[networks[job]] = job
        else:  # as a task: a cluster keeps it once, and again if a worker is lost
            networks[job] = submit(bytes, store.network_file(numbers[job]).read_bytes())
    tasks |= {submit(compute, study, cell, networks[study.job(cell.scenario)]): cell for cell in cells}
    done = study.count - len(cells)
    tasks = dict(sorted(tasks.items(), key=turn))
    for future, data in results(list(tasks)):
        task = tasks.pop(future)
        if isinstance(task, Cell):
            write_file(store.cell_file(task.number), data)
            done += 1
            *shared, estimator = (f"{value:g}" if isinstance(value, float) else str(value) for value in task.scenario)
            varied = itertools.compress(shared, (length > 1 for length in study.shape))
            yield " ".join([estimator, *varied]), done
        elif isinstance(data, bytes):
            write_file(store.network_file(numbers[task]), data)


def train(study: Study, job: Scenario) -> bytes | str:
    """A network's file, which serves all noises and scales, or why there is none. Its bits depend on the cores."""
    scales = [scale or 1.0 for scale in study.scales]
    try:
        with jax.enable_x64(True):
            setup, key = setup_of(study, job), key_of(study.network.seed, study.jobs()[job])
            training: dict[str, Any] = {"steps": study.network.steps, "held_out": study.network.held_out}
            settings = NetworkEstimator(channels=job.channels, noise=(min(scales), max(scales)), **training)
            return encode_network(settings.fit(blank_problem(study, setup, 1.0, job.channels), setup.bracket, key=key))
    except FAILURES as error:
        return str(error)


def compute(study: Study, cell: Cell, network: Trained) -> bytes:
    """The bytes of a cell's file. Equal results give equal bytes."""
    try:
        if isinstance(network, str):
            raise TrainingError(network)
        results = run_cell(study, cell, None if network is None else _loaded(network))
    except FAILURES as error:
        if "RESOURCE_EXHAUSTED" in str(error):  # the machine's failure, not the cell's
            remedy = "free some and run the study again, or start another study with a smaller `batch`"
            raise InputError(f"out of memory: {remedy}.") from None
        results = {"failed": np.asarray(in_words(error, 500))}
    file = io.BytesIO()
    np.savez(file, **results)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


@functools.lru_cache(maxsize=8)
def _loaded(network: bytes) -> TrainedNetwork:
    with jax.enable_x64(True):
        return load_network(io.BytesIO(network))


def run_study(
    study: Study,
    out: Path,
    device: str,
    *,
    run: Callable[[Store], Iterator[tuple[str, int]]] = run_here,
    progress: Callable[[str, int], None] = lambda label, done: None,
) -> xr.Dataset:
    """Runs the missing cells of a study and writes its Dataset. Raises as `open_store`, `run` and `check_excitations`.

    - `out`: the study's folder; a new one, or one that the same study wrote.
    - `device`: what computes, in words, for the provenance. `run`: `run_here`, or `run_on_cluster` with its client.
    - `progress`: is called after each step, with its label and the number of finished cells.
    """
    study.check_excitations()
    with open_store(out, study, device) as store:
        for label, done in run(store):
            progress(label, done)
        progress("writing the Dataset", study.count)
        dataset = assemble(store)
        write_netcdf(out / RESULTS_FILE, dataset, 4)
    return dataset
