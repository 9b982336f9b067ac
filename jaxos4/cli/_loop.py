"""The options that `simulate` and `design` share: flights in open and in closed loop."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InputError
from ._choices import Sensors

if TYPE_CHECKING:
    from ..closed_loop import ClosedLoop

DurationOption = Annotated[
    float | None, typer.Option(help="Duration [s]. Default: 5; with --closed-loop: 20.", metavar="SECONDS")
]
SampleTimeOption = Annotated[
    float | None, typer.Option(help="Sample time [s]. Default: 0.01; with --closed-loop: 0.004.", metavar="SECONDS")
]
GustOption = Annotated[
    float | None,
    typer.Option(help="With --closed-loop: standard deviation of torque / inertia [rad/s^2]. Default: 5."),
]
LagOption = Annotated[
    float | None, typer.Option(help="With --closed-loop: lag of the rotors. Default: 0.05.", metavar="SECONDS")
]
DelayOption = Annotated[
    float | None, typer.Option(help="With --closed-loop: delay of the commands. Default: 0.01.", metavar="SECONDS")
]
SensorsOption = Annotated[
    Sensors | None,
    typer.Option(help="With --closed-loop: what is logged. Default: commands if the airframe has max_rotor_speed."),
]
_MOST = {"gust": 1e6, "lag": 1.0, "delay": 1.0}


def times_of(closed_loop: bool, duration: float | None, dt: float | None) -> tuple[float, float]:
    """Duration and sample time [s], by default those of the kind of flight."""
    usual = (20.0, 0.004) if closed_loop else (5.0, 0.01)
    return usual[0] if duration is None else duration, usual[1] if dt is None else dt


def check_kind(closed_loop: bool, *, of_open: Mapping[str, Any], of_closed: Mapping[str, Any]) -> None:
    """Refuse options of the other kind of flight, and settings of the closed loop that are out of range."""
    for name, value in (of_open if closed_loop else of_closed).items():
        if value is not None:
            how = "without --closed-loop; leave it out" if closed_loop else "with --closed-loop; add that"
            raise InputError(f"--{name}: is for flights {how}.")
    for name, most in _MOST.items():
        value = of_closed[name]
        if value is not None and not 0 <= value <= most:
            raise InputError(f"--{name}: must lie in 0 to {most:g}, got {value}.")


def loop_of(
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
    settings = {"rotor_lag": lag, "rotor_delay": delay}
    given = {name: value for name, value in settings.items() if value is not None}
    logged = sensors.value if sensors else "commands" if scaled else "speeds"
    return ClosedLoop(vehicle, gust=5.0 if gust is None else gust, logged=logged, **given)
