"""The values of options, the options that several commands share, and the checks of their values."""

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from .._files import read_toml
from ..errors import InputError
from ..estimators import ESTIMATORS

if TYPE_CHECKING:
    from ..closed_loop import ClosedLoop

# The names in the library's tables, written out because an import of these tables takes seconds; a test compares them.
# `list(...)`: pyright takes the values of a written list for numbers.
Model = StrEnum("Model", list(("published", "corrected")))
Excitation = StrEnum("Excitation", list(("multisine", "doublet", "3211", "chirp")))
Method = StrEnum("Method", list(("euler", "rk4", "diffrax")))
Sensors = StrEnum("Sensors", list(("commands", "speeds")))
Channels = StrEnum("Channels", list(("rates", "attitude", "all")))
InitialState = StrEnum("InitialState", ["free", "known"])
Estimator = StrEnum("Estimator", list(ESTIMATORS))
Simulator = StrEnum("Simulator", list(("mujoco", "rotorpy", "sdf")))
Features = StrEnum("Features", list(("score", "raw")))
Approximator = StrEnum("Approximator", list(("mlp", "cmac")))

VehicleModel = StrEnum("VehicleModel", list((*Model, "flight")))

FlightFile = Annotated[Path, Argument(metavar="FLIGHT.csv", help="The recorded flight.")]
ModelOption = Annotated[Model, Option(help="Equations of motion: as published, or corrected.")]
AirframeOption = Annotated[str, Option(help="os4, os4-simulator, voos, or a TOML file.")]
BracketOption = Annotated[Path | None, Option(help="TOML file: alpha1 = [lower, upper], ...")]
ChannelsOption = Annotated[Channels | None, Option(help="Channels to fit. Default: all that were measured.")]
InitialStateOption = Annotated[InitialState, Option(help="free: estimated too; known: equal to the first sample.")]
WindowOption = Annotated[
    float | None,
    Option(metavar="SECONDS", help="Multiple shooting: windows of this length, each with its own initial state."),
]
OutOption = Annotated[Path | None, Option(help="JSON file to write.")]

# The options that `simulate` and `design` share.
OpenLoopModelOption = Annotated[Model | None, Option(help="Equations of motion. Default: published.")]
DurationOption = Annotated[
    float | None, Option(help="Duration [s]. Default: 5; with --closed-loop: 20.", metavar="SECONDS")
]
SampleTimeOption = Annotated[
    float | None, Option(help="Sample time [s]. Default: 0.01; with --closed-loop: 0.004.", metavar="SECONDS")
]
GustOption = Annotated[
    float | None, Option(help="With --closed-loop: standard deviation of torque / inertia [rad/s^2]. Default: 5.")
]
LagOption = Annotated[
    float | None, Option(help="With --closed-loop: lag of the rotors. Default: 0.05.", metavar="SECONDS")
]
DelayOption = Annotated[
    float | None, Option(help="With --closed-loop: delay of the commands. Default: 0.01.", metavar="SECONDS")
]
SensorsOption = Annotated[
    Sensors | None,
    Option(help="With --closed-loop: what is logged. Default: commands if the airframe has max_rotor_speed."),
]
_MOST = {"gust": 1e6, "lag": 1.0, "delay": 1.0}


def check_seed(seed: int) -> None:
    """Refuses a random seed that JAX cannot use."""
    if not 0 <= seed < 2**63:
        raise InputError(f"--seed: must lie in 0 to 2^63 - 1, got {seed}.")


def chosen(choice: StrEnum | None) -> str | None:
    """The value of an option, as the library takes it."""
    return None if choice is None else str(choice.value)


def given(**settings: Any) -> dict[str, Any]:
    """The settings that have a value."""
    return {name: value for name, value in settings.items() if value is not None}


def read_bracket(path: Path | None) -> dict[str, Any] | None:
    """The table in the file of `--bracket`. Raises `InputError` if it is no TOML file."""
    return None if path is None else read_toml(path)


def flight_times(closed_loop: bool, duration: float | None, dt: float | None) -> tuple[float, float]:
    """Duration and sample time [s], by default those of the kind of flight."""
    usual = (20.0, 0.004) if closed_loop else (5.0, 0.01)
    return usual[0] if duration is None else duration, usual[1] if dt is None else dt


def check_kind(closed_loop: bool, *, open_only: Mapping[str, Any], closed_only: Mapping[str, Any]) -> None:
    """Refuses options of the other kind of flight, and settings of the closed loop that are out of range."""
    for name, value in (open_only if closed_loop else closed_only).items():
        if value is not None:
            how = "without --closed-loop; leave it out" if closed_loop else "with --closed-loop; add that"
            raise InputError(f"--{name}: is for flights {how}.")
    for name, most in _MOST.items():
        value = closed_only[name]
        if value is not None and not 0 <= value <= most:
            raise InputError(f"--{name}: must lie in 0 to {most:g}, got {value}.")


def make_loop(
    airframe: str, gust: float | None, lag: float | None, delay: float | None, sensors: Sensors | None
) -> "ClosedLoop":
    """The vehicle in closed loop with these options."""
    from ..airframe import load_airframe
    from ..closed_loop import ClosedLoop
    from ..models.terms import has_full_scale

    vehicle = load_airframe(airframe)
    scaled = has_full_scale(vehicle)
    if sensors == "commands" and not scaled:
        raise InputError(f"--sensors commands: {airframe} has no max_rotor_speed [rad/s]; set it, or log speeds.")
    logged, gust = chosen(sensors) or ("commands" if scaled else "speeds"), 5.0 if gust is None else gust
    return ClosedLoop(vehicle, logged=logged, gust=gust, **given(rotor_lag=lag, rotor_delay=delay))
