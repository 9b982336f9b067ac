"""Runs the cells of a study on a Dask cluster: a task a cell, its results the same bit for bit as on this machine.

Workers need this package and nothing else. They get the specification, the number of a cell and the bytes of its
network's file, and send back the bytes of the cell's file. What a lost worker had is done by another.
"""

import collections
import functools
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import msgspec

from ..errors import InputError
from ..networks.file import load_network, save_network
from ..networks.network import TrainedNetwork
from .cell import jobs, train
from .run import FAILURES, Step, compute, label_of, network_number
from .specification import Study
from .store import Store

if TYPE_CHECKING:
    from distributed import Client, Future

# Cells that wait on the cluster, for each of its threads: enough to keep it busy.
_AHEAD = 3
# How often a task may raise what a cell should not before the study ends. Lost workers are the cluster's to count.
_RETRIES = 2


def run_on_cluster(store: Store, client: "Client") -> Iterator[Step]:
    """Computes the cells that are missing on a cluster, in whatever order they finish.

    **Arguments:**

    - `client`: of `distributed`, connected to the scheduler; not the default one (`set_as_default=False`), or the
      Dataset would be written under a lock of the cluster.

    **Raises:** `InputError` where the cluster has no workers, or loses a cell more often than it allows.
    """
    from distributed import as_completed

    study = store.study
    specification, needed = msgspec.json.encode(study).decode(), jobs(study)
    waiting = collections.deque(store.missing())
    done = study.count - len(waiting)
    networks: dict[int, Any] = {}
    running: dict[Future, tuple[int, int | None]] = {}
    finished = as_completed(loop=client.loop, raise_errors=False)
    if waiting and not _threads(client):
        raise InputError("--scheduler: the cluster has no workers; start some, and run the study again.")

    def network_of(number: int) -> Any:
        if number not in networks:
            if store.read_network(number) is not None:  # whole: workers need not find out
                # A task, not scattered: a worker that is lost takes what was scattered to it along.
                data = store.network_file(number).read_bytes()
                networks[number] = client.submit(bytes, data, pure=False)
            else:
                networks[number] = client.submit(remote_training, specification, number, retries=_RETRIES, pure=False)
        return networks[number]

    def submit() -> None:
        room = _AHEAD * max(_threads(client), 1) - len(running)
        for _ in range(min(room, len(waiting))):
            index = waiting.popleft()
            number = network_number(study, study.cell(index), needed)
            network = None if number is None else network_of(number)
            future = client.submit(remote_cell, specification, index, network, retries=_RETRIES, pure=False)
            running[future] = index, number
            finished.add(future)

    submit()
    while running:
        future = next(finished)
        index, number = running.pop(future)
        try:
            data, seconds = future.result()
            trained = None if number is None or store.network_file(number).exists() else networks[number].result()
        except Exception as error:  # noqa: BLE001  # whatever a cluster raises, the cells that are there are kept
            what = " ".join(str(error).split())[:300] or type(error).__name__
            raise InputError(f"cell {index}: the cluster lost it ({what}); run the study again to resume.") from None
        if number is not None and isinstance(trained, bytes):
            store.write(store.network_file(number), trained, network=number)
        store.write(store.cell_file(index), data, cell=index, seconds=seconds)
        done += 1
        yield Step(done, label_of(study, study.cell(index)))
        submit()
    yield Step(done, "")


def _threads(client: Any) -> int:
    return sum(client.nthreads().values())


def remote_training(specification: str, number: int) -> bytes | str:
    """The bytes of a network's file, or why there is none."""
    study = msgspec.json.decode(specification, type=Study)
    try:
        network = train(study, jobs(study)[number])
    except FAILURES as error:
        return str(error)
    with tempfile.TemporaryDirectory() as folder, jax.enable_x64(study.precision == "float64"):
        path = Path(folder) / "network.net"
        save_network(network, path)
        return path.read_bytes()


def remote_cell(specification: str, index: int, network: bytes | str | None) -> tuple[bytes, float]:
    """The bytes of a cell's file, and the seconds that it took."""
    study = msgspec.json.decode(specification, type=Study)
    trained = _loaded(network, study.precision == "float64") if isinstance(network, bytes) else network
    return compute(study, study.cell(index), trained)


@functools.lru_cache(maxsize=2)
def _loaded(network: bytes, double: bool) -> TrainedNetwork:
    with tempfile.TemporaryDirectory() as folder, jax.enable_x64(double):
        path = Path(folder) / "network.net"
        path.write_bytes(network)
        return load_network(path)
