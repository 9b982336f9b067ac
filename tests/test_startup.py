"""What a start costs: what each entry imports, and compiled programs that the next command finds again."""

import importlib
import inspect
import json
import os
import pathlib
import subprocess
import sys
from typing import get_args

import jax
import numpy as np
import pytest
from helpers import how_we_compile
from jax._src import compiler

import jaxos4
from jaxos4._xla import LOOP_FLAGS, NO_OPTIONS, make_loops_fast, quick_jit
from jaxos4.cli import _jax, _options, estimate
from jaxos4.closed_loop import LOGGED
from jaxos4.design.task import CRITERIA
from jaxos4.estimators import ESTIMATORS
from jaxos4.excitation import EXCITATIONS
from jaxos4.export import TARGETS
from jaxos4.models import MODELS
from jaxos4.models.state import CHANNELS
from jaxos4.networks import ARCHITECTURES, FEATURES, NetworkEstimator
from jaxos4.simulation import METHODS

ROOT = pathlib.Path(__file__).resolve().parents[1]
# Libraries that only some commands need, and that are slow to import.
HEAVY = set("diffrax lineax optax optimistix xarray h5netcdf h5py matplotlib jinja2 pandas dask".split())
CORE = {"jax", "equinox", "jaxtyping", "numpy", "msgspec"}
SIMULATE = ("simulate", "--duration", "0.1", "--out", "flight.csv")
COMMAND = "import sys; sys.argv[0] = 'jaxos4'; from jaxos4.cli import main; main()"
# Prints the loaded packages when the process ends, however it ends.
LIST = "import atexit, sys; atexit.register(lambda: print('\\nloaded', *{name.split('.')[0] for name in sys.modules}));"
# Counts the programs that the cache of compiled programs gave, and those that it did not have.
COUNT = """
import atexit, collections, jax
seen = collections.Counter()
jax.monitoring.register_event_listener(lambda event, **_: seen.update([event.rsplit('/', 1)[-1]]))
atexit.register(lambda: print('\\ncounted', seen['cache_hits'], seen['cache_misses']))
"""


def start(*arguments: str, code: str = COMMAND, cwd=None, **environment: str) -> subprocess.CompletedProcess[str]:
    """Runs Python code in another process, without the tests' cache of compiled programs."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "JAXOS4_"))}
    variables = inherited | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]]), "JAX_PLATFORMS": "cpu"}
    process = [sys.executable, "-c", code, *arguments]
    return subprocess.run(process, env=variables | environment, cwd=cwd, capture_output=True, text=True, timeout=300)


def loaded(code: str, **environment: str) -> tuple[str, set[str]]:
    """What the code prints, and the names of the packages that it imports."""
    process = start(code=LIST + code, **environment)
    assert process.returncode == 0, process.stderr
    return process.stdout, set(process.stdout.splitlines()[-1].split()[1:])


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
# Runs each line of its arguments. Prints its code, what it printed, and the packages that are loaded after it.
EACH = """
import contextlib, io, json, sys
from jaxos4.cli import main
for line in sys.argv[1:]:
    sys.argv, printed = ["jaxos4", *line.split()], io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main()
        except SystemExit as stop:
            code = stop.code or 0
    packages = sorted({name.split(".")[0] for name in sys.modules})
    sys.__stdout__.write(json.dumps([line, code, printed.getvalue(), packages]) + "\\n")
"""


def test_help_and_mistakes_import_no_library():
    process = start(*(line for line, *_ in LINES), code=EACH)
    assert process.returncode == 0, process.stderr
    answers = [json.loads(answer) for answer in process.stdout.splitlines()]
    for (line, code, said), (answered, ended, printed, packages) in zip(LINES, answers, strict=True):
        assert (answered, ended) == (line, code)
        assert said in printed, line
        assert not set(packages) & (HEAVY | CORE), line


def test_shell_completion_offers_estimators_and_imports_no_library():
    line = {"COMP_WORDS": "jaxos4 estimate flight.csv --estimator ", "COMP_CWORD": "4"}
    printed, packages = loaded(COMMAND, _JAXOS4_COMPLETE="complete_bash", **line)
    assert printed.split()[: len(ESTIMATORS)] == list(ESTIMATORS)
    assert not packages & (HEAVY | CORE)


def test_the_package_imports_what_is_used_and_presets_outlive_a_change_of_precision():
    """A preset is made at import, when JAX still rounds to float32. The user chooses double precision later."""
    code = """
import sys, jaxos4
print(*{name.split(".")[0] for name in sys.modules})
jaxos4.IBSS, jaxos4.identify, jaxos4.simulate, jaxos4.read_flight
import jax, numpy as np
assert jax.numpy.asarray(jaxos4.OS4.mixer).dtype == np.float32
jax.config.update("jax_enable_x64", True)
assert jax.numpy.asarray(jaxos4.OS4.mixer).dtype == np.float64
assert float(jaxos4.OS4.mixer[3, 0]) == 3.13e-5 and float(jaxos4.OS4.inertia[2]) == 1.3e-2
assert abs(float(jaxos4.OS4.hover_speed) / (0.65 * 9.81 / 4 / 3.13e-5) ** 0.5 - 1) < 1e-15
"""
    printed, packages = loaded(code)
    assert not set(printed.split("\n")[0].split()) & (HEAVY | {"jax", "numpy"})
    assert "equinox" in packages
    assert not packages & HEAVY


def test_all_public_names_are_there():
    for package in ("jaxos4", "jaxos4.estimators", "jaxos4.report"):
        module = importlib.import_module(package)
        assert all(getattr(module, name) is not None for name in dir(module))
    assert all(map(callable, (jaxos4.identify, jaxos4.simulate, jaxos4.identifiability)))
    with pytest.raises(AttributeError):
        jaxos4.nothing  # noqa: B018


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


def test_the_choices_of_the_command_line_are_the_names_in_the_tables_and_a_command_keeps_settings(run):
    tables = {"Model": MODELS, "Excitation": EXCITATIONS, "Method": METHODS, "Sensors": LOGGED}
    tables |= {
        "Channels": CHANNELS,
        "Features": FEATURES,
        "Architecture": ARCHITECTURES,
        "Simulator": TARGETS,
        "Criterion": CRITERIA,
    }
    for name, table in tables.items():
        kind = getattr(_options, name)
        assert list(map(str, get_args(kind) or kind)) == list(table)
    defaults = {name: argument.default for name, argument in inspect.signature(estimate.train).parameters.items()}
    for name in ("noise", "steps", "features", "architecture"):
        assert defaults[name] == getattr(NetworkEstimator, name)
    before = json.dumps(jax.config.values, default=str, sort_keys=True)
    assert run(*SIMULATE)[0] == 0
    assert json.dumps(jax.config.values, default=str, sort_keys=True) == before


def programs(*arguments: str, cwd: pathlib.Path, **environment: str) -> tuple[int, int]:
    """How many programs of a command came from the cache, and how many did not; it must succeed and stay silent."""
    process = start(*arguments, code=COUNT + COMMAND, cwd=cwd, **environment)
    assert (process.returncode, process.stderr) == (0, ""), process.stderr
    hits, misses = process.stdout.splitlines()[-1].split()[1:]
    return int(hits), int(misses)


def test_the_second_command_finds_the_programs_of_the_first_unless_told_otherwise(tmp_path):
    """The first one is the console command. It ends the process without the clean-up of Python: nothing is lost."""
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    console = COMMAND.replace("main", "console")
    first = start(*SIMULATE, code=console, cwd=tmp_path, **home)
    assert (first.returncode, first.stderr, "flight.csv: 11 samples" in first.stdout) == (0, "", True)
    assert len((tmp_path / "flight.csv").read_text().splitlines()) == 12
    chosen = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "chosen"), "XDG_CACHE_HOME": str(tmp_path / "default")}
    refused = start("estimate", "nowhere.csv", code=console, cwd=tmp_path, **home | chosen)
    assert (refused.returncode, "nowhere.csv: there is no such file" in refused.stderr) == (2, True)
    assert not (tmp_path / "default").exists()
    compiled = (tmp_path / "cache" / "jaxos4" / "programs").glob("*")
    cut, *others = (path for path in compiled if not path.name.startswith("jaxos4-"))
    cut.write_bytes(cut.read_bytes()[:100])  # compiled again, in silence
    assert programs(*SIMULATE, cwd=tmp_path, **home)[0] == len(others) > 1
    assert programs(*SIMULATE, cwd=tmp_path, JAXOS4_NO_CACHE="1", **home) == (0, 0)


def test_the_cache_is_limited_and_keeps_what_was_used_last_and_a_folder_may_be_unusable(tmp_path, monkeypatch):
    for age, name in enumerate("abcd"):
        (tmp_path / name).write_bytes(b"0" * 10)
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    _jax._remove_oldest(tmp_path, 40)
    assert len(list(tmp_path.iterdir())) == 4
    _jax._remove_oldest(tmp_path, 39)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a"]
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "a"))  # not a folder
    assert _jax._usable_folder() is None


NATIVE, WIDE = LOOP_FLAGS.values()


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
        ({"XLA_FLAGS": "--own=1", NO_OPTIONS: "1"}, "--own=1"),
        ({NO_OPTIONS: "1"}, None),
    ],
)
def test_the_import_makes_loops_fast_and_replaces_no_flag(variables, flags, monkeypatch, recwarn):
    for name in ("XLA_FLAGS", NO_OPTIONS):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    jax.devices()
    make_loops_fast()
    assert os.environ.get("XLA_FLAGS") == flags
    # JAX has computed in this process, so that a new flag comes too late.
    assert len(recwarn) == (flags != variables.get("XLA_FLAGS"))
    assert all("JAX has computed before `import jaxos4`" in str(each.message) for each in recwarn)


@pytest.mark.parametrize("off", [False, True])
def test_only_a_program_that_is_called_alone_is_compiled_quickly(off, monkeypatch):
    """By the options of each program that is compiled: the whole key of the cache would be private to JAX."""
    quickly, original = [], compiler.get_compile_options

    def spy(*args, **options):
        quickly.append(bool(options.get("env_options_overrides")))
        return original(*args, **options)

    monkeypatch.setattr(compiler, "get_compile_options", spy)
    monkeypatch.setenv(NO_OPTIONS, "1" if off else "")
    twice, x, before = quick_jit(lambda x, *, scale: 2 * x * scale), np.ones(3), os.environ.get("XLA_FLAGS")
    uses = {
        "alone": lambda x, scale: twice(x, scale=scale),
        "jit": jax.jit(lambda x, scale: twice(x, scale=scale)),
        "vmap": jax.vmap(lambda x, scale: twice(x, scale=scale), in_axes=(0, None)),
        "grad": jax.grad(lambda x, scale: twice(x, scale=scale).sum()),
        "loop": lambda x, scale: jax.lax.scan(lambda c, _: (twice(c, scale=scale), None), x, None, 1)[0],
    }
    for name, use in uses.items():
        quickly.clear()
        np.testing.assert_array_equal(use(x, 1.0), np.full(3, 2.0))
        assert any(quickly) == (name == "alone" and not off), name
    assert os.environ.get("XLA_FLAGS") == before
