"""The provenance of an identification: inputs, settings, versions."""

from typing import Any

import jax
import msgspec

from .._version import __version__
from ..airframe import PRESETS, Airframe
from ..shooting import ShootingProblem


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """Inputs, settings and versions of an identification. Fields that do not apply are not written.

    - `flight`: the name of the flight of an OS4; `flights`, `validate`: of a vehicle's recordings.
    - `airframe`: its name or file; `terms`: of the vehicle's model; `battery_voltage`: its usual one [V].
    - `channels`, `initial_state`, `windows`, `samples`: of the problem of a flight.
    - `sample_time`: of the fitted data [s]. `fitted_seconds`, `tested_seconds`: how long these last [s].
    - `network`: where a network is from, and how it was trained.
    - `notes`: about the data. `command`: the command line, if there was one.
    - `version`, `jax`, `device`, `precision`: of the computation.
    """

    flight: str | msgspec.UnsetType = msgspec.UNSET
    flights: list[str] | msgspec.UnsetType = msgspec.UNSET
    validate: str | None | msgspec.UnsetType = msgspec.UNSET
    airframe: str
    channels: str | msgspec.UnsetType = msgspec.UNSET
    initial_state: str | msgspec.UnsetType = msgspec.UNSET
    windows: int | msgspec.UnsetType = msgspec.UNSET
    samples: int | msgspec.UnsetType = msgspec.UNSET
    terms: list[str] | msgspec.UnsetType = msgspec.UNSET
    sample_time: float
    fitted_seconds: float | msgspec.UnsetType = msgspec.UNSET
    tested_seconds: float | msgspec.UnsetType = msgspec.UNSET
    battery_voltage: float | msgspec.UnsetType = msgspec.UNSET
    network: dict[str, Any] | msgspec.UnsetType = msgspec.UNSET
    notes: list[str] = []
    command: str | msgspec.UnsetType = msgspec.UNSET
    version: str
    jax: str
    device: str
    precision: str


def versions(problem: ShootingProblem) -> dict[str, Any]:
    """Versions, device and precision."""
    return {
        "version": __version__,
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "precision": str(problem.flight.time.dtype),
    }


def airframe_name(airframe: Airframe) -> str:
    """The name of a preset, or "custom"."""
    return next((name for name, preset in PRESETS.items() if preset is airframe), "custom")
