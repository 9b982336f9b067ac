"""Real logs of Betaflight: rows, usable stretches, the rotors' places. Decoding takes seconds: once for each log."""

import numpy as np
import pytest
from helpers import usable_stretches
from recorded_logs import GRAVITY

from jaxos4.logs import read_recording
from jaxos4.recording import cut
from jaxos4.recording.motion import RotorSigns, rotor_signs

# Rear right, front right, rear left, front left; props out.
SIGNS = RotorSigns((-1, 1, -1, 1), (-1, -1, 1, 1), (1, -1, -1, 1))


@pytest.mark.parametrize(
    ("name", "rows", "sessions", "usable", "signs"),
    [
        ("btfl_001.bbl", 24991, 2, 0.0, None),  # its second session was carried by hand, with idle throttle
        ("btfl_002.bbl", 66640, 1, 0.7, SIGNS),
        ("LOG00037.BFL", 16774, 1, 0.9, None),
    ],
)
def test_a_real_log_is_what_another_decoder_makes_of_it(name, rows, sessions, usable, signs, shared_flights):
    flight = read_recording(shared_flights / "betaflight" / f"fc_{name}", full_scale=1.0)
    assert any(f"{rows} rows were resampled" in note for note in flight.notes)
    assert any(f"{sessions} sessions" in note for note in flight.notes) == (sessions > 1)
    assert np.nanmedian(np.linalg.norm(flight.specific_force, axis=1)) == pytest.approx(GRAVITY, rel=0.1)
    assert 3 * 3.5 < np.median(flight.voltage) < 6 * 4.3
    parts = usable_stretches(flight)
    kept = sum(part.length for part in parts)
    assert kept == 0 if usable == 0 else kept > usable * np.ptp(flight.time)
    if signs is not None:
        assert rotor_signs([cut(flight, part) for part in parts]) == signs
