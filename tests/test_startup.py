"""What a start costs: what each entry imports, and compiled programs that the next command finds again."""

import importlib
import inspect
import json
import os
import pathlib
import re
from typing import get_args

import jax
import pytest
from helpers import COMMAND, EACH, PROGRESS, how_we_compile, start

import jaxos4
from jaxos4._xla import add_flags
from jaxos4.cli import estimate, options
from jaxos4.cli._jax import prepare
from jaxos4.closed_loop import LOGGED
from jaxos4.design.task import CRITERIA
from jaxos4.estimators import ESTIMATORS
from jaxos4.excitation import EXCITATIONS
from jaxos4.export import TARGETS
from jaxos4.models import MODELS
from jaxos4.models.state import CHANNELS
from jaxos4.networks import ARCHITECTURES, FEATURES, NetworkEstimator
from jaxos4.simulation import METHODS

# Libraries that only some commands need, and that are slow to import.
HEAVY = set("diffrax lineax optax optimistix xarray h5netcdf h5py matplotlib jinja2 pandas dask".split())
CORE = {"jax", "equinox", "jaxtyping", "numpy", "msgspec"}
SIMULATE = ("simulate", "--duration", "0.1", "--out", "flight.csv")
NATIVE = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000,-unroll-full-max-count=15"
WIDE = "--xla_cpu_prefer_vector_width=512"
QUICK = "--xla_cpu_use_fusion_emitters=false"
OFF = "JAXOS4_NO_XLA_OPTIONS"


# What is imported, in one new process.

LINES = (
    ("--help", 0, "identifiability"),
    ("--version", 0, jaxos4.__version__),
    ("estimate --help", 0, "--estimator"),
    ("train --help", 0, "--steps"),
    ("compare --help", 0, "--quick"),
    ("none", 2, "none"),
    ("simulate", 2, "--out"),
    ("estimate flight.csv --estimator none", 2, "output-error"),
    ("estimate flight.csv --model none", 2, "corrected"),
    ("simulate --out flight.csv --excitation none", 2, "multisine"),
)
# After those lines: a shell asks for completions, and Python code uses the library. A preset is made at import, when
# JAX still rounds to float32; the user chooses double precision later.
LIBRARY = """
import os
os.environ |= {"_JAXOS4_COMPLETE": "complete_bash", "COMP_CWORD": "4"}
os.environ["COMP_WORDS"] = "jaxos4 estimate flight.csv --estimator "
sys.argv, completed = ["jaxos4"], io.StringIO()
with contextlib.redirect_stdout(completed), contextlib.suppress(SystemExit):
    main()
packages = lambda: sorted({name.split(".")[0] for name in sys.modules})
print(json.dumps([completed.getvalue().split(), packages()]))
import jaxos4
jaxos4.IBSS, jaxos4.identify, jaxos4.simulate, jaxos4.read_flight
print(json.dumps([os.environ["XLA_FLAGS"], packages()]))
jaxos4.report.write_report, jaxos4.report.write_flight_page, jaxos4.report.write_comparison
jaxos4.report.write_log_page
import jaxos4.report.design
print(json.dumps(packages()))
import jax, numpy as np
assert jax.numpy.asarray(jaxos4.OS4.mixer).dtype == np.float32
jax.config.update("jax_enable_x64", True)
assert jax.numpy.asarray(jaxos4.OS4.mixer).dtype == np.float64
assert float(jaxos4.OS4.mixer[3, 0]) == 3.13e-5 and float(jaxos4.OS4.inertia[2]) == 1.3e-2
assert abs(float(jaxos4.OS4.hover_speed) / (0.65 * 9.81 / 4 / 3.13e-5) ** 0.5 - 1) < 1e-15
"""


def test_a_command_imports_no_library_before_it_runs_and_the_package_imports_what_is_used():
    process = start(*(line for line, *_ in LINES), code=EACH + LIBRARY)
    assert process.returncode == 0, process.stderr
    *answers, (completed, packages), (flags, of_library), of_pages = map(json.loads, process.stdout.splitlines())
    for (line, code, said), (answered, ended, printed, imported) in zip(LINES, answers, strict=True):
        assert (answered, ended) == (line, code)
        assert said in printed, line
        assert not set(imported) & (HEAVY | CORE), line
    assert completed[: len(ESTIMATORS)] == list(ESTIMATORS)
    assert not set(packages) & (HEAVY | CORE)
    assert flags == f"{NATIVE} {WIDE}"
    assert "equinox" in of_library
    assert not set(of_library) & HEAVY
    assert "matplotlib" not in of_pages  # see `without_matplotlib`


@pytest.mark.slow
def test_a_first_import_inside_a_traced_function_leaks_no_tracer():
    code = """
import jax, jaxos4
with jax.checking_leaks():
    jax.jit(lambda x: [getattr(jaxos4, name) for name in dir(jaxos4)] and x)(1.0)
simulate = jax.jit(lambda x: jaxos4.simulate(model, x, omega, dt=0.01, method="diffrax").states)
model = jaxos4.PublishedOS4(jaxos4.OS4)
omega = jaxos4.multisine(jaxos4.OS4, duration=0.05)
assert (simulate(model.alpha) == simulate(model.alpha)).all()
import diffrax
"""
    process = start(code=code, **how_we_compile())
    assert process.returncode == 0, process.stderr


@pytest.mark.slow
def test_the_import_of_a_study_starts_no_backend_of_jax():
    """Workers of a cluster are forked from a process that has imported it, and the threads of a backend are lost."""
    set_devices = "jax.config.update('jax_num_cpu_devices', 2)"  # raises if one runs
    process = start(code=f"import jaxos4.study.run, jax; {set_devices}")
    assert process.returncode == 0, process.stderr


def test_all_public_names_are_there():
    for package in ("jaxos4", "jaxos4.estimators", "jaxos4.report"):
        module = importlib.import_module(package)
        assert all(getattr(module, name) is not None for name in dir(module))
    assert all(map(callable, (jaxos4.identify, jaxos4.simulate, jaxos4.identifiability)))
    with pytest.raises(AttributeError):
        jaxos4.nothing  # noqa: B018


@pytest.mark.slow
def test_the_choices_of_the_command_line_are_the_names_in_the_tables_and_a_command_keeps_settings(run):
    tables = {"Model": MODELS, "Excitation": EXCITATIONS, "Method": METHODS, "Sensors": LOGGED, "Channels": CHANNELS}
    tables |= {"Features": FEATURES, "Architecture": ARCHITECTURES, "Simulator": TARGETS, "Criterion": CRITERIA}
    for name, table in tables.items():
        kind = getattr(options, name)
        assert list(map(str, get_args(kind) or kind)) == list(table)
    defaults = {name: argument.default for name, argument in inspect.signature(estimate.train).parameters.items()}
    for name in ("noise", "steps", "features", "architecture"):
        assert defaults[name] == getattr(NetworkEstimator, name)
    before = json.dumps(jax.config.values, default=str, sort_keys=True)
    assert run(*SIMULATE)[0] == 0
    assert json.dumps(jax.config.values, default=str, sort_keys=True) == before


# Flags of XLA


@pytest.mark.parametrize(
    ("variables", "flags"),
    [
        ({}, f"{NATIVE} {WIDE}"),
        ({"XLA_FLAGS": "--own=1"}, f"--own=1 {NATIVE} {WIDE}"),
        ({"XLA_FLAGS": "--xla_backend_extra_options=own=1"}, f"--xla_backend_extra_options=own=1 {NATIVE} {WIDE}"),
        ({"XLA_FLAGS": NATIVE.replace("1000000000", "1000")}, f"{NATIVE.replace('1000000000', '1000')} {WIDE}"),
        ({"XLA_FLAGS": WIDE.replace("512", "128")}, f"{WIDE.replace('512', '128')} {NATIVE}"),
        ({"XLA_FLAGS": f"{WIDE} {NATIVE}"}, f"{WIDE} {NATIVE}"),
        ({"XLA_FLAGS": "flags.txt"}, "flags.txt"),
        ({"XLA_FLAGS": "--own=1", OFF: "1"}, "--own=1"),
        ({OFF: "1"}, None),
    ],
)
def test_loops_become_fast_and_no_flag_of_the_user_is_replaced(variables, flags, monkeypatch):
    for name in ("XLA_FLAGS", OFF):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    add_flags()
    assert os.environ.get("XLA_FLAGS") == flags


def test_a_command_compiles_quickly_and_a_study_of_many_flights_is_fully_optimised(run, tmp_path, monkeypatch):
    (tmp_path / "study.toml").write_text("flights = 2")
    for arguments, quick in ((SIMULATE, True), (("study", "study.toml", "--out", "study", "--dry-run"), False)):
        monkeypatch.setenv("XLA_FLAGS", "")
        assert run(*arguments)[0] == 0
        assert (QUICK in os.environ["XLA_FLAGS"]) == quick


# Compiled programs that are kept

# Prints how many programs the cache of compiled programs gave, and how many it did not have.
COUNT = """
import atexit, collections, jax
seen = collections.Counter()
jax.monitoring.register_event_listener(lambda event, **_: seen.update([event.rsplit('/', 1)[-1]]))
atexit.register(lambda: print('\\ncounted', seen['cache_hits'], seen['cache_misses']))
"""


@pytest.mark.slow
def test_the_second_command_finds_the_programs_of_the_first(tmp_path):
    def counted():
        home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
        process = start(*SIMULATE, code=COUNT + COMMAND, cwd=tmp_path, **home)
        faults = [line for line in process.stderr.splitlines() if not re.fullmatch(PROGRESS, line)]
        assert (process.returncode, faults) == (0, []), process.stderr  # beside progress
        return tuple(map(int, process.stdout.splitlines()[-1].split()[1:]))

    hits, misses = counted()
    assert (hits, misses > 1) == (0, True)
    folder = tmp_path / "cache" / "jaxos4" / "compiled"
    assert len(list(folder.glob("*-atime"))) == misses  # when each was used last: JAX keeps a limit
    next(folder.glob("*-cache")).write_bytes(b"cut")  # compiled again, in silence
    assert counted()[0] == misses - 1


FOLDER, SIZE = "jax_compilation_cache_dir", "jax_compilation_cache_max_size"
ENABLED, LEAST_TIME = "jax_enable_compilation_cache", "jax_persistent_cache_min_compile_time_secs"


@pytest.fixture
def kept_in(monkeypatch):
    """Prepares JAX for a command with these environment variables. Returns where it keeps programs, if it does."""
    before = {name: jax.config.values[name] for name in (FOLDER, SIZE, ENABLED, LEAST_TIME)}

    def call(chosen=None, **variables):
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        jax.config.update(FOLDER, chosen)
        prepare(batch=False)
        return jax.config.values[FOLDER] if jax.config.values[ENABLED] else None

    yield call
    for name, value in before.items():
        jax.config.update(name, value)


def test_programs_are_kept_in_the_folder_of_the_user_unless_told_otherwise(kept_in, tmp_path):
    cache = tmp_path / "cache"
    jax.config.update(LEAST_TIME, 1.0)
    assert kept_in(XDG_CACHE_HOME=str(cache)) == str(cache / "jaxos4" / "compiled")
    assert jax.config.values[LEAST_TIME] == 0
    assert jax.config.values[SIZE] == 1 << 30
    # A folder that the user chose is used; one that cannot be written is not.
    assert kept_in(str(tmp_path / "chosen"), XDG_CACHE_HOME=str(tmp_path / "default")) == str(tmp_path / "chosen")
    assert not (tmp_path / "default").exists()
    (tmp_path / "file").touch()
    assert kept_in(XDG_CACHE_HOME=str(tmp_path / "file")) is None
    assert kept_in(XDG_CACHE_HOME=str(cache), JAXOS4_NO_CACHE="1") is None


@pytest.mark.skipif(os.name != "posix", reason="changes who may write")
def test_programs_are_kept_only_where_nobody_else_can_write(kept_in, tmp_path, capsys):
    folder = tmp_path / "cache" / "jaxos4"
    (folder / "compiled").mkdir(parents=True)
    for open_one, mode in ((folder, 0o777), (folder / "compiled", 0o770)):
        open_one.chmod(mode)
        assert kept_in(XDG_CACHE_HOME=str(tmp_path / "cache")) is None
        said = capsys.readouterr().err
        assert said.startswith(f"jaxos4: {open_one}: others can write to it, so it keeps no programs;")
        open_one.chmod(0o700)
    assert kept_in() == str(folder / "compiled")


def test_nothing_is_kept_without_a_home_folder(kept_in, tmp_path, monkeypatch):
    def no_home(*arguments, **options):
        raise RuntimeError("no home folder")

    monkeypatch.chdir(tmp_path)
    for answer in (no_home, lambda *arguments, **options: pathlib.Path("nowhere")):
        monkeypatch.setattr("platformdirs.user_cache_path", answer)
        assert kept_in() is None
    assert list(tmp_path.iterdir()) == []
