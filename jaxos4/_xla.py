"""Options of XLA for a CPU: loops become native functions, and the program of one flight compiles quickly.

By default, XLA calls one compiled function for every few operations of a loop, in each step. A step of a flight is so
short that the calls take ten times as long as the operations. XLA also uses half the width of a processor's vectors.
The options that change this are set for the process, in `XLA_FLAGS`, which JAX reads when it starts to compute: the
first cannot be set for a program, and the second concerns programs that users compile. All others are set for programs.
"""

import functools
import os
import sys
import warnings
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from ._programs import kept_program

P = ParamSpec("P")
R = TypeVar("R")

NO_OPTIONS = "JAXOS4_NO_XLA_OPTIONS"
"""The environment variable that switches off all options of this file."""

LOOP_FLAGS = {
    "xla_cpu_small_while_loop_byte_threshold": (
        "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000,-unroll-full-max-count=15"
    ),
    "xla_cpu_prefer_vector_width": "--xla_cpu_prefer_vector_width=512",
}
"""The flags of the process, by the names of their options.

- Loops whose step moves less than a gigabyte become native functions. Larger ones keep XLA's threads.
- Loops over 16 lanes stay loops: LLVM turns a loop into vectors, but not the scalar code that it unrolls it to.
- Vectors are as wide as the processor's. Results are the same.
"""

QUICK = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
"""XLA's older way to write loops, and fewer optimisations: three quarters of the time to compile a program.

The program of one flight also runs faster, by a tenth; that of a batch takes half as long again.
"""

KNOWN_TO = ("0.10.",)
"""The versions of jaxlib that know the options in `QUICK`: an unknown option is an error."""


def make_loops_fast() -> None:
    """Adds `LOOP_FLAGS` to `XLA_FLAGS`: each whose option the user has not set; none to the name of a file with flags.

    Warns if JAX has computed before: the flags are then without effect.
    """
    flags = os.environ.get("XLA_FLAGS", "").strip()
    added = [flag for option, flag in LOOP_FLAGS.items() if option not in flags]
    if os.environ.get(NO_OPTIONS) or not added or (flags and not flags.startswith("--")):
        return
    os.environ["XLA_FLAGS"] = " ".join([flags, *added]).strip()
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
        leaves = jax.tree.leaves((args, kwargs))
        traced = any(isinstance(leaf, Tracer) for leaf in (jnp.asarray(0.0), *leaves))
        if traced or os.environ.get(NO_OPTIONS) or not _options_known():
            return inner(*args, **kwargs)
        return (kept_program(function, QUICK, args, kwargs) or outer)(*args, **kwargs)

    return call


@functools.cache
def _options_known() -> bool:
    import jax
    import jaxlib.version

    return jaxlib.version.__version__.startswith(KNOWN_TO) and jax.default_backend() == "cpu"
