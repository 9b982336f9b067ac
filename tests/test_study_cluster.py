"""A study on a Dask cluster whose workers die: the same study, bit for bit."""

import os
import shutil
import signal

import dask
import jax
import pytest
import xarray as xr
from distributed import Client, LocalCluster
from distributed.utils import get_mp_context
from helpers import environment, how_we_compile, refused
from small_study import NETWORKED, cells, results, run_study, specification

from jaxos4._files import write_netcdf
from jaxos4.study import load_study, run_on_cluster
from jaxos4.study.dataset import RESULTS_FILE, assemble, open_store

# The sockets of a killed worker are closed by the garbage collector.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The study, run in this process."""
    jax.clear_caches()  # programs of other modules may have another level of optimisation: other last digits
    return run_study(tmp_path_factory.mktemp("study"), NETWORKED)


@pytest.fixture(scope="module")
def cluster():
    """Two workers, each a process with one thread; they share this process's cache of compiled programs."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment(**how_we_compile()).items():
            patch.setenv(name, value)
        forked = dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"})  # with Dask imported
        with forked:
            # Workers are forked with the library, instead of importing it each. The first call sets Dask's own list.
            get_mp_context().set_forkserver_preload(["distributed", "jaxos4.study.run"])
            with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
                yield cluster


@pytest.fixture
def client(cluster):
    with Client(cluster, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
        yield client


def kill_a_worker(client: Client) -> None:
    process, *_ = client.run(os.getpid).values()
    os.kill(process, signal.SIGKILL)


def test_a_study_is_the_same_on_a_cluster_that_loses_workers(whole, client, tmp_path):
    study, out, done = load_study(specification(tmp_path, NETWORKED)), tmp_path / "out", []
    with open_store(out, study, "a cluster") as store:
        for _, number in run_on_cluster(store, client):
            done.append(number)
            if number in (2, 9):
                kill_a_worker(client)
        write_netcdf(out / RESULTS_FILE, assemble(store), 4)
    assert done[-1] == study.count
    assert cells(out) == cells(whole)
    assert (out / "networks" / "0000.net").read_bytes() == (whole / "networks" / "0000.net").read_bytes()
    xr.testing.assert_identical(results(out), results(whole))


def test_a_damaged_network_is_named_and_what_is_finished_is_not_computed_again(whole, client, tmp_path, run):
    specification(tmp_path, NETWORKED)
    out = shutil.copytree(whole, tmp_path / "out")
    network, study = out / "networks" / "0000.net", ("study", "spec.toml", "--out", "out")
    content, scheduler = network.read_bytes(), ("--scheduler", client.scheduler.address)
    network.write_bytes(content[: len(content) // 2])
    for index in (3, 7, 11):
        (out / "cells" / f"{index:08d}.npz").unlink()
    before = {path: path.stat().st_mtime_ns for path in out.glob("cells/0*")}
    for options in ((), scheduler):
        refused(run(*study, *options), "0000.net", "delete it")
    for trained in (True, False):
        network.write_bytes(content) if trained else network.unlink()
        (out / "cells" / "00000003.npz").unlink(missing_ok=True)
        code, said, err = run(*study, *scheduler)
        assert (code, err, "95 estimates" in said) == (0, "", True)
        assert network.read_bytes() == content
        assert cells(out) == cells(whole)
        assert before.items() <= {path: path.stat().st_mtime_ns for path in out.glob("cells/0*")}.items()


def test_a_cluster_that_is_not_there_or_without_workers_is_refused(run, tmp_path):
    specification(tmp_path, NETWORKED)
    study = ("study", "spec.toml", "--out", "out")
    refused(run(*study, "--scheduler", "nonsense://x"), "--scheduler nonsense://x")
    assert not (tmp_path / "out").exists()
    with LocalCluster(n_workers=0, dashboard_address=":0") as empty:
        refused(run(*study, "--scheduler", empty.scheduler_address), "no workers")
