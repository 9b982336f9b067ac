"""What a start costs: what each entry imports, and compiled programs that the next command finds again."""

import importlib
import inspect
import json
import pathlib
import re
from typing import get_args

import jax
import pytest
from helpers import COMMAND, EACH, how_we_compile, start

import jaxos4
from jaxos4.cli import estimate, options
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
# Prints the loaded packages when the process ends, however it ends.
LIST = "import atexit, sys; atexit.register(lambda: print('\\nloaded', *{name.split('.')[0] for name in sys.modules}));"
# Prints how many programs the cache of compiled programs gave, how many it did not have, and the flags of XLA.
COUNT = """
import atexit, collections, jax, os
seen = collections.Counter()
jax.monitoring.register_event_listener(lambda event, **_: seen.update([event.rsplit('/', 1)[-1]]))
atexit.register(lambda: print('\\ncounted', seen['cache_hits'], seen['cache_misses'], os.environ.get('XLA_FLAGS')))
"""


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


def test_help_and_mistakes_import_no_library():
    process = start(*(line for line, *_ in LINES), code=EACH)
    assert process.returncode == 0, process.stderr
    answers = [json.loads(answer) for answer in process.stdout.splitlines()]
    for (line, code, said), (answered, ended, printed, packages) in zip(LINES, answers, strict=True):
        assert (answered, ended) == (line, code)
        assert said in printed, line
        assert not set(packages) & (HEAVY | CORE), line


@pytest.mark.slow
def test_shell_completion_offers_estimators_and_imports_no_library():
    line = {"COMP_WORDS": "jaxos4 estimate flight.csv --estimator ", "COMP_CWORD": "4"}
    printed, packages = loaded(COMMAND, _JAXOS4_COMPLETE="complete_bash", **line)
    assert printed.split()[: len(ESTIMATORS)] == list(ESTIMATORS)
    assert not packages & (HEAVY | CORE)


@pytest.mark.slow
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
        kind = getattr(options, name)
        assert list(map(str, get_args(kind) or kind)) == list(table)
    defaults = {name: argument.default for name, argument in inspect.signature(estimate.train).parameters.items()}
    for name in ("noise", "steps", "features", "architecture"):
        assert defaults[name] == getattr(NetworkEstimator, name)
    before = json.dumps(jax.config.values, default=str, sort_keys=True)
    assert run(*SIMULATE)[0] == 0
    assert json.dumps(jax.config.values, default=str, sort_keys=True) == before


def ended(*arguments: str, cwd: pathlib.Path, **environment: str) -> tuple[int, int, bool]:
    """Of a command: programs from the cache, programs that it did not have, and whether all compiled quickly."""
    process = start(*arguments, code=COUNT + COMMAND, cwd=cwd, **environment)
    faults = [line for line in process.stderr.splitlines() if not re.fullmatch(r"jaxos4: .+, \d+ s", line)]  # progress
    assert (process.returncode, faults) == (0, []), process.stderr
    hits, misses, flags = process.stdout.splitlines()[-1].split(maxsplit=3)[1:]
    return int(hits), int(misses), "--xla_cpu_use_fusion_emitters=false" in flags


@pytest.mark.slow
def test_the_second_command_finds_the_programs_of_the_first_unless_told_otherwise(tmp_path):
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    hits, misses, quickly = ended(*SIMULATE, cwd=tmp_path, **home)
    assert (hits, misses > 1, quickly) == (0, True, True)
    folder = tmp_path / "cache" / "jaxos4" / "compiled"
    assert len(list(folder.glob("*-atime"))) == misses  # when each was used last: JAX keeps a limit
    next(folder.glob("*-cache")).write_bytes(b"cut")  # compiled again, in silence
    assert ended(*SIMULATE, cwd=tmp_path, **home)[0] == misses - 1
    off = {"JAXOS4_NO_CACHE": "1", "JAXOS4_NO_XLA_OPTIONS": "1"}
    assert ended(*SIMULATE, cwd=tmp_path, **off, **home) == (0, 0, False)
    # A folder that the user chose is used; one that cannot be written is not.
    chosen = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "chosen"), "XDG_CACHE_HOME": str(tmp_path / "default")}
    assert ended(*SIMULATE, cwd=tmp_path, **home | chosen)[0] == 0
    assert len(list((tmp_path / "chosen").glob("*-cache"))) == misses
    assert not (tmp_path / "default").exists()
    assert ended(*SIMULATE, cwd=tmp_path, XDG_CACHE_HOME=str(tmp_path / "flight.csv"))[0] == 0


@pytest.mark.slow
def test_a_reader_that_has_gone_is_no_error_of_the_program():
    command = COMMAND.replace(
        "main()", "import os; reader, writer = os.pipe(); os.close(reader); os.dup2(writer, 1); main()"
    )
    process = start("--help", code=command)
    assert (process.returncode, process.stderr) == (1, "")


@pytest.mark.slow
def test_a_study_of_many_flights_is_fully_optimised(tmp_path):
    (tmp_path / "study.toml").write_text("")
    assert not ended("study", "study.toml", "--out", "study", "--dry-run", cwd=tmp_path)[2]


NATIVE = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000,-unroll-full-max-count=15"
WIDE = "--xla_cpu_prefer_vector_width=512"
OFF = "JAXOS4_NO_XLA_OPTIONS"


@pytest.mark.slow
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
        ({OFF: "1"}, "None"),
    ],
)
def test_the_import_makes_loops_fast_and_replaces_no_flag(variables, flags):
    process = start(code="import os, jaxos4; print(os.environ.get('XLA_FLAGS'))", **variables)
    assert process.stdout.strip() == flags
