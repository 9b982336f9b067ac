"""Results compared quantity by quantity: whether repeated flights agree, and the value that all of them give."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .airframe import INERTIAS
from .errors import InputError, printable
from .identification.answers import UNIT
from .identification.next_flight import next_flight, pooled_statuses
from .identification.results import Identification
from .identification.tables import PhysicalQuantity, physical_quantities
from .identification.verdict import IDENTIFIED, RESERVED, STATUSES, pooled_status
from .result_file import ResultSource, read_result
from .results import NINETY_FIVE

_EQUAL = 1e-3  # relative; constants of airframes that differ by less are equal


class ComparedQuantity(NamedTuple):
    """One quantity in all results.

    - `answers`: the answer of each result, or `None`. `used`: whether it counts: it has a standard deviation, and no
      verdict refuses it.
    - `value`, `std`: the mean of these, weighted by 1 / std^2; NaN without any. If they scatter more than their
      intervals say, `std` is widened by the square root of `chi2` over its degrees of freedom.
    - `chi2`, `p`: the weighted sum of squares about the mean, and the probability of this or more if all results have
      the same true value. NaN if fewer than two count.
    - `status`: the status of the mean: the worst of the results that count, or of all if none counts.
    - `reference`: the value in the airframe's file, of a moment of inertia; NaN if the results have several.
    """

    name: str
    unit: str
    answers: tuple[PhysicalQuantity | None, ...]
    used: tuple[bool, ...]
    value: float
    std: float
    chi2: float
    p: float
    status: str
    reference: float

    @property
    def ci95(self) -> tuple[float, float]:
        """The 95 % interval of `value`."""
        return self.value - NINETY_FIVE * self.std, self.value + NINETY_FIVE * self.std


class Comparison(NamedTuple):
    """Results compared; made by `jaxos4.compare_results`.

    - `names`: the results. `flights`: the logs of each result. `quantities`: all that a result has.
    - `notes`: why the results are hard to compare.
    - `level`: the probability that any quantity is reported as different although all agree.
    - `statuses`: by quantity with a verdict: the status, no better than in any result that counts.
    - `reasons`: why quantities are not simply identified, each with their names and the numbers of the results.
    - `next_flight`: what to fly next, in one line.
    """

    names: tuple[str, ...]
    flights: tuple[str, ...]
    quantities: tuple[ComparedQuantity, ...]
    notes: tuple[str, ...]
    level: float
    statuses: Mapping[str, str]
    reasons: tuple[str, ...]
    next_flight: str

    @property
    def tested(self) -> tuple[ComparedQuantity, ...]:
        """The quantities that two results or more have."""
        return tuple(each for each in self.quantities if np.isfinite(each.p))

    @property
    def different(self) -> tuple[ComparedQuantity, ...]:
        """The quantities in which the results differ by more than chance (Bonferroni's rule)."""
        return tuple(each for each in self.tested if each.p * len(self.tested) < self.level)


def compare_results(results: Sequence[ResultSource], *, level: float = 0.05) -> Comparison:
    """Compare results of repeated flights quantity by quantity.

        jaxos4.compare_results(["monday.json", "tuesday.json"]).different

    The test is chi-squared, of the equality of independent estimates with known standard deviations. Mass and arms are
    the same in all results, so that agreement says nothing about them.

    - `results`: two or more, of `jaxos4.identify`, or files of `jaxos4 estimate --out`; all of one kind of model.
    - `level`: see `Comparison`.

    **Raises:** `InputError` for other results; `OSError` if a file cannot be read.
    """
    if len(results) < 2:
        raise InputError(f"a comparison needs two results or more, got {len(results)}; give one of each flight.")
    files = [os.path.realpath(each) for each in results if not isinstance(each, Identification)]
    if twice := sorted({path for path in files if files.count(path) > 1}):
        raise InputError(f"{printable(Path(twice[0]).name)}: given twice; give one result of each flight.")
    every = [each if isinstance(each, Identification) else read_result(each) for each in results]
    # Of files, without their folders if these differ; without a file, those of the logs.
    paths = ["" if isinstance(each, Identification) else os.fspath(each) for each in results]
    short = [Path(path).name for path in paths]
    named = zip(short if len({*short}) == len({*paths}) else paths, every, strict=True)
    names = tuple(printable(name) or ", ".join(each.logs) for name, each in named)
    for name, each in zip(names, every, strict=True):
        if each.model != every[0].model:
            raise InputError(
                f"{name}: is of the {each.model} model, and {names[0]} of the {every[0].model} model; compare results "
                "of one model."
            )
    tables = [{row.name: row for row in physical_quantities(each)} for each in every]
    listed = dict.fromkeys(name for table in sorted(tables, key=len, reverse=True) for name in table)
    statuses = pooled_statuses(every)
    unseen = [name for name in INERTIAS if name in statuses and name not in listed]
    quantities = tuple(
        _compared(name, [table.get(name) for table in tables], statuses.get(name), _reference(name, every))
        for name in sorted({**listed, **dict.fromkeys(unseen)}, key=lambda name: name not in INERTIAS)
    )
    flights = tuple(", ".join(printable(Path(log).name) for log in each.logs) for each in every)
    found = Comparison(names, flights, quantities, tuple(_notes(names, every)), level, {}, tuple(_reasons(every)), "")
    advice = next_flight(every, _spreads(quantities))
    if different := found.different:
        judged = {row.judged for each in different for row in each.answers if row is not None}
        statuses |= {name: max(statuses[name], RESERVED, key=STATUSES.index) for name in judged & statuses.keys()}
        which = ", ".join(each.name for each in different)
        advice = f"first find out why the results differ in {which}; {advice}"
    return found._replace(statuses=statuses, next_flight=advice)


def _reference(name: str, every: Sequence[Identification]) -> float:
    """The moment of inertia in the airframe's file; NaN if the results have several."""
    if name not in INERTIAS:
        return np.nan
    values = [float(np.asarray(each.airframe.inertia)[INERTIAS.index(name)]) for each in every]
    return values[0] if np.allclose(values, values[0], rtol=_EQUAL, atol=0) else np.nan


def _spreads(quantities: Sequence[ComparedQuantity]) -> dict[str, float]:
    """Half of the 95 % interval of each pooled moment of inertia, as a share of it; of all results if none counts."""
    found = {}
    for each in quantities:
        rows = [row for row in each.answers if row is not None and row.std > 0]
        if each.name not in INERTIAS or not rows:
            continue
        with np.errstate(all="ignore"):  # numbers that no vehicle has may overflow
            weight = np.array([row.std for row in rows]) ** -2.0
            all_together = weight.sum() ** -0.5, weight @ [row.value for row in rows] / weight.sum()
            std, value = (each.std, each.value) if np.isfinite(each.value) else all_together
            found[each.name] = float(NINETY_FIVE * std / np.abs(value))
    return found


def _reasons(every: Sequence[Identification]) -> list[str]:
    """Why quantities are not simply identified, with the numbers of the results."""
    places: dict[tuple[str, str], list[int]] = {}
    for place, found in enumerate(every, start=1):
        for name, verdict in found.verdicts.items():
            for reason in verdict.reasons:
                places.setdefault((name, reason), []).append(place)
    quantities: dict[tuple[str, str], list[str]] = {}
    for (name, reason), numbers in places.items():
        quantities.setdefault((", ".join(map(str, numbers)), reason), []).append(name)
    order = list(pooled_statuses(every))
    rows = sorted(quantities.items(), key=lambda row: order.index(row[1][0]))
    return [
        f"{', '.join(names)} in result{'s' * (',' in numbers)} {numbers}: {reason}" for (numbers, reason), names in rows
    ]


def _compared(
    name: str, answers: list[PhysicalQuantity | None], unseen: str | None, reference: float
) -> ComparedQuantity:
    """The mean of the answers that count. `unseen`: the status of a quantity without an answer."""
    from scipy.special import chdtrc  # slow to import

    used = tuple(each is not None and each.trusted and each.std > 0 for each in answers)
    rows = [each for each, counts in zip(answers, used, strict=True) if each is not None and counts]
    judged = [IDENTIFIED if each.verdict is None else each.verdict.status for each in answers if each is not None]
    status, nan = pooled_status(judged or [unseen or IDENTIFIED]), np.nan
    unit = next((each.unit for each in answers if each is not None), UNIT)
    found = ComparedQuantity(name, unit, tuple(answers), used, nan, nan, nan, nan, status, reference)
    if not rows:
        return found
    values, std = np.array([each.value for each in rows]), np.array([each.std for each in rows])
    with np.errstate(all="ignore"):  # numbers that no vehicle has may overflow
        weight = np.square(std.min() / std)
        mean = float(weight @ values / weight.sum())
        chi2, free = float(np.square((values - mean) / std).sum()), len(rows) - 1
        error = float(std.min() / np.sqrt(weight.sum()) * np.sqrt(max(chi2 / max(free, 1), 1.0)))
    found = found._replace(value=mean, std=error)
    return found._replace(chi2=chi2, p=float(chdtrc(free, chi2))) if free else found


def _notes(names: Sequence[str], every: Sequence[Identification]) -> list[str]:
    """Reasons why results are hard to compare."""
    notes, first = [], every[0].airframe
    for constant, why in (("mass", "are proportional to it"), ("rotor_positions", "depend on them")):
        values = [np.asarray(getattr(each.airframe, constant), dtype=float) for each in every]
        if not all(np.allclose(x, np.asarray(getattr(first, constant)), rtol=_EQUAL, atol=0) for x in values):
            notes.append(
                f"the airframes differ in `{constant}`: moments of inertia {why}; estimate again with one airframe"
            )
    logs = [name for each in every for name in each.logs]
    if twice := sorted({name for name in logs if logs.count(name) > 1}):
        notes.append(f"{twice[0]} was fitted in several results, which are not independent")
    if refused := [name for name, each in zip(names, every, strict=True) if not each.successful]:
        notes.append(
            f"not to be trusted as a whole, so that only quantities with a good verdict count: {', '.join(refused)}"
        )
    return notes
