"""An airframe's file with everything that a log knows of its vehicle, and with marks at what must be measured."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np

from ..airframe import GRAVITY, GUESS
from .motion import rotor_signs
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
    facts, full = recording.facts, FULL_SCALE if recording.commanded else 1.0
    parts = [cut(recording, part) for part in stretches(recording) if not part.reason]
    signs, hover = None if facts.too_slow else rotor_signs(parts), _hover(parts)
    spins = facts.rotor_spins or (None if signs is None else signs.spins)
    template = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True, keep_trailing_newline=True)
    template.loader = jinja2.PackageLoader("jaxos4.recording", ".")
    text = template.get_template("airframe.toml.j2").render(
        name=Path(recording.name).name,
        facts=facts,
        corners=[] if signs is None else [_corner(*each) for each in zip(signs.forward, signs.left, strict=True)],
        spins=None if spins is None else [int(spin) for spin in spins],
        hover=hover,
        full=full,
        seconds=sum(float(np.ptp(part.time)) for part in parts),
        commanded=recording.commanded,
        guess=GUESS,
        short=_short,
    )
    known = {"rotor_positions": facts.rotor_positions, "rotor_spins": spins, "hover_speed": hover}
    return AirframeDraft(text, ("mass", *(key for key, value in known.items() if value is None)))


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


def _corner(forward: float, left: float) -> tuple[str, str, str]:
    """The signed x and y of a rotor, and its place in words."""
    x, y = "x" if forward > 0 else "-x", "y" if left > 0 else "-y"
    return x, y, f"{'front' if forward > 0 else 'rear'} {'left' if left > 0 else 'right'}"


def _short(value: Any) -> Any:
    """A number or nested numbers with at most four digits."""
    if isinstance(value, tuple | list):
        return [_short(each) for each in value]
    return float(f"{value:.4g}")
