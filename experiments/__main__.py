"""Runs a script of an experiment in double precision: `python -m experiments closed_loop.effects --help`."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import typer


def scripts() -> Iterator[str]:
    """The names of all scripts: the modules with a `main`."""
    for path in sorted(Path(__file__).parent.glob("*/*.py")):
        text = path.read_text(encoding="utf-8")
        if "\ndef main(" in text or "\nmain = " in text:
            yield f"{path.parent.name}.{path.stem}"


if __name__ == "__main__":
    name = sys.argv.pop(1) if len(sys.argv) > 1 else "none"
    if name not in scripts():
        raise SystemExit(f"{name}: no such script; give one of {', '.join(scripts())}.")
    jax.config.update("jax_enable_x64", True)
    typer.run(importlib.import_module(f"experiments.{name}").main)
