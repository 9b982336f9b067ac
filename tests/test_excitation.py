"""Excitations: the standard flight, shapes, limits, and the references of a controller."""

import re

import equinox as eqx
import numpy as np
import pytest

from jaxos4.airframe import OS4, OS4_SIMULATOR, VOOS
from jaxos4.excitation import EXCITATIONS, chirp, doublet, multisine, standard_references, step3211

X_LAYOUT = eqx.tree_at(
    lambda a: a.rotor_positions, OS4, np.array([[0.16, -0.16], [-0.16, -0.16], [-0.16, 0.16], [0.16, 0.16]])
)
AIRFRAMES = {"os4": OS4, "simulator": OS4_SIMULATOR, "voos": VOOS, "x": X_LAYOUT}
IN_TURN = {"doublet": doublet, "3211": step3211, "chirp": chirp}
every_excitation = pytest.mark.parametrize("excite", EXCITATIONS.values(), ids=EXCITATIONS)
every_airframe = pytest.mark.parametrize("airframe", AIRFRAMES.values(), ids=AIRFRAMES)
every_in_turn = pytest.mark.parametrize("excite", IN_TURN.values(), ids=IN_TURN)


def accelerations(airframe, omega):
    """Angular accelerations [rad/s^2] that the rotor speeds cause at zero rates."""
    return np.asarray(omega) ** 2 @ np.asarray(airframe.mixer)[:3].T / np.asarray(airframe.inertia)


def rates_and_angles(airframe, omega, dt=0.01):
    """Forward Euler of each axis by itself, from rest."""
    rates = np.cumsum(np.pad(accelerations(airframe, omega)[:-1], ((1, 0), (0, 0))), axis=0) * dt
    return rates, np.cumsum(np.pad(rates[:-1], ((1, 0), (0, 0))), axis=0) * dt


def test_multisine_is_the_standard_flight():
    omega = np.asarray(multisine(OS4, duration=5.0, dt=0.01))
    assert omega.shape == (501, 4)
    assert omega.dtype == np.float64
    assert (int(omega.min()), int(omega.max())) == (134, 289)
    tones, time = ((0.6, 1.1, 1.9), (0.7, 1.3, 2.3), (0.5, 0.9, 1.7)), 0.01 * np.arange(501)[:, None]
    designed = np.stack([(2 * np.pi * np.array(f) * np.cos(2 * np.pi * time * f) / 3).sum(axis=1) for f in tones], 1)
    torque = omega**2 @ np.asarray(OS4.mixer)[:3].T
    np.testing.assert_allclose(torque, np.asarray(OS4.inertia) * designed, rtol=0, atol=1e-12)
    assert np.abs(torque - np.asarray(OS4.inertia) * designed[:, [1, 0, 2]]).max() > 1e-3  # a reference can be wrong


@every_excitation
@every_airframe
def test_default_flights(airframe, excite):
    """Thrust carries the weight on every row; rates and angles stay small; every axis moves."""
    omega = np.asarray(excite(airframe))
    assert omega.shape == (501, 4)
    thrust = omega**2 @ np.asarray(airframe.mixer)[3]
    np.testing.assert_allclose(thrust, airframe.mass * airframe.gravity, rtol=1e-12)
    rates, angles = rates_and_angles(airframe, omega)
    assert np.abs(rates).max() < 1.05
    assert np.abs(angles).max() < 0.7
    assert np.abs(rates).max(axis=0).min() > 0.45


@every_in_turn
@every_airframe
@pytest.mark.parametrize("duration", [5.0, 11.37])
def test_one_axis_after_another_and_back_to_rest(airframe, excite, duration):
    rates, angles = rates_and_angles(airframe, excite(airframe, duration=duration))
    assert (np.abs(rates) > 1e-9).sum(axis=1).max() == 1
    np.testing.assert_allclose([rates[-1], angles[-1]], 0, atol=1e-10)
    np.testing.assert_allclose(np.abs(rates).max(axis=0), (1, 1, 0.5 if excite is chirp else 1), rtol=1e-9)
    assert (np.diff(np.argmax(np.abs(rates) > 1e-9, axis=0)) > 0).all()  # roll, pitch, yaw


def test_pulses_have_their_shapes_and_repeat_as_often_as_they_fit():
    """Pulse by pulse: the height of each in units of the first, and how long it lasts."""
    doublets = accelerations(OS4, doublet(OS4))[:150, 0]
    np.testing.assert_allclose(doublets[::30], np.array([1, -1, -1, 1, 0]) / 0.3, atol=1e-9)
    steps = accelerations(OS4, step3211(OS4))[:150, 0]
    once = np.array([0.8, 0.8, 0.8, -1.2, -1.2, 1.1, -1.1]) / (2.4 * 0.1)
    np.testing.assert_allclose(steps[::10], np.concatenate([once, -once, [0]]), atol=1e-9)
    np.testing.assert_allclose(steps.reshape(15, 10), steps[::10, None] * np.ones(10), atol=1e-9)
    roll = accelerations(OS4, doublet(OS4, duration=10.0))[:, 0]
    np.testing.assert_allclose(roll[450:900], roll[:450], atol=1e-9)
    np.testing.assert_allclose(roll[900:], 0, atol=1e-9)


def test_chirp_sweeps_its_frequencies():
    """Zero crossings of the rate: close to the first half-period at the start and to the last at the end."""
    rates, _ = rates_and_angles(OS4, chirp(OS4, duration=60.0))
    sign = np.sign(rates[1:2000, 0])
    crossings = 0.01 * np.flatnonzero(sign[1:] != sign[:-1])
    half_periods = np.diff(crossings)
    middle = (crossings[1:] + crossings[:-1]) / 2
    np.testing.assert_allclose(0.5 / half_periods[2:-2], 0.6 + 2.4 * middle[2:-2] / 20.0, rtol=0.1)
    assert len(crossings) == pytest.approx(2 * 1.8 * 20, abs=3)


def test_axes_of_the_multisine_are_uncorrelated_or_still():
    """Over the common period of the tones, 10 s."""
    designed = accelerations(OS4, multisine(OS4, duration=10.0))[:1000]
    gram = designed.T @ designed
    assert np.abs(gram - np.diag(np.diag(gram))).max() < 1e-10 * np.diag(gram).min()
    assert multisine(OS4, tones=((0.6,), (0.6,), (0.5,))).shape == (501, 4)  # the same tone twice is allowed
    designed = accelerations(OS4, multisine(OS4, tones=((1.0,), (), (0.5, 1.5))))
    np.testing.assert_allclose(designed[:, 1], 0, atol=1e-9)
    np.testing.assert_allclose(designed[:, 0], 2 * np.pi * np.cos(2 * np.pi * 0.01 * np.arange(501)), atol=1e-9)


@every_excitation
def test_amplitude_scales_every_axis_by_itself(excite):
    still = accelerations(OS4, excite(OS4, amplitude=0.0))
    np.testing.assert_allclose(still, 0, atol=1e-9)
    np.testing.assert_allclose(excite(OS4, amplitude=0.0), OS4.hover_speed, rtol=1e-12)
    full, half = (accelerations(OS4, excite(OS4, amplitude=a)) for a in (0.4, 0.2))
    np.testing.assert_allclose(half, full / 2, atol=1e-9)
    no_yaw = accelerations(OS4, excite(OS4, amplitude=(0.4, 0.2, 0.0)))
    np.testing.assert_allclose(no_yaw, full * np.array([1, 0.5, 0]), atol=1e-9)


@every_excitation
@pytest.mark.parametrize(("speed", "amplitude"), [(np.inf, (0.0, 0.0, 9.0)), (np.inf, 30.0), (260.0, 4.0)])
def test_unflyable_amplitudes_name_the_scale_that_flies(speed, amplitude, excite):
    airframe = eqx.tree_at(lambda a: a.max_rotor_speed, OS4, np.asarray(speed))
    with pytest.raises(ValueError, match=r"^[^\n]*too large to fly: rotor \d .*max_rotor_speed[^\n]*$") as caught:
        excite(airframe, amplitude=amplitude)
    scale = float(re.findall(r"multiply it by (\S+) or less", str(caught.value))[0])
    omega = np.asarray(excite(airframe, amplitude=np.multiply(amplitude, scale)))
    assert np.isfinite(omega).all()
    assert omega.max() <= speed
    with pytest.raises(ValueError, match="too large to fly"):
        excite(airframe, amplitude=np.multiply(amplitude, 1.02 * scale))


def test_standard_references_have_the_largest_values_that_are_asked_for():
    largest = np.array([0.1, 0.2, 0.3, 2.0])
    for name, references in standard_references(5001, 0.004, largest).items():
        np.testing.assert_allclose(np.abs(references).max(axis=0), largest, rtol=1e-9)
        assert (np.count_nonzero(references, axis=1).max() == 1) == (name != "multisine")  # one after another
    assert np.all(standard_references(500, 0.004, largest)["3211"] == 0)  # no room for one axis
