"""The terms of a vehicle's model that the recordings allow."""

from collections.abc import Sequence

from ..errors import InputError
from ..models.terms import TERMS, default_terms


def missing_inputs(terms: Sequence[str], available: frozenset[str]) -> dict[str, frozenset[str]]:
    """For each term that needs more than is available: what is missing."""
    lacks = {term: TERMS[term].needs - available for term in terms}
    return {term: missing for term, missing in lacks.items() if missing}


def chosen_terms(asked: Sequence[str] | None, available: frozenset[str]) -> tuple[str, ...]:
    """The terms that are asked for, or all that the recordings allow.

    **Raises:** `InputError` for an unknown term, or one that the recordings or the airframe do not allow.
    """
    if asked is None:
        return default_terms(available)
    for term in asked:
        if term not in TERMS:
            raise InputError(f"`terms`: knows no `{term[:40]}`; the terms are {', '.join(TERMS)}.")
    missing = missing_inputs(asked, available)
    if missing:
        term, inputs = next(iter(missing.items()))
        if "full scale" in inputs:
            raise InputError(f"`terms`: {term} needs `max_rotor_speed` in the airframe; set it or leave it out.")
        raise InputError(
            f"`terms`: {term} needs {' and '.join(sorted(inputs))}, which these logs did not measure; leave it out."
        )
    return tuple(term for term in TERMS if term in asked)
