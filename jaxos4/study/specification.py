"""The specification of a study: the axes of a grid of simulated flights, and the cells of that grid.

A scenario is a point of the grid, and a cell is `batch` flights of a scenario. Flight i has the same random numbers in
every scenario, so that differences between estimators, or between scales of noise, are paired.
"""

import itertools
import math
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_type_hints

import msgspec
import numpy as np

from .._custom_types import NotNegative, Positive, RotorSpeeds, as_float
from .._files import read_toml
from ..airframe import PRESETS, Airframe, airframe_from_table
from ..errors import InputError, in_words, named, of_schema, shortened
from ..estimators import ESTIMATORS
from ..excitation import EXCITATIONS
from ..models import MODELS
from ..models.state import CHANNELS
from ..networks import NetworkEstimator
from ..noise import NOISES
from ..simulation import METHODS

Count = Annotated[int, msgspec.Meta(ge=1)]
Speeds = tuple[NotNegative, NotNegative, NotNegative, NotNegative]
Seed = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]

_CHOICES: dict[str, Collection[str]] = {"models": MODELS, "excitations": EXCITATIONS, "methods": METHODS}
_CHOICES |= {"noises": NOISES, "channels": CHANNELS, "estimators": ESTIMATORS}
_MOST = 1_000_000  # cells, each of which is a file; and samples of a flight


class Training(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Training of a study's networks: the table `network` of the specification. See `NetworkEstimator`.

    `hybrid_channels`: what the hybrid's network reads, as far as the scenario measures it. A network alone reads rates.
    """

    steps: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = NetworkEstimator.steps
    held_out: Annotated[int, msgspec.Meta(ge=1000)] = NetworkEstimator.held_out
    hybrid_channels: Literal["rates", "attitude", "all"] = "all"
    seed: Seed = 0


class Scenario(NamedTuple):
    """One point of the grid: what is flown, how it is measured, and which estimator identifies it."""

    model: str
    airframe: str
    excitation: str
    duration: float
    method: str
    noise: str
    scale: float
    width: float
    channels: str
    estimator: str

    @property
    def seen(self) -> str:
        """The channels that the estimator looks at."""
        return min(self.channels, ESTIMATORS[self.estimator].looks_at, key=CHANNELS.__getitem__)


AXES = tuple(field if field.endswith("s") else f"{field}s" for field in Scenario._fields)


class Cell(NamedTuple):
    """`batch` flights of a scenario, from the number `first` on; `place` is its index along each axis."""

    number: int
    scenario: Scenario
    place: tuple[int, ...]
    first: int


class Study(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The specification of a study: a TOML file with some of these keys.

    The axes of the grid are lists; every combination is flown `flights` times.

    - `models`, `excitations`, `channels`, `estimators`: names as on the command line.
    - `airframes`: names of presets, or of tables `[airframe.NAME]` with the keys of an airframe file.
    - `input`: more excitations: rotor speeds of each sample, by name. In the file: a table of paths of CSV files of
      `jaxos4 design`, with `t` and `omega1..4`, relative to the folder of the specification.
    - `durations` [s], at a sample time of `dt` [s].
    - `methods`: the integration method of true flights; estimators simulate by `fit_method`.
    - `noises`, `scales`: kinds of noise, and multiples of the standard sensors'. At scale 0 flights are exact, and
      estimators assume the noise of scale 1.
    - `widths`: widths of the brackets, in multiples of the model's default half-width.
    - `truth`: `"airframe"`: all flights have the airframe's parameters, and the bracket's centre is off them by up to
      80 % of its half-width; `"drawn"`: each flight has its own parameters, uniform in a bracket around the airframe's.
    - `initial_state`: `"known"`, or `"free"`: estimated too.
    - `flights`, `seed`: number of flights of a scenario, and the random seed.
    - `batch`: flights of a cell, identified at once by one device. The last digits of results depend on it.
    - `network`: how networks are trained; a table.
    """

    title: str = "Noise study"
    models: tuple[str, ...] = ("published",)
    airframes: tuple[str, ...] = ("os4",)
    excitations: tuple[str, ...] = ("multisine",)
    durations: tuple[Positive, ...] = (5.0,)
    methods: tuple[str, ...] = ("euler",)
    noises: tuple[str, ...] = ("white",)
    scales: tuple[NotNegative, ...] = (0.1, 1.0, 10.0)
    widths: tuple[Positive, ...] = (1.0,)
    channels: tuple[str, ...] = ("all",)
    estimators: tuple[str, ...] = ("ibss", "network", "hybrid")
    dt: Positive = 0.01
    fit_method: Literal["euler", "rk4"] = "euler"
    truth: Literal["airframe", "drawn"] = "airframe"
    initial_state: Literal["known", "free"] = "known"
    flights: Count = 1000
    seed: Seed = 0
    batch: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 128
    network: Training = Training()
    input: dict[str, tuple[Speeds, ...]] = {}
    airframe: dict[str, dict[str, Any]] = {}

    def __post_init__(self):
        for axis in AXES:
            values = getattr(self, axis)
            if not values:
                raise InputError(f"`{axis}` is empty; give at least one value.")
            if len(set(values)) < len(values):
                raise InputError(f"`{axis}` names a value twice: {', '.join(map(str, values))}; remove one.")
            choices = [*(_CHOICES.get(axis) or values), *(self.input if axis == "excitations" else ())]
            for value in values:
                if isinstance(value, float) and not math.isfinite(value):
                    raise InputError(f"`{axis}` must be finite numbers, got {value}; correct it.")
                if value not in choices:
                    raise InputError(f"`{axis}`: unknown {value!r}; choose from {', '.join(choices)}.")
        names = [("airframe", name) for name in self.airframe] + [("input", name) for name in self.input]
        for key, text in (("title", self.title), *names):
            if not text.isprintable():
                raise InputError(f"`{key}` has a line break or another control character; remove it.")
        for name, table in self.airframe.items():
            if name not in self.airframes:
                raise InputError(f"[airframe.{name}] is not flown; name it in `airframes`, or remove it.")
            if not all(math.isfinite(value) for value in table.values() if isinstance(value, float)):
                raise InputError(f"[airframe.{name}]: not finite; leave out `max_rotor_speed` if it is unknown.")
        for name in self.input:
            if name not in self.excitations:
                raise InputError(f"`input` {name} is not flown; name it in `excitations`, or remove it.")
        for name in self.airframes:
            self.vehicle(name)
        for duration in self.durations:
            if not 2 <= duration / self.dt <= _MOST:
                got = f"{duration:g} s at `dt` {self.dt:g} s"
                raise InputError(f"`durations`: {got} is not 2 to {_MOST} samples; change one.")
        if self.count > _MOST:
            raise InputError(f"{self.count} cells, more than {_MOST}; shorten an axis, or increase `batch`.")

    def check_excitations(self) -> None:
        """Raises `InputError` if an excitation does not fit into one of the durations."""
        for name, excitation, duration in itertools.product(self.airframes, self.excitations, self.durations):
            with named(f"`excitations`: {excitation} of {duration:g} s by {name}"):
                self.omega(excitation, name, duration)

    def vehicle(self, name: str) -> Airframe:
        """The airframe of that name. Raises `InputError` if there is none, or if its table is not usable."""
        if name in self.airframe:
            with named(f"[airframe.{name}]"):
                return airframe_from_table(self.airframe[name])
        if name not in PRESETS:
            presets = ", ".join(PRESETS)
            raise InputError(f"`airframes`: unknown {name!r}; choose from {presets}, or add [airframe.{name}].")
        return PRESETS[name]

    def omega(self, excitation: str, airframe: str, duration: float) -> RotorSpeeds:
        """The rotor speeds of an excitation [rad/s]. Raises `ValueError` if it cannot be flown."""
        if excitation not in self.input:
            return EXCITATIONS[excitation](self.vehicle(airframe), duration=duration, dt=self.dt)
        speeds, fastest = np.asarray(self.input[excitation]), float(self.vehicle(airframe).max_rotor_speed)
        if len(speeds) != round(duration / self.dt) + 1:
            raise ValueError(f"its file lasts {(len(speeds) - 1) * self.dt:g} s; correct `durations`.")
        if speeds.max() > fastest:
            raise ValueError(f"a rotor would exceed the `max_rotor_speed` of {fastest:g} rad/s; design another input.")
        return as_float(speeds)

    def job(self, scenario: Scenario) -> Scenario | None:
        """The scenario of the network that an estimator needs, or `None`. It serves all methods, noises and scales."""
        kind = ESTIMATORS[scenario.estimator]
        channels = self.seed_channels(scenario) if kind.shoots else scenario.seen
        shared = {"method": self.fit_method, "noise": self.noises[0], "scale": 1.0, "estimator": "network"}
        return scenario._replace(channels=channels, **shared) if kind.needs_network else None

    def seed_channels(self, scenario: Scenario) -> str:
        """The channels of a hybrid's network, which only gives the start of the search."""
        return min(scenario.seen, self.network.hybrid_channels, key=CHANNELS.__getitem__)

    def jobs(self) -> dict[Scenario, int]:
        """The networks that the study needs, with their numbers."""
        needed = (self.job(self.cell(index).scenario) for index in range(0, self.count, self.blocks))
        return {job: number for number, job in enumerate(dict.fromkeys(job for job in needed if job))}

    @property
    def shape(self) -> tuple[int, ...]:
        """The lengths of `AXES`."""
        return tuple(len(getattr(self, axis)) for axis in AXES)

    @property
    def blocks(self) -> int:
        """The number of cells of a scenario."""
        return -(-self.flights // self.batch)

    @property
    def count(self) -> int:
        """The number of cells of the study."""
        return math.prod(self.shape) * self.blocks

    def cell(self, index: int) -> Cell:
        """The cell of an index from 0 to `count` - 1. Cells of an estimator, and of a scenario, follow one another."""
        # The estimator is the outermost axis: its compiled programs and its networks serve all its cells.
        estimator, *others, block = np.unravel_index(index, (self.shape[-1], *self.shape[:-1], self.blocks))
        place = tuple(int(i) for i in (*others, estimator))
        values = [getattr(self, axis)[i] for axis, i in zip(AXES, place, strict=True)]
        return Cell(index, Scenario(*values), place, int(block) * self.batch)


def load_study(path: Path) -> Study:
    """Reads the specification of a study from a TOML file. Raises `InputError`; `OSError` if it cannot be read."""
    if not (table := read_toml(path)):
        raise InputError(
            f"{path}: is empty; say at least what differs from the default study, such as `flights = 100`."
        )
    try:
        table = table | _inputs(table, Path(path).parent)
        study = msgspec.convert(table, Study)
        study.check_excitations()
    except (InputError, msgspec.ValidationError, RecursionError) as error:
        in_our_words = isinstance(error, InputError) or isinstance(error.__cause__, InputError)
        what = in_words(error, 300) if in_our_words else f"{shortened(_translated(error), 300)}; correct it."
        raise InputError(f"{path}: {what}") from None
    return study


def _inputs(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The key `input` of a specification with the content of the files. What is no table of paths is left as it is."""
    files, dt = table.get("input"), table.get("dt", 0.01)
    if not isinstance(files, dict) or not isinstance(dt, int | float) or not dt > 0:
        return {}
    for name in files:
        if name in EXCITATIONS:
            raise InputError(f"`input`: {name} is a standard excitation; give the file another name.")
    from ..design import read_input  # needs the simulator, and most studies have no such files

    read = {name: read_input(folder / file, dt).tolist() for name, file in files.items() if isinstance(file, str)}
    return {"input": files | read}


def _translated(error: Exception) -> str:
    """A message of msgspec, with the choices if a key or a value is unknown."""
    message = of_schema(error)
    key = message.partition("`: ")[0].strip("`") if message.startswith("`") else ""
    known = Training if key.startswith("network") else Study
    complaint = message.removeprefix(f"`{key}`: ")
    if complaint.lower().startswith("object contains unknown field "):
        where = f"[{key}]: " if key else ""
        return f"{where}unknown key {complaint.rsplit(' ', 1)[1]}; choose from {', '.join(known.__struct_fields__)}"
    if complaint.startswith("invalid enum value "):
        choices = get_args(get_type_hints(known)[key.removeprefix("network.")])
        return f"`{key}`: unknown {complaint.removeprefix('invalid enum value ')}; choose from {', '.join(choices)}"
    return message
