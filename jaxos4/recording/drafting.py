"""An airframe's file with everything that a log knows of its vehicle, and with marks at what must be measured."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..airframe import GRAVITY, GUESS
from .motion import RotorSigns, rotor_signs
from .pieces import cut
from .reading import Recording
from .usable import stretches

FULL_SCALE = 1000.0
"""Commands have no unit: a command of 1 counts as this rotor speed [rad/s], if nothing better is known."""

_PLAUSIBLE = (0.5, 2.0)  # [g], the median of the accelerometer in flight


class AirframeDraft(NamedTuple):
    """The text of an airframe's file, and the keys that must be filled in before it can be used."""

    text: str
    missing: tuple[str, ...]


def airframe_draft(recording: Recording) -> AirframeDraft:
    """Begin the file of an airframe with what a log knows: spins, hover speed, sometimes the rotors' positions.

    What must be weighed or measured is a comment, so that `load_airframe` names the first of these keys as missing.

    **Arguments:** `recording`: read without an airframe, and with `full_scale=1.0`.
    """
    facts, lines, missing = recording.facts, [], ["mass"]

    def say(*texts: str) -> None:
        lines.extend(f"# {text}" for text in texts)

    def add(key: str, value: Any, comment: str) -> None:
        lines.append(f"{key} = {json.dumps(value)} # {comment}")

    parts = [cut(recording, part) for part in stretches(recording) if not part.reason]
    signs, hover = None if facts.too_slow else rotor_signs(parts), _hover(parts)
    spins = facts.rotor_spins or (None if signs is None else signs.spins)
    say(f"The airframe of {Path(recording.name).name}. SI units.")
    lines.extend(["", "# Weigh and measure: write the numbers, and remove the # in front."])
    say("mass =   # kg, with battery: all inertias are proportional to it")
    if facts.rotor_positions is None:
        missing.append("rotor_positions")
        say(*_positions_to_measure(signs))
    lines.extend(["", "# From the log."])
    if facts.rotor_positions is not None:
        add("rotor_positions", _short(facts.rotor_positions), "m, x forward and y left: check")
        say("(settings of the autopilot, which needs only their ratios; inertias need the true distances)")
    if spins is None:
        missing.append("rotor_spins")
        add("rotor_spins", [], "fill in, such as [1, -1, 1, -1]; 1: counter-clockwise seen from above")
    else:
        how = "settings of the autopilot" if facts.rotor_spins else "as the vehicle yaws in this flight"
        add("rotor_spins", [int(spin) for spin in spins], f"1: counter-clockwise seen from above; {how}")
    full = FULL_SCALE if recording.commanded else 1.0
    if hover is None:
        missing.append("hover_speed")
        say("hover_speed =   # rad/s of each rotor: nothing in this log flies, so fill it in")
    else:
        speed, felt = hover
        seconds = sum(float(np.ptp(part.time)) for part in parts)
        how = f"{'by the accelerometer' if felt else 'the median'} in {seconds:.1f} s of flight"
        add("hover_speed", _short(speed * full), f"rad/s of each rotor; {how}")
        if not felt:
            say("Without an accelerometer this must be right: 1 % is an error of 2 % in every inertia.")
    if recording.commanded:
        add("max_rotor_speed", full, "rad/s at command 1: a convention. If you change it, scale hover_speed")
    lines.extend(["", "# Guesses from mass and positions, where the search begins. Numbers are better."])
    add("inertia", GUESS, "kg m^2, as [Ix, Iy, Iz]")
    add("drag_coefficient", GUESS, "N m s^2/rad^2: Iz is proportional to it")
    add("rotor_inertia", GUESS, "kg m^2, of a propeller with its motor's bell")
    return AirframeDraft("\n".join(lines) + "\n", tuple(missing))


def _hover(parts: Sequence[Recording]) -> tuple[float, bool] | None:
    """The rotor speed at which thrust is as large as the weight, in the unit of the flight, and whether it was felt.

    It is felt by a plausible accelerometer. If there is none, the median thrust in flight counts as the weight.
    """
    if not parts:
        return None
    squares = np.concatenate([(part.omega**2).mean(axis=1) for part in parts])
    force = [part.specific_force[:, 2] for part in parts if part.specific_force is not None]
    vertical = np.concatenate(force) if len(force) == len(parts) else np.full(1, np.nan)
    share = float(np.median(vertical[np.isfinite(vertical)])) / GRAVITY if np.isfinite(vertical).any() else np.nan
    felt = bool(_PLAUSIBLE[0] < share < _PLAUSIBLE[1])
    return float(np.sqrt(np.median(squares) / (share if felt else 1.0))), felt


def _positions_to_measure(signs: RotorSigns | None) -> tuple[str, str]:
    if signs is None:
        return (
            "rotor_positions = [[x1, y1], [x2, y2], [x3, y3], [x4, y4]]  # m, x forward and y left, in the log's order",
            "(this flight does not show which rotor is where)",
        )
    signed = [("x" if x > 0 else "-x", "y" if y > 0 else "-y") for x, y in zip(signs.forward, signs.left, strict=True)]
    words = {"x": "front", "-x": "rear", "y": "left", "-y": "right"}
    names = ", ".join(f"{i + 1} {words[x]} {words[y]}" for i, (x, y) in enumerate(signed))
    return (
        f"rotor_positions = [{', '.join(f'[{x}, {y}]' for x, y in signed)}]  # m: numbers for x (forward) and y (left)",
        f"(as the vehicle turns in this flight: {names})",
    )


def _short(value: Any) -> Any:
    """A number or nested numbers with at most four digits."""
    if isinstance(value, tuple | list):
        return [_short(each) for each in value]
    return float(f"{value:.4g}")
