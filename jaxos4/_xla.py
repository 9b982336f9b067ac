"""How XLA compiles loops on a CPU: as native functions, where it can.

By default, XLA calls one compiled function for every few operations of a loop, in each step. A step of a flight is so
short that the calls take ten times as long as the operations. JAX reads `XLA_FLAGS` when it starts to compute.
"""

import os

_OPTION = "xla_cpu_small_while_loop_byte_threshold"

WHOLE_LOOPS = f"--xla_backend_extra_options={_OPTION}=1000000000"
"""Loops whose step moves less than a gigabyte become native functions. Larger ones keep XLA's threads."""


def compile_loops_whole() -> None:
    """Adds `WHOLE_LOOPS` to `XLA_FLAGS`, unless the user has set this option, or the name of a file with flags."""
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if _OPTION not in flags and (not flags or flags.startswith("--")):
        os.environ["XLA_FLAGS"] = f"{flags} {WHOLE_LOOPS}".strip()
