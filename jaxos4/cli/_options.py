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

VehicleModel = StrEnum("VehicleModel", list((*Model, "flight")))

FlightFile = Annotated[Path, Argument(metavar="FLIGHT.csv", help="The recorded flight.")]
ModelOption = Annotated[Model, Option(help="Equations of motion: as published, or corrected.")]
AirframeOption = Annotated[str, Option(help="os4, os4-simulator, voos, or a TOML file.")]
BracketOption = Annotated[Path | None, Option(help="TOML file: alpha1 = [lower, upper], ...")]
ChannelsOption = Annotated[Channels | None, Option(help="Channels to fit. Default: all that were measured.")]
InitialStateOption = Annotated[InitialState, Option(help="free: estimated too; known: equal to the first sample.")]
WindowOption = Annotated[
    float | None, Option(help="Multiple shooting: windows of this length [s], each with its own initial state.")
]
OutOption = Annotated[Path | None, Option(help="JSON file to write.")]

# The options that `simulate` and `design` share.
OpenLoopModelOption = Annotated[Model | None, Option(help="Equations of motion. Default: published.")]
DurationOption = Annotated[float | None, Option(help="Duration [s]. Default: 5; with --closed-loop: 20.")]
SampleTimeOption = Annotated[float | None, Option(help="Sample time [s]. Default: 0.01; with --closed-loop: 0.004.")]
GustOption = Annotated[
    float | None, Option(help="With --closed-loop: standard deviation of torque / inertia [rad/s^2]. Default: 5.")
]
LagOption = Annotated[float | None, Option(help="With --closed-loop: lag of the rotors [s]. Default: 0.05.")]
DelayOption = Annotated[float | None, Option(help="With --closed-loop: delay of the commands [s]. Default: 0.01.")]
SensorsOption = Annotated[
    Sensors | None,
    Option(help="With --closed-loop: what is logged. Default: commands if the airframe has max_rotor_speed."),
]

# The options of flights in open loop, and those of flights in closed loop, with their defaults. `None`: the library's.
_OPEN = {"duration": 5.0, "dt": 0.01, "accuracy": 1.0, "model": Model["published"], "slew": None, "speeds": None}
_OPEN |= {"excitation": Excitation["multisine"], "method": Method["euler"], "noise": 0.0}
_OPEN |= {"channels": Channels["all"], "initial_state": InitialState["free"]}
_CLOSED = {"duration": 20.0, "dt": 0.004, "accuracy": 5.0, "gust": 5.0, "lag": None, "delay": None}
_CLOSED |= {"sensors": None, "references": None}
_MOST = {"gust": 1e6, "lag": 1.0, "delay": 1.0, "noise": 1e6}


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


def of_kind(closed_loop: bool, asked: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a command, with the defaults of its kind of flight.

    Refuses options of the other kind, and settings that are out of range.
    """
    own, others = (_CLOSED, _OPEN) if closed_loop else (_OPEN, _CLOSED)
    for name, value in given(**asked).items():
        if name in others and name not in own:
            how = "without --closed-loop; leave it out" if closed_loop else "with --closed-loop; add that"
            raise InputError(f"--{name.replace('_', '-')}: is for flights {how}.")
        if name in _MOST and not 0 <= value <= _MOST[name]:
            raise InputError(f"--{name}: must lie in 0 to {_MOST[name]:g}, got {value}.")
    check_seed(asked["seed"])
    return dict(asked) | {name: default for name, default in own.items() if asked.get(name) is None}


def make_loop(asked: Mapping[str, Any]) -> "ClosedLoop":
    """The vehicle in closed loop with these options."""
    from ..airframe import load_airframe
    from ..closed_loop import ClosedLoop

    vehicle = load_airframe(asked["airframe"])
    logged, scaled = chosen(asked["sensors"]), vehicle.has_full_scale
    if logged == "commands" and not scaled:
        raise InputError(
            f"--sensors commands: {asked['airframe']} has no max_rotor_speed [rad/s]; set it, or log speeds."
        )
    settings = given(rotor_lag=asked["lag"], rotor_delay=asked["delay"])
    return ClosedLoop(vehicle, logged=logged or ("commands" if scaled else "speeds"), gust=asked["gust"], **settings)
