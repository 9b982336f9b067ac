"""Logs of Betaflight, INAV and Indiflight: exports, and logs that are not decoded."""

import numpy as np
from recorded_logs import GRAVITY, RPM, blackbox_csv, force, rates, speeds

RATES = ("p", "q", "r")
SETTINGS = {"Product": "Blackbox flight data recorder by Nicholas Sherlock", "acc_1G": "2048", "motor_poles": "12"}


def recorded(t, *, poles=14, scale=1.0, gyro=rates, accelerometer=force, rotors=speeds):
    """What a Betaflight would log, in its own integers."""
    out = {"loopIteration": np.arange(t.size), "time (us)": np.rint(1e6 * t + 7e6).astype(int)}
    for i in range(3):  # about forward, left and up: right-handed, as gyroscopes are mounted
        out[f"gyroADC[{i}]"] = np.round(np.rad2deg(gyro(t)[:, i]) * scale, 3)
        out[f"accSmooth[{i}]"] = np.rint(accelerometer(t)[:, i] / GRAVITY * 2048).astype(int)
    for i in range(4):
        out[f"motor[{i}]"] = np.rint(48 + (2047 - 48) * (0.3 + 0.1 * i + 0.05 * np.sin(t))).astype(int)
        out[f"eRPM[{i}]"] = np.rint(rotors(t)[:, i] / RPM * (poles / 2) / 100).astype(int)
    return out


T = 0.002 * np.arange(1500)


def without(columns, *prefixes):
    return {name: values for name, values in columns.items() if not name.startswith(prefixes)}


def unsigned(value):
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def signed(value):
    return unsigned((value << 1 ^ value >> 31) & 0xFFFFFFFF)


def bbl(columns, *, settings=None, interval=32, end=True):
    """A session with the integers `columns`: signed numbers only, and a complete frame every `interval` rows."""
    columns = {name.replace("time (us)", "time"): np.rint(values).astype(int) for name, values in columns.items()}
    columns["loopIteration"] = 4 * np.arange(columns["time"].size)
    predictors = [{"loopIteration": 6, "time": 2}.get(name, 3 if name[:5] == "motor" else 1) for name in columns]
    others = [i for i, name in enumerate(columns) if name[:5] == "motor" and name != "motor[0]"]
    lines = {
        **{"Product": "Blackbox flight data recorder by Nicholas Sherlock", "Data version": 2},
        "Field I name": ",".join(columns),
        "Field I predictor": ",".join("5" if i in others else "0" for i in range(len(columns))),
        "Field I encoding": ",".join("0" for _ in columns),
        "Field P predictor": ",".join(map(str, predictors)),
        "Field P encoding": ",".join("9" if name == "loopIteration" else "0" for name in columns),
        **{"Field S name": "flightModeFlags,stateFlags", "Field S predictor": "0,0", "Field S encoding": "1,1"},
        **{"I interval": 4 * interval, "P interval": 4},
        **(settings or {"acc_1G": 2048, "motor_poles": 14, "motorOutput": "48,2047"}),
    }
    out = bytearray("".join(f"H {key}:{value}\n" for key, value in lines.items()).encode())
    table = np.column_stack(list(columns.values()))
    for k, row in enumerate(table.tolist()):
        if k % interval == 0:
            first = row[list(columns).index("motor[0]")] if others else 0
            out += b"E\x00" + unsigned(k) + b"S\x01\x07" + b"I"
            out += b"".join(signed(value - first * (i in others)) for i, value in enumerate(row))
            continue
        # The frame after a complete one knows no frame before it.
        before, earlier = table[k - 1], table[k - 1 - (k % interval > 1)]
        guesses = {1: before, 2: 2 * before - earlier, 3: np.trunc((before + earlier) / 2).astype(int)}
        out += b"P" + b"".join(
            signed(int(value - guesses[p][i]))
            for i, (value, p) in enumerate(zip(row, predictors, strict=True))
            if p != 6
        )
    return bytes(out) + (b"E\xffEnd of log\0" if end else b"")


LINES = blackbox_csv(recorded(T[:50])).splitlines()


def replaced(row, old, new):
    return "\n".join([*LINES[:row], LINES[row].replace(old, new, 1), *LINES[row + 1 :]])


FEW = recorded(T[:50])
SIX = FEW | {"motor[4]": np.arange(50), "motor[5]": np.arange(50)}
BAD = {
    "raw": (b"H Product:Blackbox flight data recorder by Nicholas Sherlock\nH ...", "decode it by blackbox_decode"),
    "no frames": (bbl(FEW)[:600], "no frame of it can be decoded"),
    "unknown encoding": (bbl(FEW).replace(b"encoding:1,1", b"encoding:1,5"), "an encoding that is not known, 5"),
    "no fields": (bbl(FEW).replace(b"Field I name", b"Field I nom"), "its header is damaged"),
    "six raw motors": (bbl(SIX), "more than four motors"),
    "header only": (LINES[0], "has a header and no data"),
    "a cut line": ("\n".join(LINES)[:-20], "row 51"),
    "text": (replaced(5, LINES[5].split(", ")[2], "fast"), "row 6, column gyroADC[0]"),
    "time backward": ("\n".join([*LINES[:5], LINES[2], *LINES[5:]]), "row 6, column time (us)"),
    "no time": (replaced(0, "time (us)", "elapsed"), "there is no time"),
    "no gyro": (replaced(0, "gyroADC[1]", "other"), "there are no body rates"),
    "no motors": (blackbox_csv(without(FEW, "motor", "eRPM")), "column motor[0]: is missing"),
    "six motors": (blackbox_csv(SIX), "more than four motors"),
    "settings above": ('"acc_1G","2048"\n' + "\n".join(LINES[:5]) + "\n1,2", "row 7"),
    "too fast": (blackbox_csv(recorded(T[:50], scale=200)), ["beyond 60 rad/s", "28 of 50 values", "is not the one"]),
}
SMALL = blackbox_csv(recorded(T[:30]), settings=SETTINGS).encode()
SMALL_RAW = bbl(FEW) * 2
