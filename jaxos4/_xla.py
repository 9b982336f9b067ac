"""Options of XLA for a CPU: loops become native functions, and the program of one flight compiles quickly.

By default, XLA calls one compiled function for every few operations of a loop, in each step. A step of a flight is so
short that the calls take ten times as long as the operations. The option that changes this cannot be set for a program,
only for the process, in `XLA_FLAGS`, which JAX reads when it starts to compute. All other options are set for programs.
"""

import functools
import os
import sys
import warnings
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

NO_OPTIONS = "JAXOS4_NO_XLA_OPTIONS"
"""The environment variable that switches off all options of this file."""

_OPTION = "xla_cpu_small_while_loop_byte_threshold"

NATIVE_LOOPS = f"--xla_backend_extra_options={_OPTION}=1000000000"
"""Loops whose step moves less than a gigabyte become native functions. Larger ones keep XLA's threads."""

QUICK = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
"""XLA's older way to write loops, and fewer optimisations: three quarters of the time to compile a program.

The program of one flight also runs faster, by a tenth; that of a batch takes half as long again.
"""

KNOWN_TO = ("0.10.",)
"""The versions of jaxlib that know the options in `QUICK`: an unknown option is an error."""


def make_loops_native() -> None:
    """Adds `NATIVE_LOOPS` to `XLA_FLAGS`, unless the user has set this option, or the name of a file with flags.

    Warns if JAX has computed before: the option is then without effect.
    """
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if os.environ.get(NO_OPTIONS) or _OPTION in flags or (flags and not flags.startswith("--")):
        return
    os.environ["XLA_FLAGS"] = f"{flags} {NATIVE_LOOPS}".strip()
    if _computes_on_cpu():
        warnings.warn(
            "JAX has computed before `import jaxos4`, so that XLA does not make loops native functions: simulations "
            f"take up to ten times as long. Import jaxos4 first. {NO_OPTIONS}=1 silences this.",
            RuntimeWarning,
            stacklevel=3,
        )


def _computes_on_cpu() -> bool:
    """True if JAX has started to compute on a CPU. The check imports nothing and starts nothing."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    started = getattr(bridge, "backends_are_initialized", lambda: False)
    return started() and sys.modules["jax"].default_backend() == "cpu"


def quick_jit(function: Callable[P, R]) -> Callable[P, R]:
    """`equinox.filter_jit` for what is computed once or a few times: a call on a CPU is compiled with `QUICK`.

    Inside another transformation (`jit`, `vmap`, `grad`) this is `filter_jit`: JAX refuses options of an inner program,
    and a batch should be fully optimised.
    """
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    from jax.core import Tracer

    inner = eqx.filter_jit(function)
    outer = eqx.filter_jit(function, compiler_options=QUICK)  # pyright: ignore[reportCallIssue]

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        # Inside `jit`, even a constant is traced.
        leaves = (jnp.asarray(0.0), *jax.tree.leaves((args, kwargs)))
        quickly = (
            not os.environ.get(NO_OPTIONS) and _options_known() and not any(isinstance(leaf, Tracer) for leaf in leaves)
        )
        return (outer if quickly else inner)(*args, **kwargs)

    return call


@functools.cache
def _options_known() -> bool:
    import jax
    import jaxlib.version

    return jaxlib.version.__version__.startswith(KNOWN_TO) and jax.default_backend() == "cpu"
