"""Runs the cells of a study on a Dask cluster, one task for each; results are the same bit for bit as on one machine.

Workers need only this package. If a worker is lost, another worker repeats its tasks.
"""

import collections
import functools
import io
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import jax
import msgspec

from ..errors import InputError
from ..networks import TrainedNetwork, load_network
from .run import Step, compute, label_of, train
from .specification import Study
from .store import Store

if TYPE_CHECKING:
    from distributed import Client, Future

# Cells that wait on the cluster for each of its threads: enough to keep it busy.
_AHEAD = 3
# How often a task that raises an unexpected exception is repeated. The cluster itself counts lost workers.
_RETRIES = 2


def run_on_cluster(store: Store, client: "Client") -> Iterator[Step]:
    """Computes the remaining cells on a cluster, in the order in which they finish.

    `client` must be made with `set_as_default=False`: under a default client, xarray would write the Dataset under a
    lock of the cluster. Raises `InputError` if the cluster has no workers, or loses a cell more often than it allows.
    """
    from distributed import as_completed

    study = store.study
    specification = msgspec.json.encode(study).decode()
    numbers = study.jobs()
    waiting = collections.deque(store.missing())
    done = study.count - len(waiting)
    networks: dict[int, Any] = {}
    running: dict[Future, tuple[int, int | None]] = {}
    finished = as_completed(loop=client.loop, raise_errors=False)
    if waiting and not _threads(client):
        raise InputError("--scheduler: the cluster has no workers; start some, and run the study again.")

    def network_of(number: int) -> Any:
        if number not in networks:
            if store.read_network(number) is not None:  # raises here, and not on a worker, if the file is damaged
                # As a task, because data that are scattered to a worker are lost with it.
                data = store.network_file(number).read_bytes()
                networks[number] = client.submit(bytes, data, pure=False)
            else:
                networks[number] = client.submit(remote_training, specification, number, retries=_RETRIES, pure=False)
        return networks[number]

    def submit() -> None:
        room = _AHEAD * max(_threads(client), 1) - len(running)
        for _ in range(min(room, len(waiting))):
            index = waiting.popleft()
            job = study.job(study.cell(index).scenario)
            number = None if job is None else numbers[job]
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
        except Exception as error:  # noqa: BLE001  # whatever a cluster raises, finished cells are kept
            what = " ".join(str(error).split())[:300] or type(error).__name__
            raise InputError(f"cell {index}: lost by the cluster ({what}); run the study again to resume.") from None
        if number is not None and isinstance(trained, bytes):
            store.write_network(number, trained)
        store.write_cell(index, data, seconds)
        done += 1
        yield Step(done, label_of(study, study.cell(index)))
        submit()
    yield Step(done, "")


def _threads(client: Any) -> int:
    return sum(client.nthreads().values())


def remote_training(specification: str, number: int) -> bytes | str:
    """The bytes of a network's file, or a message that says why there is none."""
    study = msgspec.json.decode(specification, type=Study)
    return train(study, list(study.jobs())[number])


def remote_cell(specification: str, index: int, network: bytes | str | None) -> tuple[bytes, float]:
    """The bytes of a cell's file, and the seconds of its computation."""
    study = msgspec.json.decode(specification, type=Study)
    trained = _loaded(network, study.double) if isinstance(network, bytes) else network
    return compute(study, study.cell(index), trained)


@functools.lru_cache(maxsize=2)
def _loaded(network: bytes, double: bool) -> TrainedNetwork:
    with jax.enable_x64(double):
        return load_network(io.BytesIO(network))
