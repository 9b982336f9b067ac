"""Results compared quantity by quantity: whether repeated flights agree, and the value that all of them give."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .errors import InputError, printable
from .identification.physical import PhysicalQuantity, physical_quantities
from .identification.results import Identification
from .result_file import read_result
from .results import NINETY_FIVE

Source = Identification | str | os.PathLike[str]


class ComparedQuantity(NamedTuple):
    """One quantity in all results.

    - `answers`: the answer of each result, or `None`. `used`: whether it counts: it has a standard deviation, and no
      verdict refuses it.
    - `value`, `std`: the mean of these, weighted by 1 / std^2; NaN without any. If they scatter more than their
      intervals say, `std` is widened by the square root of `chi2` over its degrees of freedom.
    - `chi2`, `p`: the weighted sum of squares about the mean, and the probability of this or more if all results have
      the same true value. NaN if fewer than two count.
    """

    name: str
    unit: str
    answers: tuple[PhysicalQuantity | None, ...]
    used: tuple[bool, ...]
    value: float
    std: float
    chi2: float
    p: float

    @property
    def ci95(self) -> tuple[float, float]:
        """The 95 % interval of `value`."""
        return self.value - NINETY_FIVE * self.std, self.value + NINETY_FIVE * self.std


class Comparison(NamedTuple):
    """Results compared; made by `jaxos4.compare_results`.

    - `names`: of the results. `quantities`: each that a result has.
    - `notes`: what makes the results hard to compare.
    - `level`: the probability that any quantity is reported as different although all agree.
    """

    names: tuple[str, ...]
    quantities: tuple[ComparedQuantity, ...]
    notes: tuple[str, ...]
    level: float

    @property
    def tested(self) -> tuple[ComparedQuantity, ...]:
        """The quantities that two results or more have."""
        return tuple(each for each in self.quantities if np.isfinite(each.p))

    @property
    def different(self) -> tuple[ComparedQuantity, ...]:
        """The quantities in which the results differ by more than chance (Bonferroni's rule)."""
        return tuple(each for each in self.tested if each.p * len(self.tested) < self.level)


def compare_results(results: Sequence[Source], *, level: float = 0.05) -> Comparison:
    """Compare results of repeated flights quantity by quantity.

        jaxos4.compare_results(["monday.json", "tuesday.json"]).different

    The test is chi-squared, of the equality of independent estimates with known standard deviations. Mass and arms are
    the same in all results, so that agreement says nothing about them.

    - `results`: two or more, of `jaxos4.identify`, or files of `jaxos4 estimate --out`; all of one kind of model.
    - `level`: see `Comparison`.

    **Raises:** `InputError` for other results; `OSError` if a file cannot be read.
    """
    if len(results) < 2:
        raise InputError(f"a comparison needs two results or more, got {len(results)}.")
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
    quantities = tuple(_compared(name, [table.get(name) for table in tables]) for name in listed)
    return Comparison(names, quantities, tuple(_notes(names, every)), level)


def _compared(name: str, answers: list[PhysicalQuantity | None]) -> ComparedQuantity:
    from scipy.special import chdtrc  # slow to import

    used = tuple(each is not None and each.trusted and each.std > 0 for each in answers)
    rows = [each for each, counts in zip(answers, used, strict=True) if each is not None and counts]
    unit = next(each.unit for each in answers if each is not None)
    if not rows:
        return ComparedQuantity(name, unit, tuple(answers), used, *4 * [np.nan])
    values, std = np.array([each.value for each in rows]), np.array([each.std for each in rows])
    with np.errstate(all="ignore"):  # numbers that no vehicle has may overflow
        weight = np.square(std.min() / std)
        mean = float(weight @ values / weight.sum())
        chi2, free = float(np.square((values - mean) / std).sum()), len(rows) - 1
        error = float(std.min() / np.sqrt(weight.sum()) * np.sqrt(max(chi2 / max(free, 1), 1.0)))
    tests = (chi2, float(chdtrc(free, chi2))) if free else (np.nan, np.nan)
    return ComparedQuantity(name, unit, tuple(answers), used, mean, error, *tests)


def _notes(names: Sequence[str], every: Sequence[Identification], *, same: float = 1e-3) -> list[str]:
    """Reasons why results are hard to compare. `same`: constants of airframes that differ by less are equal."""
    notes, first = [], every[0].airframe
    for constant, why in (("mass", "are proportional to it"), ("rotor_positions", "depend on them")):
        values = [np.asarray(getattr(each.airframe, constant), dtype=float) for each in every]
        far = [x for x in values if not np.allclose(x, np.asarray(getattr(first, constant)), rtol=same, atol=0)]
        if far:
            notes.append(
                f"the airframes differ in `{constant}`: moments of inertia {why}; estimate again with one airframe"
            )
    logs = [name for each in every for name in each.logs]
    if twice := sorted({name for name in logs if logs.count(name) > 1}):
        notes.append(f"{twice[0]} was fitted in several results, which are not independent")
    refused = [name for name, each in zip(names, every, strict=True) if not each.successful]
    if refused:
        notes.append(
            f"not to be trusted as a whole, so that only quantities with a good verdict count: {', '.join(refused)}"
        )
    return notes
