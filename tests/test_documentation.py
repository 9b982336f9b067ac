"""The documentation agrees with the code, and the type checker of the tests sees every call."""

import importlib.util
import pathlib
import re

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float, TypeCheckError, jaxtyped
from typechecker import check

import jaxos4

ROOT = pathlib.Path(__file__).resolve().parents[1]


def test_every_public_name_is_in_the_api_reference():
    pages = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.md"))
    documented = set(re.findall(r"^::: jaxos4\.(\w+)$", pages, flags=re.MULTILINE))
    public = {name for name in dir(jaxos4) if name[0] != "_" and not isinstance(getattr(jaxos4, name), type(jaxos4))}
    assert public - documented == set()


def test_the_picture_of_the_floors_is_up_to_date():
    script = ROOT / "experiments" / "pictures" / "run.py"
    spec = importlib.util.spec_from_file_location("experiment_pictures_run", script)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    drawn = (ROOT / "docs" / "pictures" / "floors.svg").read_text(encoding="utf-8")
    # If this fails: python experiments/pictures/run.py docs/pictures --only floors
    assert drawn == module.floors_picture(ROOT / "pyproject.toml")


def test_inner_functions_are_checked_at_each_call():
    def differences(values, annotation):
        @jaxtyped(typechecker=check)
        def inner(x: annotation, y: Float[Array, " n"]) -> Float[Array, " n"]:
            return x - y

        return inner(values, jnp.zeros(3))

    vector, anything = Float[Array, " n"], Float[Array, "..."]
    for _ in range(2):
        assert differences(jnp.ones(3), vector).shape == (3,)
        for values, annotation, said in (
            (jnp.ones(4), vector, "parameters"),
            (np.ones(3), vector, "parameters"),
            (jnp.ones((2, 3)), anything, "return value"),
        ):
            with pytest.raises(TypeCheckError, match=said):
                differences(values, annotation)
