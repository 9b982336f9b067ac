"""The specification of a study: what it may say, and how a wrong one is refused."""

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
from helpers import refused
from hypothesis import given, settings, strategies as st
from small_study import AIRFRAME, specification

import jaxos4
from jaxos4.study import Study, load_study

MINE = 'airframes = ["mine"]\n' + AIRFRAME
# Refused with a message that names the key.
WRONG_VALUES = (
    "flights = 1.5", "flights = 0", 'models = "published"', 'excitations = ["wobble"]', 'methods = ["rk5"]',
    'fit_method = "diffrax"', 'noises = ["pink"]', 'channels = ["smell"]', 'estimators = ["oracle"]',
    'initial_state = "hidden"', "scales = [-1.0]", "scales = [nan]", "scales = [inf]",
    "widths = [0.0]", "durations = [-1.0]", "durations = [inf]", "durations = [0.01]", "durations = [1e300]",
    "dt = nan", "dt = inf", "dt = 0", "seed = -1", "seed = 9223372036854775808", "batch = 0", "airframe = 3",
    'title = "two\\nlines"', 'title = "\\u0000"',
)  # fmt: skip
WRONG_SPECIFICATIONS = [
    ("flites = 3", "unknown key `flites`; choose from title, models,"),
    ('flights = "many"', "`flights`: expected a whole number, got a string; correct it."),
    ("network = 3", "`network`: expected a table, got a whole number"),
    ("network = { layers = 3 }", "[network]: unknown key `layers`; choose from steps,"),
    ('network = { hybrid_channels = "none" }', "`network.hybrid_channels`: unknown 'none'; choose from rates,"),
    ('models = ["newton"]', "`models`: unknown 'newton'; choose from published, corrected"),
    ('airframes = ["boeing"]', "`airframes`: unknown 'boeing'; choose from os4,"),
    ('truth = "guess"', "`truth`: unknown 'guess'; choose from airframe, drawn"),
    ("scales = []", "`scales` is empty"),
    ("scales = [1, 1.0]", "`scales` names a value twice"),
    ("flights = 1_000_000_000", "cells"),
    ('durations = [0.5]\nexcitations = ["chirp"]', "`excitations`: chirp of 0.5 s by os4: `duration`"),
    ("dt = 0.5", "`excitations`: multisine of 5 s by os4: `tones`"),
    (MINE + "max_rotor_speed = 230", "`excitations`: multisine of 5 s by mine: `amplitude`"),
    ("[network]\nsteps = 0", "network.steps"),
    ("[network]\nsteps = 100_000_000", "network.steps"),
    ("[network]\nheld_out = 10", "network.held_out"),
    (MINE + "wheels = 4", "[airframe.mine]: `wheels` is not a known key"),
    (MINE.replace("mass = 0.6", "mass = -0.6"), "[airframe.mine]: `mass`"),
    (MINE + "max_rotor_speed = inf", "[airframe.mine]: not finite"),
    (AIRFRAME, "[airframe.mine] is not flown"),
    ('[input]\nmine = "mine.csv"', "`input` mine is not flown; name it in `excitations`"),
    (None, "No such file"),
    *((text, "is empty; say at least what differs") for text in ("", "# flights = 3")),
    (b"\xff\xfe\x00", "not a TOML file"),
    ("flights = ", "not a TOML file"),
    ("a = " + "[" * 5000, "spec.toml"),
    *((text, f"`{text.split()[0]}") for text in WRONG_VALUES),
]


@pytest.mark.parametrize(("text", "words"), WRONG_SPECIFICATIONS)
def test_a_wrong_specification_is_one_line(run, tmp_path, text, words):
    rows = "".join(f"{0.01 * k:.2f},200,200,200,200\n" for k in range(600))
    (tmp_path / "mine.csv").write_text("t,omega1,omega2,omega3,omega4\n" + rows)
    if text is not None:
        (tmp_path / "spec.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    for option in ((), ("--dry-run",)):
        refused(run("study", "spec.toml", "--out", "out", *option), "spec.toml: ", words)
    assert not (tmp_path / "out").exists()


_NAMES = st.sampled_from("ibss published os4 chirp rk4 white all float32 mine \x00 é".split() + [""])
_NUMBERS = st.one_of(
    st.integers(-2, 3), st.integers(-(2**70), 2**70), st.floats(), st.sampled_from([0.01, 0.5, 5.0, 1e-320, 1e308])
)
_SCALARS = st.one_of(_NAMES, _NUMBERS, st.booleans())
_KEYS = st.one_of(st.sampled_from([*Study.__struct_fields__, "steps", "mass", "inertia", "mine"]), st.text(max_size=3))
_VALUES = st.recursive(
    _SCALARS, lambda of: st.one_of(st.lists(of, max_size=4), st.dictionaries(_KEYS, of, max_size=4)), max_leaves=8
)


# One key with numbers, often with an extreme one: half of these tables are a study, of the others hardly any.
_EXTREME = st.one_of(st.floats(), st.sampled_from([0.01, 5.0, 1e-320, 1e308, np.inf, np.nan]))
_LISTS = dict.fromkeys(("durations", "scales", "widths"), st.lists(_EXTREME, min_size=1, max_size=2))
_LIKELY = st.one_of(*(st.fixed_dictionaries({key: values}) for key, values in ({"dt": _EXTREME} | _LISTS).items()))


def toml(value) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return str(value).lower()


@pytest.mark.slow
@settings(max_examples=400)
@given(st.one_of(st.dictionaries(_KEYS, _VALUES, max_size=5), _LIKELY))
def test_any_specification_is_a_study_or_an_input_error_of_one_line(table):
    """The numbers of a study are finite, and its flights can be flown."""
    with tempfile.TemporaryDirectory() as folder:
        text = "".join(f"{json.dumps(key, ensure_ascii=False)} = {toml(value)}\n" for key, value in table.items())
        path = specification(Path(folder), text)
        try:
            study = load_study(path)
        except jaxos4.InputError as error:
            line = str(error)
        else:
            line = f"{path}: {study.cell(study.count - 1)}"
            assert np.isfinite([study.dt, *study.durations, *study.scales, *study.widths]).all()
            assert all(2 <= duration / study.dt <= 1e6 for duration in study.durations)
        assert line.startswith(f"{path}: ")
        assert "\n" not in line
