"""Real logs of Betaflight: rows, usable stretches, the airframe's draft. Decoding takes seconds: once for each log."""

import numpy as np
import pytest
from recorded_logs import GRAVITY
from test_airframe_draft import drafted

from jaxos4.logs import blackbox_frames, blackbox_raw, read_log
from jaxos4.logs.blackbox_frames import Numbers
from jaxos4.recording.motion import RotorSigns
from jaxos4.recording.usable import usable_stretches


@pytest.fixture(scope="module", autouse=True)
def decoded_once():
    """The tests of this module read each log again, and decode its frames once.

    The decoder's methods are called millions of times: the tests of `test_logs_blackbox.py` check their types.
    """
    decode, known = blackbox_raw.decode_frames, {}

    def decode_once(settings, data, wanted):
        key = hash(data), tuple(sorted(wanted))
        if key not in known:
            known[key] = decode(settings, data, wanted)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blackbox_raw, "decode_frames", decode_once)
        for kind in (Numbers, blackbox_frames._Predictor, blackbox_frames._Stream):
            for name, method in list(vars(kind).items()):
                if hasattr(method, "__wrapped__"):
                    patch.setattr(kind, name, method.__wrapped__)
        yield


@pytest.mark.parametrize(
    ("name", "rows", "sessions"), [("btfl_001.bbl", 24991, 2), ("btfl_002.bbl", 66640, 1), ("LOG00037.BFL", 16774, 1)]
)
def test_the_frames_are_those_of_another_decoder(name, rows, sessions, shared_flights):
    flight, notes = read_log(shared_flights / "betaflight" / f"fc_{name}", full_scale=1.0)
    assert any(f"{rows} rows were resampled" in note for note in notes)
    assert any(f"{sessions} sessions" in note for note in notes) == (sessions > 1)
    size = np.linalg.norm(np.asarray(flight.specific_force), axis=1)
    assert np.nanmedian(size) == pytest.approx(GRAVITY, rel=0.1)
    assert 3 * 3.5 < float(np.median(flight.voltage)) < 6 * 4.3


@pytest.mark.parametrize(("name", "usable"), [("001.bbl", 0.0), ("002.bbl", 0.7), ("LOG00037.BFL", 0.9)])
def test_real_flights_of_betaflight(name, usable, shared_flights):
    """The second session of the first was carried by hand, with idle throttle."""
    path = shared_flights / "betaflight" / f"fc_{name if name[0] == 'L' else 'btfl_' + name}"
    flight, _ = read_log(path, full_scale=1.0)
    kept = sum(part.length for part in usable_stretches(flight))
    duration = float(flight.time[-1] - flight.time[0])
    assert kept == 0 if usable == 0 else kept > usable * duration


def test_the_rotors_are_in_the_order_of_betaflight(shared_flights, run, tmp_path):
    """Rear right, front right, rear left, front left; props out."""
    signs = RotorSigns((-1, 1, -1, 1), (-1, -1, 1, 1), (1, -1, -1, 1))
    airframe = drafted(shared_flights / "betaflight" / "fc_btfl_002.bbl", signs, run, tmp_path)
    assert 200 < float(airframe.hover_speed) < 700
