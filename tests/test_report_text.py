"""An identification as text; numbers and tables as text: no digit and no cell is lost."""

import io
import math

import msgspec
import pytest
from hypothesis import given, strategies as st
from pages import page_of, printed, says
from rich.console import Console
from synthetic_identification import COLOURED, CONSTANTS, WHITE, WRONG, identified_flight, identified_vehicle

from jaxos4.identification.intervals import PRIOR_NOTE
from jaxos4.identification.results import (
    Constant,
    Disturbance,
    FixedParameter,
    ParameterEstimate,
    RigidBody,
    Validation,
)
from jaxos4.report.text import DASH, Listing, plain


def test_the_text_of_a_flight():
    white, free = "residuals white (Ljung-Box)", "residuals free of the inputs (cross-correlation)"
    says(
        printed(identified_flight()),
        *("alpha3 1/(kg m^2) 57712 [56709, 58716] 1.3e+02", "alpha6 1/(kg m^2) - - - not identifiable: not excited"),
        *("cannot be distinguished from 0.", "sensors that are quieter by a factor of 4.0 (alpha2).", "p 97.5, q 81.3"),
        "The residuals of q are not white noise: the model does not explain",
        *(f"{test}, tests at 1 %: not those of q." for test in (white, free)),
        "Ix 1.733e-05 +- 2.9e-07, J_R below noise; the alphas agree with one rigid body, p = 0.21.",
        "validation on other.csv [%] (residuals in multiples of the noise): p 81.3 (2).",
        "ibss, published model, rates channels: successful, 812 rollouts, 35.4 s",
    )
    clean = printed(identified_flight(fit={"p": WHITE}, validation=None, provenance={"windows": 4}))
    assert not any(said in clean for said in ("white noise", "Ljung-Box", "validation"))
    says(clean, "tests at 1 %: all.")


DIVERGED = {"result": "nonfinite_trajectory"}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"estimator": "network", "fit": {"q": COLOURED}}, "The hybrid continues the search"),
        ({"rigid_body": RigidBody(CONSTANTS, 1e-4, True)}, "not those of one rigid body"),
        ({"rigid_body": RigidBody(CONSTANTS, 0.5, False)}, "no rigid body has such"),
        ({"validation": Validation("other.csv", None, None)}, "trajectory diverges before the flight ends"),
        (DIVERGED, "No estimate: the model's trajectory diverged"),
        (DIVERGED, "(try `window`"),
    ],
)
def test_the_text_of_a_flight_warns_and_is_short_without_an_answer(changes, said):
    says(printed(identified_flight(**changes)), said)
    for other in ("rls", "AnEstimatorOfYourOwn"):
        text = printed(identified_flight(**DIVERGED, estimator=other))
        says(text, "No estimate: the model's trajectory diverged")
        assert "`window`" not in text
    assert printed(identified_flight(result="bracket_invalid")) == ""
    assert printed(identified_vehicle(verdicts={}, **DIVERGED)) == "note: t is not uniform"


def test_the_text_of_a_vehicle(tmp_path):
    says(
        printed(identified_vehicle()),
        *("alpha3 1/(kg m^2) 5.771e+04 [5.671e+04, 5.872e+04]", "fixed, not identifiable: alpha1 -0.8125."),
        *("Ix 1.733e-05 +- 2.9e-07 (if arms and mass are right)", "(377 starts)", "0.50 s – +- –"),
        "0.25 s 0.73 +- 0.14 0.73 +- 0.14 0.73 +- 0.14 0.41, 0.41, 0.41",
        "flight model (offset, damping), 32 s, a sample every 4 ms: successful, 812 rollouts",
    )
    gusts = {"p": Disturbance(1.2, "rad/s^2", 0.1, 0.02, 0.01)}
    doubtful = printed(identified_vehicle(disturbances=gusts, widened={"alpha3": 1.7}, verdicts=WRONG, skill=None))
    says(
        doubtful,
        *("Ix: refused (contradicted).", "Ix: Ix is negative; check the arms.", "by the factor: alpha3 1.7."),
        *("their correlation time: p 1.2 rad/s^2 over 0.1 s.", "white noise of the sensors [rad/s; m/s^2]: p 0.02."),
    )
    assert "Predictions" not in doubtful
    late = {"rotor_delay": ParameterEstimate(-0.02, 0.001, 0.001, (-0.022, -0.018), "s", "")}
    says(printed(identified_vehicle(parameters=late)), "note: motors are recorded 20 ms late (rotor_delay)")
    says(page_of(identified_vehicle(parameters=late), tmp_path / "flight.html"), "motors are recorded 20 ms late")
    unseen = {"alpha1": FixedParameter(-0.56, "1", PRIOR_NOTE)}
    says(
        printed(identified_vehicle(held=unseen)),
        "fixed, not identifiable from these flights; the uncertainty is included in the other intervals: alpha1 -0.56.",
    )
    small = {"rotor_delay": msgspec.structs.replace(late["rotor_delay"], estimate=-0.004)}
    assert "late" not in printed(identified_vehicle(parameters=small))


def test_much_widened_intervals_are_a_warning(tmp_path):
    found = identified_vehicle(widened={"alpha3": 1.7, "alpha6": 2.4, "rotor_lag": 14.9})
    said = "warning: parts of the flight disagree, so that intervals were widened 2.4 to 14.9 times: alpha6, rotor_lag."
    for text in (found.summary(width=400), page_of(found, tmp_path / "flight.html")):
        says(text, said, "The model lacks an effect, or the vehicle changed.")
    several = identified_vehicle(widened=found.widened, provenance={"flights": ["a.csv", "b.csv"]})
    says(several.summary(width=400), "The model lacks an effect, or the flights are not of one vehicle.")
    assert "warning" not in printed(identified_vehicle(widened={"alpha3": 1.9}))


def test_a_moment_of_inertia_below_noise_has_no_value(tmp_path):
    body = RigidBody(CONSTANTS | {"J_R": Constant(-2.83, 9.0, "kg m^2")}, 0.2, True)
    text = page_of(identified_flight(rigid_body=body), tmp_path / "flight.html")
    says(text, "J_R kg m^2 – -20.47 to 14.81 below noise")
    assert "-2.83" not in text


def test_small_numbers_keep_their_digits():
    known = {1.2e-5: "1.20e-5", 0.99999: "1.00", 123456.0: "123000", 0.0: "0", -3.14159: "-3.14", math.nan: DASH}
    assert {x: plain(x) for x in known | {1.234e300: ""}} == known | {1.234e300: "1.23e300"}


NUMBERS = st.floats(allow_nan=False, allow_infinity=False).map(lambda x: f"{x:.5g}")
NOTES = st.sampled_from(["", "not excited", "below noise: cannot be distinguished from 0, or at the bracket's edge"])


def listed(listing, width):
    console = Console(width=width, file=io.StringIO())
    listing.print_on(console)
    assert console.width == width
    return console.file.getvalue()


@given(rows=st.lists(st.tuples(NUMBERS, NUMBERS, NOTES), min_size=1, max_size=4), width=st.integers(20, 120))
def test_no_cell_is_cut_and_a_wide_table_stays_as_wide_as_the_terminal_if_it_fits(rows, width):
    names = [f"thrust_gain_{i}" for i in range(len(rows))]
    cells = [(name, low, f"[{low}, {high}]", note) for name, (low, high, note) in zip(names, rows, strict=True)]
    text = listed(Listing(("parameter", "estimate", "95 % interval", "note"), cells, ("estimate",)), width)
    assert "…" not in text
    assert all(cell in text for row in cells for cell in row[:-1])
    assert all(word in text for row in cells for word in row[-1].split())
    use = "rotor 1, 2, 3, 4 at rest or idle, for a long time, in the air"
    lines = listed(Listing(("name", "use"), [("a", use)]), 40).splitlines()
    assert max(map(len, lines)) <= 40
    assert len(lines) > 3
    listing = Listing(("name", "note"), [("a", "not excited")])
    assert listed(listing, 40).splitlines()[-1].split() == ["a", "not", "excited"]
    assert "a: not" in listed(listing, 12)
