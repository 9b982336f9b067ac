"""XLA on a CPU: loops become native functions with full vectors; programs that run once are hardly optimised.

By default, XLA calls a function for every few operations of a loop, which takes ten times as long. JAX reads
`XLA_FLAGS` when it starts to compute. An unknown flag ends the process, so `pyproject.toml` allows only versions of JAX
that know all of these.
"""

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])


def add_flags(*, quick: bool = False, brief: bool = False) -> None:
    """Adds flags to `XLA_FLAGS`, each unless the user has set its option. No result changes, except by `brief`.

    - Loops whose step moves less than a gigabyte become native functions. Loops over 16 lanes stay loops, which LLVM
      turns into vectors, as wide as the processor's.
    - `quick`: XLA's older way to write loops, for a command that computes a single flight: it compiles in two thirds of
      the time, and runs a batch half as long again.
    - `brief`: less optimisation, for a command that compiles many programs and computes with none of them for long. The
      last digits of results change.

    Nothing is added if `JAXOS4_NO_XLA_OPTIONS` is set, or if `XLA_FLAGS` names a file. Flags have no effect if JAX has
    computed before.
    """
    options = {
        "xla_cpu_small_while_loop_byte_threshold": (
            "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000,-unroll-full-max-count=15"
        ),
        "xla_cpu_prefer_vector_width": "--xla_cpu_prefer_vector_width=512",
    }
    if quick:
        options["xla_cpu_use_fusion_emitters"] = "--xla_cpu_use_fusion_emitters=false"
    if brief:
        options["xla_backend_optimization_level"] = "--xla_backend_optimization_level=1"
    flags = os.environ.get("XLA_FLAGS", "").strip()
    added = [flag for option, flag in options.items() if option not in flags]
    if added and not os.environ.get("JAXOS4_NO_XLA_OPTIONS") and (not flags or flags.startswith("--")):
        os.environ["XLA_FLAGS"] = " ".join([flags, *added]).strip()


def compiled_cheaply(function: Function) -> Function:
    """`equinox.filter_jit` without optimisation, for what one flight needs once: it compiles for longer than it runs.

    Such a function cannot be called inside of another that is compiled.
    """
    return _compiled(function, optimisation=0)


def quick_jit(function: Function) -> Function:
    """`equinox.filter_jit` with less optimisation, for what runs for some seconds: it compiles in half of the time.

    Loops over lanes run as fast as by default. With no optimisation, a design takes 2.5 to 4 times as long.
    """
    return _compiled(function, optimisation=1)


def _compiled(function: Function, optimisation: int) -> Function:
    import equinox as eqx  # not before it is needed: `import jaxos4` is quick

    options: dict[str, Any] = {"compiler_options": {"xla_backend_optimization_level": optimisation}}
    return cast(Function, eqx.filter_jit(function, **options))
