"""What a study is: the axes of a grid of simulated flights, and the cells that the grid is cut into.

A cell is `batch` flights of one scenario, identified by one estimator. Flight i has the same parameters and the same
random numbers in every scenario: differences between estimators, and between scales of noise, are differences of
pairs.
"""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_type_hints

import msgspec
import numpy as np

from .._files import read_toml
from ..airframe import PRESETS, Airframe, airframe_from_table
from ..errors import InputError
from ..estimators import ESTIMATORS
from ..excitation import EXCITATIONS
from ..models import MODELS
from ..models.state import CHANNELS
from ..networks.network import NetworkEstimator
from ..noise import NOISES
from ..simulation import METHODS

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Seed = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]

AXES = (
    "models",
    "airframes",
    "excitations",
    "durations",
    "methods",
    "noises",
    "scales",
    "widths",
    "channels",
    "estimators",
)
_CHOICES: dict[str, tuple[str, ...]] = {
    "models": tuple(MODELS),
    "excitations": tuple(EXCITATIONS),
    "methods": tuple(METHODS),
    "noises": tuple(NOISES),
    "channels": tuple(CHANNELS),
    "estimators": tuple(ESTIMATORS),
}
# A study of more is a mistake in its specification: each cell is a file, and all estimates together must fit in memory.
_MOST_CELLS = 1_000_000
_MOST_ESTIMATES = 100_000_000
_MOST_SAMPLES = 1_000_000


class Training(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the networks of a study are trained: see `NetworkEstimator`. Table `network` of the specification.

    - `hybrid_channels`: what the network of the hybrid looks at, at most the channels of the scenario; the network
      alone looks at the rates.
    """

    features: Literal["score", "raw"] = "score"
    approximator: Literal["mlp", "cmac"] = "mlp"
    steps: Count = NetworkEstimator.steps
    held_out: Annotated[int, msgspec.Meta(ge=1000)] = NetworkEstimator.held_out
    hybrid_channels: Literal["rates", "attitude", "all"] = "all"
    seed: Seed = 0


class Scenario(NamedTuple):
    """One point of the grid: what is flown, how it is measured, and who identifies it."""

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
    def needs_network(self) -> bool:
        """Whether its estimator is made from a trained network."""
        return ESTIMATORS[self.estimator].needs_network

    @property
    def seen(self) -> str:
        """The channels that the estimator looks at."""
        return min(self.channels, ESTIMATORS[self.estimator].looks_at, key=CHANNELS.__getitem__)


class Cell(NamedTuple):
    """`batch` flights of a scenario: `first`, and those after it."""

    number: int
    scenario: Scenario
    place: tuple[int, ...]
    first: int


class Study(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The specification of a study: a TOML file with these keys, all optional.

    The axes of the grid are lists; every combination is flown `flights` times.

    - `models`, `excitations`, `channels`, `estimators`: names as on the command line.
    - `airframes`: names of presets, or of tables `[airframe.NAME]` with the keys of an airframe file.
    - `durations` [s], at a sample time of `dt` [s].
    - `methods`: how true flights are simulated; estimators shoot by `fit_method`. The same for both is the inverse
      crime: the model then has no error of discretisation.
    - `noises`, `scales`: kinds of noise, and multiples of the standard sensors'. At scale 0 flights are exact, and
      estimators are told the noise of scale 1.
    - `widths`: brackets, in multiples of the model's default half-width.
    - `truth`: `"airframe"`: all flights have the airframe's parameters, and the bracket is off them by a draw within
      80 % of its half-width; `"drawn"`: each flight has its own, uniform in a bracket around the airframe's.
    - `initial_state`: `"known"`, or `"free"`: estimated too.
    - `flights`, `seed`: how many, and of what random numbers.
    - `batch`: flights of a cell, identified at once by one device: what fits in memory, thousands for a GPU. The last
      digits of results depend on it.
    - `precision`: `"float64"` or `"float32"`.
    - `network`: how networks are trained, a table.
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
    precision: Literal["float64", "float32"] = "float64"
    network: Training = Training()
    airframe: dict[str, dict[str, Any]] = {}

    def __post_init__(self):
        for axis in AXES:
            values = getattr(self, axis)
            if not values:
                raise InputError(f"`{axis}` is empty; give at least one.")
            if len(set(values)) < len(values):
                raise InputError(f"`{axis}` names something twice: {', '.join(map(str, values))}.")
            for value in values if axis in _CHOICES else ():
                if value not in _CHOICES[axis]:
                    raise InputError(f"`{axis}` knows no {value!r}; choose from {', '.join(_CHOICES[axis])}.")
            if any(isinstance(value, float) and not math.isfinite(value) for value in values):
                raise InputError(f"`{axis}` must be finite, got {', '.join(map(str, values))}.")
        if not math.isfinite(self.dt):
            raise InputError(f"`dt` must be finite, got {self.dt}.")
        if not self.title.isprintable():
            raise InputError("`title` must be one line of printable characters.")
        for name, table in self.airframe.items():
            if not (name.isprintable() and name.strip()):
                raise InputError(f"[airframe.{_short(name)}]: its name must be printable characters.")
            if name not in self.airframes:
                raise InputError(f"[airframe.{name}] is flown by nobody: name it in `airframes`.")
            if not all(math.isfinite(value) for value in table.values() if isinstance(value, float)):
                raise InputError(f"[airframe.{name}]: not finite; leave `max_rotor_speed` out where it is not known.")
        for name in self.airframes:
            self.vehicle(name)
        for duration in self.durations:
            if not 2 <= duration / self.dt <= _MOST_SAMPLES:
                raise InputError(
                    f"`durations`: {duration:g} s at `dt` {self.dt:g} s is not 2 to {_MOST_SAMPLES} samples."
                )
        if self.count > _MOST_CELLS:
            raise InputError(f"{self.count} cells, more than {_MOST_CELLS}; shorten an axis, or enlarge `batch`.")
        estimates = math.prod(self.shape) * self.flights
        if estimates > _MOST_ESTIMATES:
            raise InputError(
                f"{estimates} estimates, more than {_MOST_ESTIMATES}; take fewer `flights`, or cut an axis."
            )

    def check_computable(self) -> None:
        """Raises `InputError` for inputs that an airframe cannot fly, or networks that cannot be trained."""
        for name, excitation, duration in itertools.product(self.airframes, self.excitations, self.durations):
            try:
                EXCITATIONS[excitation](self.vehicle(name), duration=duration, dt=self.dt)
            except ValueError as error:
                raise InputError(f"`excitations`: {excitation} of {duration:g} s by {name}: {error}") from None
        settings = self.network
        try:
            NetworkEstimator(
                features=settings.features,
                approximator=settings.approximator,
                steps=settings.steps,
                held_out=settings.held_out,
            )
        except ValueError as error:
            raise InputError(f"`network`: {error}") from None

    def vehicle(self, name: str) -> Airframe:
        """The airframe of that name. Raises `InputError` where there is none, or its table is not usable."""
        if name in self.airframe:
            try:
                return airframe_from_table(self.airframe[name])
            except InputError as error:
                raise InputError(f"[airframe.{name}]: {error}") from None
        if name not in PRESETS:
            raise InputError(
                f"`airframes` knows no {name!r}; choose from {', '.join(PRESETS)}, or add [airframe.{name}]."
            )
        return PRESETS[name]

    @property
    def shape(self) -> tuple[int, ...]:
        """The lengths of `AXES`."""
        return tuple(len(getattr(self, axis)) for axis in AXES)

    @property
    def blocks(self) -> int:
        """Cells of a scenario."""
        return -(-self.flights // self.batch)

    @property
    def count(self) -> int:
        """Cells of the study."""
        return math.prod(self.shape) * self.blocks

    def cell(self, index: int) -> Cell:
        """The cell of that index, from 0 to `count` - 1. Cells of a scenario, and of an estimator, are neighbours."""
        # Along the estimators first: what was compiled, or trained, for one serves all its cells.
        estimator, *others, block = np.unravel_index(index, (self.shape[-1], *self.shape[:-1], self.blocks))
        place = tuple(int(i) for i in (*others, estimator))
        values = [getattr(self, axis)[i] for axis, i in zip(AXES, place, strict=True)]
        return Cell(index, Scenario(*values), place, int(block) * self.batch)

    def cells(self) -> Iterator[Cell]:
        """All of them."""
        return (self.cell(index) for index in range(self.count))


def load_study(path: Path) -> Study:
    """The study that a TOML file specifies.

    **Raises:** `InputError` with one line: which key, what is wrong, what to do; `OSError` where it cannot be read.
    """
    table = read_toml(path)
    try:
        study = msgspec.convert(table, Study)
        study.check_computable()
    except (InputError, msgspec.ValidationError, RecursionError) as error:
        ours = isinstance(error, InputError) or isinstance(error.__cause__, InputError)
        what = " ".join(str(error).split())[:300]
        raise InputError(f"{path}: {what}" if ours else f"{path}: {_in_words(what)}; correct it there.") from None
    return study


# What msgspec calls a kind of value, and what TOML does.
_WORDS = {
    "object": "a table",
    "array": "a list",
    "int": "a whole number",
    "float": "a number",
    "str": "a string",
    "bool": "true or false",
}


def _in_words(message: str) -> str:
    """A complaint of msgspec's with the words of TOML, the key first, and the keys or values that there are."""
    complaint, _, place = message.partition(" - at `$")
    key = place.strip(".`")
    for kind, word in _WORDS.items():
        complaint = complaint.replace(f"`{kind}`", word)
    known = Training if key.startswith("network") else Study
    if complaint.startswith("Object contains unknown field "):
        where = f"[{key}]: " if key else ""
        return f"{where}knows no key {complaint.rsplit(' ', 1)[1]}; there are {', '.join(known.__struct_fields__)}"
    if complaint.startswith("Invalid enum value "):
        choices = get_args(get_type_hints(known)[key.removeprefix("network.")])
        return f"`{key}` knows no {complaint.removeprefix('Invalid enum value ')}; choose from {', '.join(choices)}"
    if not key:
        return complaint
    return f"`{key}`: {complaint[:1].lower()}{complaint[1:]}"


def differences(ours: Study, theirs: Study) -> list[str]:
    """What two specifications differ in, a phrase each."""
    a, b = msgspec.to_builtins(ours), msgspec.to_builtins(theirs)
    return [f"`{key}` was {_short(b.get(key))}, now {_short(a.get(key))}" for key in a if a.get(key) != b.get(key)]


def _short(value: Any) -> str:
    text = msgspec.json.encode(value).decode()
    return text if len(text) <= 60 else f"{text[:57]}..."
