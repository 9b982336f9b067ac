"""Settings and fixtures of all tests: precision, platform, runtime shape checks, property tests, real flights."""

import gc
import json
import os
import pathlib
import sys
from collections.abc import Iterator

import hypothesis
import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", os.environ.get("JAX_PLATFORMS") or "cpu")
# Workers and later runs share the compiled programs.
CACHE = os.environ.get("JAX_COMPILATION_CACHE_DIR") or pathlib.Path(__file__).resolve().parents[1] / ".pytest_cache/jax"
jax.config.update("jax_compilation_cache_dir", str(CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

# Also in a container that sets PYTHONDONTWRITEBYTECODE: to compile the checked modules and the tests takes 3 s.
sys.dont_write_bytecode = False
# Tests compile for longer than they compute: XLA hardly optimises their programs, which then compile in a third of the
# time, and compute three to five times as long. The other cores have workers, so a program is compiled in one part.
# Tests with `optimised` have level 1, with which loops run as fast as by default.
QUICK = [
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",
    "--xla_backend_optimization_level=1",
]
os.environ["XLA_FLAGS"] = " ".join(dict.fromkeys([*os.environ.get("XLA_FLAGS", "").split(), *QUICK]))
jax.config.update("jax_disable_most_optimizations", True)
# Files of the package whose annotations are not checked. The one that decodes a log number by number has no arrays, and
# the checks would take four times as long as the decoding.
UNCHECKED = ("__init__", "blackbox_frames")
PROCESSES = 8  # at most: a worker holds up to 2 GB
# Files that share programs and answers: one worker runs them, one after the other. The first begin first, as they take
# longest.
TOGETHER = (
    ("vehicle",),
    ("experiments_vehicle", "experiments_truth", "experiments_peers", "judge"),
    ("errors", "estimators", "recursive", "diagnostics", "identifiability"),
    ("network", "hybrid", "accelerators"),
    ("design",),
    ("closed_loop", "closed_loop_effects"),
)

hypothesis.settings.register_profile("ci", derandomize=True, deadline=None)
hypothesis.settings.load_profile("ci")


def pytest_configure(config: pytest.Config) -> None:
    """Checks shapes and types at each call if `JAXOS4_CHECK_TYPES` is set. Workers get one thread of OpenBLAS each."""
    if config.getoption("numprocesses", None) and not hasattr(config, "workerinput"):
        # Workers inherit this. They keep the cores busy, so that more threads would wait for each other.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        return  # this process only hands tests to workers
    if os.environ.get("JAXOS4_CHECK_TYPES"):
        package = pathlib.Path(__file__).resolve().parents[1] / "jaxos4"
        modules = [path.relative_to(package.parent) for path in package.rglob("*.py") if path.stem not in UNCHECKED]
        jaxtyping.install_import_hook([".".join(each.with_suffix("").parts) for each in modules], "typechecker.check")
    import jaxos4  # noqa: F401 - after the hook; adds its own XLA flags


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """A worker for each core; none for files that are named, which begin sooner without."""
    return 0 if config.option.file_or_dir else min(os.cpu_count() or 1, PROCESSES)


def group_of(nodeid: str) -> tuple[int, str]:
    """The files that one worker runs together with that of a test; they sort as they start."""
    name = pathlib.PurePath(nodeid.split("::")[0]).stem.removeprefix("test_")
    return next(((place, files[0]) for place, files in enumerate(TOGETHER) if name in files), (len(TOGETHER), name))


@pytest.hookimpl(tryfirst=True)  # before slow tests are left out
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Groups with slow tests start first, so that the workers end together."""
    slow = {group_of(item.nodeid) for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (group_of(item.nodeid) not in slow, group_of(item.nodeid)))


def pytest_collection_finish() -> None:
    """Tracing makes few cycles and much else: the garbage collector comes rarely, and skips what was imported."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(200_000, 10, 10)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log):
    """One worker runs all tests of a group, so that fixtures, answers and compiled programs are made once."""
    from xdist.scheduler import LoadFileScheduling

    class LoadGroupsOfFiles(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return str(group_of(nodeid))

    config.option.loadscopereorder = False
    return LoadGroupsOfFiles(config, log) if config.getvalue("dist") == "load" else None  # the default of `-n`


@pytest.hookimpl(trylast=True)  # after the fixtures of a file
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Compiled programs hold memory maps, of which a process may have 65,530: they end with their group of files."""
    if nextitem is None or group_of(item.nodeid) != group_of(nextitem.nodeid):
        jax.clear_caches()


def computing() -> Iterator[None]:
    """For tests that compute for longer than they compile. A program keeps the level of its first use."""
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


optimised = pytest.fixture(computing)
all_optimised = pytest.fixture(computing, scope="module")  # also the fixtures of a file


@pytest.fixture(scope="session")
def shared_flights() -> pathlib.Path:
    """The folder of real flight logs: `$JAXOS4_FLIGHTS`, or `../shared/flights` beside the checkout."""
    beside = pathlib.Path(__file__).resolve().parents[2] / "shared" / "flights"
    folder = pathlib.Path(os.environ.get("JAXOS4_FLIGHTS") or beside)
    if not folder.is_dir():
        pytest.skip(f"no real flights at {folder}: set JAXOS4_FLIGHTS to the folder that holds them")
    return folder


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Runs one command in an empty folder. Returns its exit code, output and error output."""
    from jaxos4.cli import main  # after the hook

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("JAX_NUM_CPU_DEVICES", "1")  # the devices of this process are fixed by now
    monkeypatch.setattr("jaxos4.cli._shared.PERIOD", 1e6)  # a slow machine prints the same

    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["jaxos4", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        out, err = capsys.readouterr()
        return stop.value.code or 0, out, err

    return call


@pytest.fixture
def save(tmp_path):
    """Writes a file, by default one whose name says nothing of its format."""

    def write(content: bytes | str, name: str = "flight.log") -> pathlib.Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.fixture
def write(save):
    """Writes a result as the file `found.json`."""
    return lambda result: save(result if isinstance(result, str) else json.dumps(result), "found.json")
