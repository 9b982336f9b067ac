"""Settings and fixtures of all tests: precision, platform, runtime shape checks, property tests, real flights."""

import atexit
import gc
import os
import pathlib
import re
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
# Before the first import of jaxos4: all its annotated functions and modules are checked. The two files that decode a
# log number by number have no arrays, and the checks would take four times as long as the decoding.
PACKAGE = pathlib.Path(__file__).resolve().parents[1] / "jaxos4"
UNCHECKED = ("__init__", "blackbox_frames")
modules = [path.relative_to(PACKAGE.parent) for path in PACKAGE.rglob("*.py") if path.stem not in UNCHECKED]
jaxtyping.install_import_hook([".".join(module.with_suffix("").parts) for module in modules], "typechecker.check")

from jaxos4 import _xla  # noqa: E402
from jaxos4.cli._jax import collect_rarely  # noqa: E402

collect_rarely()
# Before JAX starts to compute: all programs compile as the program of one flight does, because tests compile for longer
# than they compute. The other cores have workers: a program compiled in parts takes a tenth more time of all cores.
OURS = " ".join(
    [*_xla.LOOP_FLAGS.values(), *(f"--{name}={value}".lower() for name, value in _xla.QUICK.items())]
    + ["--xla_cpu_parallel_codegen_split_count=1"]
)
if os.environ.get("XLA_FLAGS") == " ".join(_xla.LOOP_FLAGS.values()) and jax.__version__.startswith(_xla.KNOWN_TO):
    os.environ |= {"XLA_FLAGS": OURS, _xla.NO_OPTIONS: "1"}
# In a worker, the controller has set them.
FLAGS_ARE_OURS = os.environ.get("XLA_FLAGS") == OURS

hypothesis.settings.register_profile("ci", derandomize=True, deadline=None)
hypothesis.settings.load_profile("ci")

# Modules that share programs, networks and estimates: one worker runs them, one after another.
TOGETHER = (
    ("estimators", "errors", "searches", "recursive", "multiple_shooting", "diagnostics", "identifiability"),
    ("network", "hybrid", "accelerators"),
    ("vehicle", "vehicle_likelihood"),
)
# The slowest modules start first, so that the workers end together.
LONGEST = (
    *("experiments", "estimators", "vehicle", "experiments_vehicle", "network", "design", "study_resume"),
    *("study_cluster", "startup", "cli", "predict", "closed_loop", "study", "report_browser", "closed_loop_effects"),
    "means",
    *("programs", "compare", "shooting", "unknowns", "filter_error", "flight_model_fits", "identify", "simulate"),
)


def work_of(path: str) -> tuple[str, int]:
    """The first of the modules that run together with that of a path, and its place among them."""
    name = pathlib.PurePath(path).stem.removeprefix("test_")
    return next(((group[0], group.index(name)) for group in TOGETHER if name in group), (name, 0))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sorts the modules. The order of the tests in a module does not change."""

    def place(item: pytest.Item) -> tuple[int, int]:
        first, number = work_of(item.path.name)
        return LONGEST.index(first) if first in LONGEST else len(LONGEST), number

    items.sort(key=place)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A worker ends at once: freeing its programs takes ten seconds, after which the controller would kill it."""
    if hasattr(session.config, "workeroutput"):
        atexit.register(os._exit, 0)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log):
    """One worker runs all tests of a module, so that its fixtures and compiled programs are made once."""
    if config.getvalue("dist") != "load":  # the default of `-n`
        return None
    from xdist.scheduler import LoadScopeScheduling

    class Together(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return work_of(nodeid.partition("::")[0])[0]

    config.option.loadscopereorder = False
    return Together(config, log)


# Modules that compute for longer than they compile. XLA hardly optimises the programs of the others, which then compile
# in a third of the time, and compute three to five times as long. A program keeps the level of its first use: the
# fixtures below act on what a test is the first to compile, and not on fixtures of the module.
COMPUTING = {"design"}


@pytest.fixture(scope="module", autouse=True)
def programs_are_optimised_if_it_pays(request: pytest.FixtureRequest) -> None:
    """The default of a module. With the user's own `XLA_FLAGS`, all programs are optimised."""
    hardly = FLAGS_ARE_OURS and request.path.stem.removeprefix("test_") not in COMPUTING
    jax.config.update("jax_disable_most_optimizations", hardly)


def compiling(*, quickly: bool) -> Iterator[None]:
    """Sets whether XLA hardly optimises, until the test ends."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", quickly)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture
def optimised() -> Iterator[None]:
    """For a test that computes for long, in a module that does not."""
    yield from compiling(quickly=False)


@pytest.fixture
def quickly_compiled() -> Iterator[None]:
    """For a test that compiles for longer than it computes, in a module of `COMPUTING`."""
    yield from compiling(quickly=FLAGS_ARE_OURS)


MOST_MAPS = 30_000


@pytest.fixture(scope="module", autouse=True)
def compiled_programs_end_before_the_process_does() -> Iterator[None]:
    """Compiled programs hold memory maps. A process dies at the kernel's limit of 65,530; one module adds 25,000."""
    yield
    maps = pathlib.Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()  # programs in reference cycles


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

    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["jaxos4", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        out, err = capsys.readouterr()
        return stop.value.code or 0, out, err

    return call


@pytest.fixture
def run_three_ways(run, tmp_path, monkeypatch):
    """Runs a command that writes `out.json`: without kept programs, with those that it keeps, and with those of files.

    Returns code, output and content of each, without the time that it took.
    """
    from jaxos4 import _programs
    from jaxos4.cli._jax import NO_CACHE

    folder, names = tmp_path / "programs", ("jax_enable_compilation_cache", "jax_compilation_cache_dir")
    before = {name: jax.config.values[name] for name in names}
    folder.mkdir(mode=0o700)

    def call(*arguments: str) -> list[tuple[int, str, str]]:
        answers = []
        jax.config.update("jax_compilation_cache_dir", str(folder))
        monkeypatch.delenv(_xla.NO_OPTIONS, raising=False)  # with it, no program is kept
        for switched_off, write in (("1", _programs._write), ("", _programs._write), ("", None)):
            jax.config.update("jax_enable_compilation_cache", True)
            monkeypatch.setenv(NO_CACHE, switched_off)
            monkeypatch.setattr(_programs, "_programs", {})  # as in another process
            monkeypatch.setattr(_programs, "_surroundings", [])
            monkeypatch.setattr(_programs, "_write", write)  # tracing would call it
            code, out, _ = run(*arguments)
            written = re.sub('"seconds": .*', "", (tmp_path / "out.json").read_text())
            answers.append((code, re.sub(r"rollouts, [\d.]+ s\b", "", out), written))
            assert any(folder.glob("jaxos4-*")) == (not switched_off)
        return answers

    yield call
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture
def save(tmp_path):
    """Writes a file, by default one whose name says nothing of its format."""

    def write(content: bytes | str, name: str = "flight.log") -> pathlib.Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write
