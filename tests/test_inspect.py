"""`jaxos4 inspect` as a user types it: logs of each format, and the airframe that a log knows of."""

import base64
import io
import json

import equinox as eqx
import numpy as np
import pytest
import tomlkit
from blackbox_logs import T as BLACKBOX_TIME, recorded
from crazyflie_logs import one_event
from helpers import CRAZYFLIE, output_of, refused
from hypothesis import given, settings, strategies as st
from pages import read_page, words
from px4_logs import everything
from recorded_logs import VEHICLE, blackbox_csv
from rich.console import Console
from sign_flights import flown, turned

import jaxos4
from jaxos4.flight import RATES
from jaxos4.logs import LogFacts
from jaxos4.recording.inspection import ASSUMED_FULL_SCALE, airframe_draft, inspect_log
from jaxos4.recording.motion import rotor_signs
from jaxos4.report import print_inspection, write_log_page
from jaxos4.report.log_figures import amplitude_density, logged
from jaxos4.report.log_page import fit_note
from jaxos4.report.timeline import thinned

EVIL = "</script><script>alert(1)</script>"

LOGS = {
    "ULog": everything(),
    "blackbox": blackbox_csv(recorded(BLACKBOX_TIME)).encode(),
    "Crazyflie": one_event(0.004 * np.arange(750)),
}


@pytest.mark.parametrize("kind", LOGS)
def test_each_format_is_inspected(kind, run, tmp_path):
    (tmp_path / "log").write_bytes(LOGS[kind])
    (tmp_path / "vehicle.toml").write_text(VEHICLE)
    out = output_of(run("inspect", "log", "--airframe", "vehicle.toml", "--out", "log.json"))
    assert len(out.splitlines()) < 40  # a screen
    for said in ("p q r: ", "rad/s", "usable", "good ("):
        assert said in out
    report = json.loads((tmp_path / "log.json").read_text())
    assert report["format"] == kind
    assert report["measured"]["p"]["rate"] == pytest.approx(1 / report["sample_time"], rel=0.02)
    (part,) = report["parts"]
    assert part["usable"]
    assert part["excitation"]["roll"]["verdict"] == "good"


def test_any_console_shows_the_units_in_brackets():
    text = io.StringIO()
    print_inspection(Console(file=text, width=80), inspect_log(flown(CRAZYFLIE, 0), CRAZYFLIE), "CSV")
    assert "rate [rad/s]" in " ".join(text.getvalue().split())


def test_a_simulated_flight_and_what_it_cannot_tell(run, tmp_path):
    assert run("simulate", "--duration", "3", "--noise", "1", "--out", "flight.csv")[0] == 0
    out = output_of(run("inspect", "flight.csv", "--airframe", "os4", "--report", "log.html"))
    assert "report: log.html" in out
    assert "jaxos4 inspect flight.csv --airframe os4" in (tmp_path / "log.html").read_text()
    assert "flight CSV, 0.00 to 3.00 s, 301 samples, one every 10 ms" in out
    rows = [f"{0.01 * k:.2f},226,226,226,226,0,0,0" for k in range(200)]
    (tmp_path / "hover.csv").write_text("\n".join(["t,omega1,omega2,omega3,omega4,p,q,r", *rows]))
    out = output_of(run("inspect", "hover.csv", "--airframe", "os4"))
    assert "none (0)" in out


def test_commands_need_no_airframe_to_be_inspected(run, tmp_path):
    rows = [f"{0.01 * k:.2f},0.5,0.5,0.5,{0.5 + 0.1 * np.sin(k):.3f},0.1" for k in range(200)]
    (tmp_path / "c.csv").write_text("\n".join(["t,command1,command2,command3,command4,p", *rows]))
    out = output_of(run("inspect", "c.csv"))
    assert "up to 0.6 of full scale (commands)" in out
    assert "usable" in out


SIGNS = (1, -1, -1, 1), (-1, -1, 1, 1), (1, -1, 1, -1)


def with_force(flight, airframe):
    """The flight with an accelerometer that measures the rotors' thrust."""
    thrust = float(airframe.thrust_coefficient) * (flight.omega**2).sum(axis=1)
    return flight._replace(specific_force=np.outer(thrust / float(airframe.mass), [0, 0, 1.0]))


def filled(text):
    """The draft with its marked lines filled in, by the Crazyflie's numbers."""
    text = text.replace("# mass = ", "mass = 0.027")
    (line,) = [line for line in text.splitlines() if line.startswith("# rotor_positions = ")]
    places, comment = line.removeprefix("# ").split("  # ")
    return text.replace(line, f"{places.replace('x', '0.028').replace('y', '0.028')}  # {comment}")


@given(seed=st.integers(0, 999), gust=st.sampled_from([0.0, 5.0, 40.0]), order=st.permutations(range(4)))
@settings(max_examples=12, deadline=None)
def test_a_flight_shows_where_its_rotors_are(seed, gust, order):
    """In any order of the rotors, whatever a controller does against gusts: right, or not said."""
    flight = flown(CRAZYFLIE, seed, gust=gust)
    found = rotor_signs([flight._replace(omega=flight.omega[:, order])])
    assert found is not None
    forward, left, spins = (tuple(np.asarray(each)[order].tolist()) for each in SIGNS)
    assert found[:2] == (forward, left)
    assert found[2] in (spins, None)
    assert found[2] is not None or gust == 40


def test_props_in_and_props_out_and_flights_that_do_not_show_their_rotors():
    assert rotor_signs([flown(turned(CRAZYFLIE, "rotor_spins"), 0)]) == (*SIGNS[:2], (-1, 1, -1, 1))
    flight = flown(CRAZYFLIE, 0)
    places = np.array([[0.04, 0.0], [0.0, -0.04], [-0.04, 0.0], [0.0, 0.04]])
    plus = eqx.tree_at(lambda a: a.rotor_positions, CRAZYFLIE, places)
    for pieces in ([], [flight._replace(states=0.001 * flight.states)], [flown(plus, 0)]):
        assert rotor_signs(pieces) is None


@pytest.mark.parametrize("name", ["rollpitch", "hover"])
def test_real_logs_give_airframes(name, shared_flights, run, tmp_path):
    """The draft of a log has its signs, is no airframe before it is filled in, and then is that of the vehicle."""
    log = str(shared_flights / f"arpl_crazyflie_{name}.csv")
    out = output_of(run("inspect", log, "--airframe-out", "mine.toml"))
    assert "airframe: mine.toml; weigh or measure, and fill in: mass, rotor_positions" in out
    text = (tmp_path / "mine.toml").read_text()
    x, y = ([{1: name, -1: f"-{name}"}[sign] for sign in each] for name, each in zip("xy", SIGNS, strict=False))
    assert f"# rotor_positions = [{', '.join(f'[{a}, {b}]' for a, b in zip(x, y, strict=True))}]" in text
    refused(run("estimate", log, "--airframe", "mine.toml"), "`mass`, `rotor_positions` are missing; write them")
    (tmp_path / "mine.toml").write_text(filled(text))
    airframe = jaxos4.load_airframe(tmp_path / "mine.toml")
    np.testing.assert_array_equal(airframe.rotor_spins, SIGNS[2])
    assert 200 < float(airframe.hover_speed) < 700
    # Its data sheet says 0.150 N at full command.
    full_thrust = float(airframe.thrust_coefficient * airframe.max_rotor_speed**2)
    assert full_thrust == pytest.approx(0.150, rel=0.15)


@pytest.mark.parametrize("commanded", [True, False])
@pytest.mark.parametrize("felt", [True, False])
def test_the_median_thrust_carries_the_mass(commanded, felt, tmp_path):
    flight = flown(CRAZYFLIE, 0)
    flight = with_force(flight, CRAZYFLIE) if felt else flight
    if commanded:  # as a reader gives them that knows of no airframe: shares of full scale
        flight = flight._replace(omega=flight.omega / float(CRAZYFLIE.max_rotor_speed))
    text, missing = airframe_draft(flight._replace(commanded=commanded))
    assert missing == ("mass", "rotor_positions")
    assert ("Without an accelerometer this must be right" in text) == (not felt)
    (tmp_path / "mine.toml").write_text(filled(text))
    airframe = jaxos4.load_airframe(tmp_path / "mine.toml")
    assert float(airframe.max_rotor_speed) == (ASSUMED_FULL_SCALE if commanded else np.inf)
    scale = float(CRAZYFLIE.max_rotor_speed) / ASSUMED_FULL_SCALE if commanded else 1.0
    thrust = float(CRAZYFLIE.thrust_coefficient) * scale**2
    assert float(airframe.thrust_coefficient) == pytest.approx(thrust, rel=1e-3 if felt else 0.05)
    np.testing.assert_array_equal(airframe.rotor_spins, CRAZYFLIE.rotor_spins)


def test_settings_of_the_autopilot_are_taken():
    positions = ((0.15, -0.2), (-0.15, 0.2), (0.15, 0.2), (-0.15, -0.2))
    facts = LogFacts(rotor_positions=positions, rotor_spins=(1.0, 1.0, -1.0, -1.0))
    text, missing = airframe_draft(flown(CRAZYFLIE, 0)._replace(facts=facts))
    found = tomlkit.parse(text)
    assert missing == ("mass",)
    assert found["rotor_positions"] == [list(each) for each in positions]
    assert found["rotor_spins"] == [1, 1, -1, -1]


def test_a_log_that_never_flew_leaves_more_to_fill_in(run, tmp_path):
    rows = [f"{0.01 * k:.2f},0,0,0,0,0" for k in range(200)]
    (tmp_path / "log").write_text("\n".join(["t,command1,command2,command3,command4,p", *rows]))
    out = output_of(run("inspect", "log", "--airframe-out", "mine.toml"))
    assert "fill in: mass, rotor_positions, rotor_spins, hover_speed" in out
    text = (tmp_path / "mine.toml").read_text()
    keys = "`mass`, `rotor_positions`, `thrust_coefficient` are missing"
    for line, missing in (("", keys), ("mass = 1\narm = 0.1", "`thrust_coefficient` is missing")):
        text = f"{line}\n{text}"
        (tmp_path / "mine.toml").write_text(text)
        refused(run("inspect", "log", "--airframe", "mine.toml"), missing, "in SI units (`hover_speed` can replace")
    (tmp_path / "mine.toml").write_text(f"hover_speed = 500\n{text}")
    refused(run("inspect", "log", "--airframe", "mine.toml"), "`rotor_spins` must be finite numbers of shape [4]")


def test_the_page_of_a_log_shows_what_would_be_fitted(tmp_path):
    """A flight with a part on the ground, whose name is no part of the page's code."""
    flight = with_force(flown(CRAZYFLIE, 0), CRAZYFLIE)
    idle = np.arange(flight.time.size) < flight.time.size // 4
    flight = flight._replace(omega=np.where(idle[:, None], 0.0, flight.omega), name=f"{EVIL}.csv")
    write_log_page(tmp_path / "log.html", flight, CRAZYFLIE, command="jaxos4 inspect")
    text = read_page(tmp_path / "log.html")
    shown, found = words(text), inspect_log(flight, CRAZYFLIE)
    assert len(text) < 600_000
    for said in (
        "excitation: roll",
        "on the ground",
        "would be fitted",
        "would be held out",
        "Vibration",
        "jaxos4 inspect",
    ):
        assert said in shown
    text, block = logged(flight, found)
    assert block == 1  # all samples
    drawn = json.loads(text)
    panels = drawn["common"][0]["panels"]
    assert [panel["title"] for panel in panels][:3] == ["rate [rad/s]", "motor [rad/s]", "force [m/s²]"]
    middle, step, levels = panels[0]["lines"][0]["values"]
    levels = np.frombuffer(base64.b64decode(levels), "<i2")
    np.testing.assert_allclose(middle + step * levels, flight.states[:, RATES[0]], atol=step)
    begin, end = drawn["shaded"][0]
    assert (begin, end) == pytest.approx((found.stretches[0].begin, found.stretches[0].end))


def test_commands_without_full_scale_are_refused_on_the_page_as_by_the_fit():
    flight = flown(CRAZYFLIE, 0)
    commands = flight._replace(omega=flight.omega / 4e3, commanded=True)
    unknown = eqx.tree_at(lambda each: each.max_rotor_speed, CRAZYFLIE, np.asarray(np.inf))
    assert "the rotor speed of full command is not known; set max_rotor_speed" in fit_note(commands, unknown)
    assert "would be fitted" in fit_note(flight._replace(commanded=False), unknown)


@given(samples=st.integers(1, 60), most=st.integers(4, 20))
def test_thinned_signals_keep_extremes_and_the_last_samples(samples, most):
    time, values = np.arange(samples, dtype=float), np.random.default_rng(samples).normal(size=(samples, 2))
    values[-1] = [9.0, np.nan]
    times, fewer, block = thinned(time, values, most)
    assert len(times) == len(fewer) <= max(most, 2 * (most // 2))
    assert (np.diff(times) >= 0).all()
    assert times[-1] >= samples - block
    assert np.nanmax(fewer[:, 0]) == 9.0
    assert np.nanmin(fewer[:, 0]) == values[:, 0].min()


def test_the_spectrum_of_white_noise_and_of_a_tone():
    noise = np.random.default_rng(0).normal(size=(4000, 1))
    tone = np.sin(2 * np.pi * 60 * 0.002 * np.arange(4000))[:, None]
    frequency, density = amplitude_density([np.hstack([noise, 5 * tone])], 0.002)
    np.testing.assert_allclose(np.mean(density[:, 0] ** 2), 2 * 0.002, rtol=0.1)  # its variance is 1, over 250 Hz
    assert frequency[density[:, 1].argmax()] == pytest.approx(60)
    gap = np.where(np.arange(400) % 100 < 50, np.nan, 1.0)[:, None]
    assert np.isfinite(amplitude_density([gap], 0.01)[1]).all()
    # A channel that was not measured in one part has the spectrum of the other.
    lost = [noise, np.full((1000, 1), np.nan)]
    np.testing.assert_array_equal(amplitude_density(lost, 0.002)[1], amplitude_density([noise], 0.002)[1])
    assert np.isnan(amplitude_density([gap[:5]], 0.01)[1]).all()
