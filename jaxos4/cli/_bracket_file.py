"""Brackets from a TOML file."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from .._files import read_toml
from ..bracket import Bracket
from ..errors import InputError
from ..models.abstract import AbstractModel


def load_bracket(path: Path, model: AbstractModel) -> Bracket:
    """The brackets that a TOML file gives as `alpha1 = [lower, upper]`, and the model's default for the others."""
    table = read_toml(path)
    names = model.parameter_names
    ends = np.stack([np.asarray(end) for end in (Bracket.default(model).lower, Bracket.default(model).upper)], axis=1)
    for name, value in table.items():
        if name not in names:
            raise InputError(f"{path}: knows no parameter `{name}`; the parameters are {', '.join(names)}.")
        pair = value if isinstance(value, list) else []
        numbers = [float(x) for x in pair if isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e12]
        if len(pair) != 2 or len(numbers) != 2 or not numbers[0] < numbers[1]:
            raise InputError(f"{path}: `{name}` must be [lower, upper] with lower below upper, got {repr(value)[:80]}.")
        ends[names.index(name)] = numbers
    return Bracket(jnp.asarray(ends[:, 0]), jnp.asarray(ends[:, 1]))
