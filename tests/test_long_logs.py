"""Logs with more samples than a fit takes in a minute: the parts that tell the most are fitted, and a note says so."""

import numpy as np
import pytest
from helpers import CRAZYFLIE, memory_below

from jaxos4.flight import RATES
from jaxos4.logs.values import plausible
from jaxos4.recording import Recording, windows
from jaxos4.recording.checks import Evidence
from jaxos4.recording.inspection import inspect_log
from jaxos4.recording.prepared import finest, prepare
from jaxos4.recording.stretches import Stretch
from jaxos4.recording.windows import fair_share, richest
from jaxos4.report.log_figures import logged, spectra

DT, HOVER = 0.01, float(CRAZYFLIE.hover_speed)
ROLL, PITCH, YAW = np.sign(np.asarray(CRAZYFLIE.mixer)[:3])
MANOEUVRES = {"roll": (95, 115, ROLL, 0.1), "pitch": (305, 325, PITCH, 0.02), "yaw": (485, 505, YAW, 0.2)}


def log(seconds=600.0, *, manoeuvres=(), name="long.csv", ground=3.0, seed=0):
    """A flight in calm air after some seconds on the ground, with manoeuvres of one axis each."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(round(seconds / DT))
    omega = HOVER * (1 + 0.002 * rng.normal(size=(time.size, 4)))
    rates = rng.normal(0, 0.02, (time.size, 3))
    states = np.full((time.size, 12), np.nan)
    for i, each in enumerate(MANOEUVRES):
        begin, end, rotors, size = MANOEUVRES[each]
        flown = (time > begin) & (time < end) & (each in manoeuvres)
        omega[flown] *= 1 + size * np.sin(4 * time[flown])[:, None] * rotors
        rates[:, i] += np.where(flown, -np.cos(4 * time), 0.0)
    states[:, RATES] = rates
    omega[time < ground] = 0.0
    force = rng.normal(0, 0.3, (time.size, 3)) + [0, 0, 9.81]
    force[time < ground] = [0.1, 0.0, 9.81] + 0.01 * rng.normal(size=(np.count_nonzero(time < ground), 3))
    states[time < ground] *= 0.1
    return Recording(time, omega, states, force, name=name, held=False)


@pytest.fixture
def two_minutes(monkeypatch):
    monkeypatch.setattr(windows, "MOST", round(120 / DT))


def test_the_parts_of_a_long_log_that_excite_each_axis_are_fitted(two_minutes):
    ready = prepare([log(manoeuvres=MANOEUVRES)], CRAZYFLIE, sample_time=DT, holdout=0.0)[0]
    assert 0.9 * windows.MOST < ready.fitted.time.shape[0] <= windows.MOST
    for begin, end, _, _ in MANOEUVRES.values():
        assert np.count_nonzero((ready.time > begin) & (ready.time < end)) > 0.99 * (end - begin) / DT
    (note,) = (each for each in ready.notes if "torques vary" in each)
    assert note.startswith(
        "long.csv: 119.3 of 596.7 usable s are fitted, because more than 12,000 samples take minutes"
    )
    assert "the 4 parts whose torques vary the most" in note
    assert "`sample_time`" in note


def test_the_user_chooses_another_part_or_longer_samples(two_minutes):
    ready = prepare([log()], CRAZYFLIE, sample_time=DT, begin=500, end=560, holdout=0.0)[0]
    assert (ready.time[0], round(ready.time[-1])) == (500, 560)
    assert not any("torques vary" in each for each in ready.notes)
    ready = prepare([log()], CRAZYFLIE, sample_time=DT, begin=300, end=1e9, holdout=0.0)[0]
    assert ready.time[0] >= 300
    assert sum(ready.seconds) <= 120
    longer = prepare([log()], CRAZYFLIE, sample_time=4 * DT, holdout=0.0)[0]
    assert sum(longer.seconds) > 440


def test_a_log_that_is_only_predicted_is_whole(two_minutes):
    (ready,) = prepare([log()], CRAZYFLIE, sample_time=DT, holdout=0.0, predicted=True)
    assert sum(ready.seconds) > 590


def test_checks_and_inspection_see_the_parts_that_are_fitted(two_minutes):
    long = log(manoeuvres=MANOEUVRES)
    seconds = fair_share([long], finest(DT))
    assert seconds == 120
    evidence, whole = Evidence(long, CRAZYFLIE, seconds=seconds), Evidence(long, CRAZYFLIE)
    assert sum(each.time.size for each in evidence.stretches) <= windows.MOST + len(evidence.stretches)
    assert sum(each.time.size for each in whole.stretches) > 590 / DT
    np.testing.assert_array_equal(evidence.rest, whole.rest)  # before take-off, which is not fitted
    assert evidence.rest is not None
    assert sum(part.end - part.begin for part in inspect_log(long, CRAZYFLIE).stretches if part.usable) > 590


def test_equal_parts_are_taken_in_the_order_of_time_and_as_one():
    calm = log()
    (chosen,) = richest(calm, [Stretch(10, 590)], np.asarray(CRAZYFLIE.mixer)[:3], 120.0)
    assert chosen == Stretch(10, 126)


@pytest.mark.parametrize("lengths", [(30, 500, 50), (10,) * 50, (1000,), (20, 20)])
def test_logs_share_the_samples_that_a_fit_takes(two_minutes, lengths):
    logs = [log(length, seed=i) for i, length in enumerate(lengths)]
    share = fair_share(logs, DT)
    fitted = sum(min(float(np.ptp(each.time)), share) for each in logs)
    assert fitted <= 120.01
    assert share == np.inf or fitted > 119.9
    assert share == np.inf or share >= 120 / len(logs)


def test_each_of_many_logs_is_fitted(two_minutes):
    logs = [log(20, name=f"{i}.csv", seed=i, ground=0.0) for i in range(30)]
    ready = prepare(logs, CRAZYFLIE, sample_time=DT, holdout=0.0)[0]
    assert {*ready.recordings} == {*range(30)}
    assert ready.fitted.time.shape[0] <= windows.MOST


@pytest.mark.parametrize("what", ["values", "signals", "spectra"])
def test_a_page_of_a_long_log_takes_less_memory_than_the_log(what):
    long = log(2000, manoeuvres=MANOEUVRES)
    found = inspect_log(log(20))
    make = {
        "values": lambda: plausible(long),
        "signals": lambda: logged(long, found),
        "spectra": lambda: spectra([long], None),
    }[what]
    with memory_below(sum(x.nbytes for x in (long.time, long.omega, long.states, long.specific_force))):
        make()
