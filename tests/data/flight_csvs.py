"""Flight CSV files, good and bad."""

import numpy as np
from recorded_logs import table_csv

from jaxos4.logs import read_recording

HEADER = "t,omega1,omega2,omega3,omega4,p,q,psi"
ROWS = [f"{0.01 * k:.2f},100,101,102,103,{0.1 * k:.1f},-0.2,0.3" for k in range(6)]


def read_flight_and_notes(path, airframe=None):
    found = read_recording(path, airframe)
    return found.flight, found.notes


def write_log(path):
    """A short log."""
    time, names = 0.01 * np.arange(400), "t,omega1,omega2,omega3,omega4,p,q,r".split(",")
    path.write_bytes(table_csv(names, time, np.full((400, 4), 1740.0), 0.1 * np.sin(np.outer(time, [3, 4, 5]))))
    return path


def csv(header=HEADER, rows=ROWS):
    return "\n".join([header, *rows]) + "\n"


def edited(row, column, cell, header=HEADER):
    """A good file with one cell replaced; rows are counted as in messages."""
    cells = [line.split(",") for line in ROWS]
    cells[row - 2][header.split(",").index(column)] = cell
    return csv(header, [",".join(line) for line in cells])


BAD = {
    "empty": ("", ["is empty"]),
    "blank": ("\n\n", ["row 1", "is empty", "header"]),
    "header only": (csv(rows=[]), ["has a header and no data"]),
    "one row": (csv(rows=ROWS[:1]), ["has a header and one row of data"]),
    "no header": (csv(header=ROWS[0]), ["row 1", "contains numbers instead of the header"]),
    "semicolons": (csv().replace(",", ";"), ["row 1", "separated by ';'", "commas"]),
    "tabs": (csv().replace(",", "\t"), ["row 1", "separated by tabs", "commas"]),
    "no t": (
        csv(HEADER.replace("t,", "time,")),
        ["column t", "there is no time; ", "There are 'omega1', ", "'time': rename one, or give a column map."],
    ),
    "empty t": (csv(rows=["," + row.split(",", 1)[1] for row in ROWS]), ["column t", "no time"]),
    "empty cell of t": (edited(4, "t", ""), ["row 4, column t", "is empty"]),
    "no rotors": (csv(HEADER.replace("omega", "w")), ["column omega1", "command1..4"]),
    "all-empty rotor": (csv(rows=[row.replace(",102,", ",,") for row in ROWS]), ["column omega3"]),
    "rotor without a first value": (edited(2, "omega2", ""), ["row 2, column omega2", "no earlier value to hold"]),
    "nothing in the states": (csv(rows=[row.rsplit(",", 3)[0] + ",,," for row in ROWS]), ["no state was measured"]),
    "twice the same": (csv(HEADER.replace("q", " p ")), ["row 1, column p", "occurs 2 times"]),
    "a cell short": (csv(rows=[*ROWS[:2], ROWS[2].rsplit(",", 1)[0], *ROWS[3:]]), ["row 4", "7 cells", "header has 8"]),
    "a cut line": (csv(rows=[*ROWS, "0.0"]), ["row 8", "has 1 cell,"]),
    "a blank row": (csv(rows=[*ROWS[:2], "", *ROWS[2:]]), ["row 4", "is blank"]),
    "an open quote": (csv(rows=[*ROWS[:2], ROWS[2].replace(",-0.2", ',"-0.2'), *ROWS[3:]]), ["row 4", "7 cells"]),
    "text": (edited(3, "q", "fast"), ["row 3, column q", "'fast'", "not a number"]),
    "decimal comma": (edited(3, "q", '"0,5"'), ["row 3, column q", "'0,5'", "not a number"]),
    "underscore": (edited(3, "q", "1_0"), ["row 3, column q", "not a number"]),
    "nan": (edited(3, "q", "nan"), ["row 3, column q", "'nan'", "leave the cell empty"]),
    "infinity": (edited(3, "omega1", "-Inf"), ["row 3, column omega1", "leave the cell empty"]),
    "overflow": (edited(3, "q", "1e999"), ["row 3, column q", "too large for a number", "leave the cell empty"]),
    "time back": (edited(4, "t", "0.001"), ["row 4, column t", "backward, from 0.01 s to 0.001 s"]),
    "time again": (edited(4, "t", "0.01"), ["row 4, column t", "repeats 0.01 s of row 3"]),
    "milliseconds": (csv(rows=[f"{5 * k},1,1,1,1,0,0,0" for k in range(5)]), ["column t", "divide"]),
    "nanoseconds": (edited(4, "t", "1.7e18"), ["row 4, column t", "in seconds"]),
    "gigahertz": (csv(rows=[f"{k}e-9,1,1,1,1,0,0,0" for k in range(5)]), ["column t", "microsecond"]),
    "a long gap": (
        csv(rows=[f"{k}e-6,1,1,1,1,0,0,0" for k in range(5)] + ["1e6,1,1,1,1,0,0,0"]),
        ["row 7, column t", "a gap of 1e+06 s", "1e+12 samples", "cut the file there"],
    ),
    "negative speed": (edited(5, "omega2", "-3"), ["row 5, column omega2", "drop the sign"]),
    "absurd speed": (edited(5, "omega2", "2e5"), ["row 5, column omega2", "rad/s", "rpm"]),
    "command in percent": (csv(HEADER.replace("omega", "command")), ["row 2, column command1", "full scale"]),
    "fast rate": (edited(5, "p", "-61"), ["row 5, column p", "looks like deg/s", "57.3"]),
    "psi wrapped at 180": (edited(5, "psi", "-359.8"), ["row 5, column psi", "looks like degrees"]),
    "theta": (edited(5, "q", "-1.6").replace("q", "theta"), ["row 5, column theta", "degrees", "pi/2"]),
    "position": (edited(5, "q", "1e7").replace("q", "x"), ["row 5, column x", "metres"]),
    "force": (edited(5, "q", "1001").replace("q", "ax"), ["row 5, column ax", "m/s^2"]),
    "millivolts": (edited(5, "q", "11100").replace("q", "voltage"), ["row 5, column voltage", "mV, divide by 1000"]),
    "nul": (edited(3, "q", "\0"), ["row 3, column q", "not text in UTF-8"]),
    "latin-1": (edited(3, "q", "é").encode("latin-1"), ["row 3, column q", "not text in UTF-8"]),
    "endless header": (b"t" * (1 << 21), ["row 1", "longer than a million"]),
    "endless row": ((csv() + "1" * (1 << 22)), ["row 8", "longer than a million"]),
    "endless cell": (edited(3, "q", '"' + "1" * 200_000 + '"'), ["row 3", "too long"]),
    "long cell": (edited(3, "q", "x" * 1000), ["row 3, column q", "x...'"]),
}
