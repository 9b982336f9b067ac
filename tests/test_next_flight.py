"""What to fly next: from the half-width now to the 10 % that a verdict needs, or the remedy of another cause."""

import json

import msgspec
import pytest
from pages import page_of, printed, says, words
from synthetic_identification import UNKNOWN, identified_flight, identified_vehicle

import jaxos4
from jaxos4.identification.issues_of_values import MEASURE
from jaxos4.identification.next_flight import next_flight, spreads_of
from jaxos4.identification.quantities import os4_quantities
from jaxos4.identification.results import Constant, RigidBody
from jaxos4.identification.verdict import RESERVATION, RESERVED, Issue, Quantity, Verdict, verdicts_of

HALF = {"Ix": 0.16, "Iy": 0.05, "Iz": 0.64}


def vehicle(half=HALF, issues=(), seconds=32.0):
    """A vehicle whose moments of inertia are known to these shares, with verdicts to match."""
    constants = {name: Constant(1e-5, 1e-5 * each / 1.959963984540054, "kg m^2") for name, each in half.items()}
    verdicts = verdicts_of({name: Quantity("", each) for name, each in half.items()}, issues)
    about = {"verdicts": verdicts, "issues": tuple(issues), "provenance": {"fitted_seconds": seconds}}
    return identified_vehicle(rigid_body=RigidBody(constants), **about)


def said(*results):
    return next_flight(results, spreads_of(results[0]))


@pytest.mark.parametrize(
    ("half", "advice"),
    [
        # 32 s (1.6^2 - 1) = 50 s; the root of 6.4^2 - 1 is 6.3
        ({"Ix": 0.16}, "fly 50 s more roll (known now: Ix 16 %; needed: 10 %)."),
        ({"Iz": 0.64}, "fly yaw as long as before but 6.3 times as strong (known now: Iz 64 %; needed: 10 %)."),
        (HALF, "50 s more roll, yaw as long as before but 6.3 times as strong (known now: Ix 16 %, Iz 64 %; needed"),
        ({"Iy": 0.05}, "nothing is missing; repeat the flight and compare"),
    ],
)
def test_half_widths_shrink_with_the_root_of_the_time_and_with_the_amplitude(half, advice):
    says(said(vehicle(half)), advice)


def test_time_is_that_of_all_flights_that_count():
    both = [vehicle({"Ix": 0.16}, seconds=10.0), vehicle({"Ix": 0.16}, seconds=22.0)]
    says(next_flight(both, {"Ix": 0.16}), "fly 50 s more roll (known")
    says(next_flight(both, {"Ix": 0.099}), "nothing is missing.")


def test_another_cause_has_its_remedy_and_one_that_begins_another_is_said_once(tmp_path):
    calm = Issue("unidentifiable", "gusts are larger", "fly more yaw, or in calmer air", {"Iz": None})
    slow = Issue(RESERVATION, "the log is slow", "log faster", {"Ix": None})
    found = vehicle({"Ix": 0.05, "Iz": 0.05}, [calm, slow])
    unseen = Verdict("not identified", "", ("it is unseen; fly more yaw",), ("fly more yaw",))
    verdicts = found.verdicts | {"predictions": unseen, "drag": msgspec.structs.replace(unseen, status=RESERVED)}
    found = msgspec.structs.replace(found, verdicts=verdicts)
    (tmp_path / "found.json").write_text(json.dumps(found.to_dict()))
    for each in (found, jaxos4.read_result(tmp_path / "found.json")):
        says(said(each), "log faster (Ix); fly more yaw, or in calmer air (Iz, predictions).")


def test_nobody_is_told_to_fly_for_an_inertia_that_lacks_a_drag_coefficient():
    """The issue alone refuses Iz: an interval of 30 % would be a reservation only."""
    drag = Issue("unidentifiable", "the thrust is another", MEASURE, {"Iz": None})
    found = vehicle({"Iz": 0.3}, [drag])
    verdicts = verdicts_of({"Iz": Quantity(spread=0.3, remedy=MEASURE, flying_helps=False)}, [drag])
    assert said(msgspec.structs.replace(found, verdicts=verdicts)) == f"{MEASURE} (Iz)."


def test_terminal_and_page_end_with_it(tmp_path):
    found = vehicle()
    line = said(found)
    assert " ".join(printed(found).split()).endswith(line)
    says(page_of(found, tmp_path / "flight.html").replace("Next:", "next:"), line)
    says(words(found._repr_html_()), line)


def test_an_os4_that_does_not_show_a_parameter_is_told_to_design_a_flight():
    """Even if all quantities have a reservation too."""
    coloured = Issue(RESERVATION, "the noise is coloured", "use another model", {"alpha6": None, "rigid body": None})
    found = identified_flight(parameters={"alpha6": UNKNOWN}, rigid_body=RigidBody(), issues=(coloured,))
    verdicts = verdicts_of(os4_quantities(found, {}), found.issues)
    advice = said(msgspec.structs.replace(found, verdicts=verdicts))
    assert advice == "fly what `jaxos4 design` proposes (alpha6, rigid body)."
