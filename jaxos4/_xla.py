"""Flags of XLA for a CPU: loops become native functions, and vectors are whole.

By default, XLA calls a function for every few operations of a loop, which takes ten times as long. JAX reads
`XLA_FLAGS` when it starts to compute. An unknown flag ends the process, so `pyproject.toml` allows only versions of JAX
that know all of these.
"""

import os


def add_flags(*, quick: bool = False) -> None:
    """Adds flags to `XLA_FLAGS`, each unless the user has set its option. No result changes.

    - Loops whose step moves less than a gigabyte become native functions. Loops over 16 lanes stay loops, which LLVM
      turns into vectors, as wide as the processor's.
    - `quick`: XLA's older way to write loops, for a command that computes a single flight: it compiles in two thirds of
      the time, and runs a batch half as long again.

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
    flags = os.environ.get("XLA_FLAGS", "").strip()
    added = [flag for option, flag in options.items() if option not in flags]
    if added and not os.environ.get("JAXOS4_NO_XLA_OPTIONS") and (not flags or flags.startswith("--")):
        os.environ["XLA_FLAGS"] = " ".join([flags, *added]).strip()
