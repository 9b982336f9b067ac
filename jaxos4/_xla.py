"""How XLA compiles loops on a CPU: each as one native function.

By default, XLA calls one compiled function for every few operations of a loop, in each step. A step of a flight is so
short that the calls take ten times as long as the operations. JAX reads `XLA_FLAGS` when it starts to compute.
"""

import os

WHOLE_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"
"""Loops that move less than a gigabyte become native functions. Larger ones keep XLA's threads."""


def compile_loops_whole() -> None:
    """Adds `WHOLE_LOOPS` to `XLA_FLAGS`, unless the user has set `--xla_backend_extra_options`."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "--xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {WHOLE_LOOPS}".strip()
