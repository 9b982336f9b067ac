"""A vehicle that turns against its airframe is found, whatever its controller does against gusts."""

import equinox as eqx
import jax
import numpy as np
import pytest
from helpers import CRAZYFLIE, CRAZYFLIE_TOML, output_of, usable_stretches
from hypothesis import given, settings, strategies as st
from sign_flights import flown, turned

from jaxos4.errors import InputError
from jaxos4.flight import RATES
from jaxos4.logs import read_recording, write_flight
from jaxos4.recording import Recording, Stretch, averaged, cut
from jaxos4.recording.checks import opposite_yaw, self_checks
from jaxos4.recording.motion import opposite_axes as opposites, refused_note, rotor_signs
from jaxos4.recording.prepared import prepare, saturation_note


def opposite_axes(pieces, airframe):
    return list(opposites(pieces, airframe))


def parts_of(path, airframe=CRAZYFLIE):
    """The usable parts of a recorded flight."""
    flight = read_recording(path, airframe)
    return [cut(flight, stretch) for stretch in usable_stretches(flight, airframe)]


@pytest.mark.slow
@given(seed=st.integers(0, 999), gust=st.sampled_from([0.0, 5.0, 40.0]), lag=st.floats(0.02, 0.07))
@settings(max_examples=12, deadline=None)
def test_wrong_signs_are_found_and_right_ones_never(seed, gust, lag):
    flight = flown(CRAZYFLIE, seed, gust=gust, lag=lag)
    assert opposite_axes([flight], CRAZYFLIE) == []
    for shift in (-8, 8):  # clocks of motors and gyro, by 32 ms
        late = flight._replace(omega=np.roll(flight.omega, shift, axis=0))
        assert opposite_axes([late], CRAZYFLIE) == []
    if gust < 40:  # else the controller's answer to gusts hides the sign
        assert opposite_axes([flight], turned(CRAZYFLIE, "rotor_positions")) == ["roll", "pitch"]
        assert opposite_axes([flight], turned(CRAZYFLIE, "rotor_spins")) == ["yaw"]
    # Gusts alone do not change the sign.
    assert opposite_axes([flown(CRAZYFLIE, seed, reference=0.1 * (seed % 2), seconds=10.0)], CRAZYFLIE) == []


def test_a_fit_is_refused_with_the_remedy_unless_the_vehicle_does_not_turn():
    recording = flown(CRAZYFLIE, 0)
    # Opposite yaw is only doubted.
    (found,) = prepare([recording], turned(CRAZYFLIE, "rotor_spins"))[0].findings
    assert str(found).startswith(
        "a.bbl: yaw answers the rotors with the opposite sign (torque and angular acceleration "
    )
    assert "change all four signs" in found.remedy
    assert (found.quantities, found.contradicted) == (("Iz",), True)
    with pytest.raises(InputError, match=r"a.bbl: roll and pitch answer .* in another order .* correct one of them"):
        prepare([recording], turned(CRAZYFLIE, "rotor_positions"))
    prepared, *_ = prepare([recording], CRAZYFLIE)
    assert (prepared.windows > 0, prepared.findings) == (True, ())
    still = recording._replace(states=0.001 * recording.states)
    assert opposite_axes([still], turned(CRAZYFLIE, "rotor_spins")) == opposite_axes([], CRAZYFLIE) == []
    brief = cut(averaged(recording, [0.02])[0], Stretch(0.0, 1.5))  # too short for signals from 2 Hz on
    assert opposite_axes([brief], turned(CRAZYFLIE, "rotor_spins")) == []
    assert (refused_note({}), opposite_yaw({})) == ("", None)


@pytest.mark.parametrize("name", ["rollpitch", "yaw_a", "hover"])
def test_real_flights(name, shared_flights):
    parts = parts_of(shared_flights / f"arpl_crazyflie_{name}.csv")
    assert opposite_axes(parts, CRAZYFLIE) == []
    assert opposite_axes(parts, turned(CRAZYFLIE, "rotor_spins")) == ["yaw"]
    assert opposite_axes(parts, turned(CRAZYFLIE, "rotor_positions")) == ["roll", "pitch"]


def test_inspect_questions_the_spins(run, tmp_path):
    write_flight(flown(CRAZYFLIE, 0).flight, tmp_path / "flight.csv")
    (tmp_path / "good.toml").write_text(CRAZYFLIE_TOML)
    (tmp_path / "bad.toml").write_text(CRAZYFLIE_TOML.replace("[1.0, -1.0, 1.0, -1.0]", "[-1, 1, -1, 1]"))
    assert "answer" not in run("inspect", "flight.csv", "--airframe", "good.toml")[1]
    out = output_of(run("inspect", "flight.csv", "--airframe", "bad.toml"))
    assert "contradicts Iz: yaw answers the rotors with the opposite sign" in " ".join(out.split())
    assert "cannot identify" not in out


@pytest.mark.parametrize(
    ("shift", "words"), [(-9, "the gyro lags the motors"), (0, ""), (6, "the motors lag the gyro")]
)
def test_clocks_of_motors_and_gyro_are_compared(shift, words):
    """Measured rotor speeds, later than they were by `shift` samples of 4 ms. The rotors lag by 4 ms."""
    flight = flown(CRAZYFLIE, 0, gust=5.0, lag=0.004)._replace(commanded=False)
    late = flight._replace(omega=np.roll(flight.omega, shift, axis=0))
    found = [each for each in self_checks(late, CRAZYFLIE) if each.name == "gyro_or_motors_clock"]
    assert len(found) == bool(words)
    for each in found:
        assert each.cause == words
        assert float(each.size.split()[0]) == pytest.approx(abs(4 * shift), abs=0.5)


def test_rotors_at_their_limit_are_named(shared_flights):
    limits = {"B2_circle_fast_rep2": "rotor 4 is at its limit for 10 %", "B3_figure8_fast_rep1": None}
    for name, words in limits.items():
        said = saturation_note(read_recording(shared_flights / "nanobench" / f"{name}.csv", CRAZYFLIE), CRAZYFLIE)
        assert said == "" if words is None else words in said
    flight = flown(CRAZYFLIE, 0)
    assert saturation_note(flight, CRAZYFLIE) == ""
    omega = flight.omega.copy()
    omega[::20, 1] = 0.997 * float(CRAZYFLIE.max_rotor_speed)  # noise of a measured speed
    assert "rotor 2 is at its limit for 5 %" in saturation_note(flight._replace(omega=omega), CRAZYFLIE)


def test_messages_about_a_flight_to_predict_name_no_option_of_the_fit():
    flight = flown(CRAZYFLIE, 0, seconds=6.0, name="other.csv")
    resting = flight._replace(omega=0.1 * flight.omega)
    options = {"sample_time": 0.004, "holdout": 0.0}
    with pytest.raises(InputError, match="the vehicle never flew .* or `begin` and `end`"):
        prepare([resting], CRAZYFLIE, **options)
    with pytest.raises(InputError, match="the vehicle never flew") as predicted:
        prepare([resting], CRAZYFLIE, **options, predicted=True)
    slow = flight.rows(slice(None, None, 5))._replace(commanded=False)
    with pytest.raises(InputError, match="other.csv: has one sample every 0.02 s.* or another `validate`") as slower:
        prepare([slow], CRAZYFLIE, **options, predicted=True)
    for error in (predicted, slower):
        assert "`begin`" not in str(error.value)
    partly = flight._replace(omega=flight.omega * (flight.time[:, None] > 2))
    assert "(`begin` and `end` override)" in prepare([partly], CRAZYFLIE, **options)[0].notes[-1]
    assert "override" not in prepare([partly], CRAZYFLIE, **options, predicted=True)[0].notes[-1]


@pytest.mark.parametrize("name", ["arpl_crazyflie_yaw_a.csv", "nanobench/B2_circle_fast_rep2.csv"])
def test_single_precision_rounds_the_cleaned_data_once(name, shared_flights):
    """Reading, cutting, averaging and joining compute in double precision; only the flight to fit is rounded."""

    def cleaned():
        prepared, *_ = prepare([read_recording(shared_flights / name, CRAZYFLIE)], CRAZYFLIE, begin=1.0, end=6.0)
        return jax.tree.leaves((prepared.fitted, prepared.tested)), prepared.seconds

    double, seconds = cleaned()
    with jax.enable_x64(False):
        single, same_seconds = cleaned()
    assert seconds == same_seconds
    assert len(single) == len(double) > 6
    for one, two in zip(single, double, strict=True):
        assert one.dtype in (np.float32, np.int32)
        np.testing.assert_array_equal(one, np.asarray(two).astype(one.dtype))


def test_no_flight_of_another_laboratory_is_refused(shared_flights):
    """Clocks are shifted, and the vehicle hardly yaws."""
    scale = 0.0325 / 0.028
    vehicle = eqx.tree_at(lambda a: a.rotor_positions, CRAZYFLIE, scale * np.asarray(CRAZYFLIE.rotor_positions))
    for path in sorted((shared_flights / "nanobench").glob("*.csv")):
        parts = parts_of(path, vehicle)
        for airframe in (vehicle, turned(vehicle, "rotor_spins")):
            assert refused_note(opposites(parts, airframe)) == ""
        assert refused_note(opposites(parts, turned(vehicle, "rotor_positions")))


@pytest.mark.parametrize("frequency", [5.0, 8.0, 11.0])
@pytest.mark.parametrize("spins", [1.0, -1.0])
def test_rotors_and_spins_are_found_in_motion_of_one_frequency(frequency, spins):
    """Half a period later, torque and acceleration have opposite signs. `spins`: -1 if they are not the airframe's."""
    rng, time = np.random.default_rng(0), 0.004 * np.arange(5000)
    turns = 2 * np.pi * frequency * np.array([1.0, 1.07, 0.93])
    phases, sizes = turns * time[:, None] + [0.0, 1.3, 2.6], np.array([30.0, 30.0, 10.0])
    inertia = np.asarray(CRAZYFLIE.inertia, dtype=float) * [1.0, 1.0, spins]
    wrench = np.column_stack([sizes * np.sin(phases) * inertia, np.full(time.size, 0.27)])
    omega = np.sqrt(np.linalg.solve(np.asarray(CRAZYFLIE.mixer, dtype=float), wrench.T).T)
    states = np.full((time.size, 12), np.nan)
    states[:, RATES] = -sizes / turns * np.cos(phases) + 0.01 * rng.normal(size=(time.size, 3))
    flight = Recording(time, omega, states, None, held=False)
    found = rotor_signs([flight])
    assert found is not None
    forward, left = np.sign(np.asarray(CRAZYFLIE.rotor_positions)[:, :2]).T
    np.testing.assert_array_equal(found[:2], [forward, left])
    np.testing.assert_array_equal(found[2], spins * np.asarray(CRAZYFLIE.rotor_spins))
    assert list(opposites([flight], CRAZYFLIE)) == (["yaw"] if spins < 0 else [])
