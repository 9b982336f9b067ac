"""The specification of a study: what it may say, and how a wrong one is refused."""

import pytest
from helpers import refused
from small_study import AIRFRAME

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
