"""Identification of a quadrotor's dynamics from recorded flights. Public names: `__init__.pyi`, imported when used.

Precision is the caller's choice: `jax.config.update("jax_enable_x64", True)` before anything else, for double.
Import this package before JAX computes: it sets how loops are compiled (`jaxos4._xla`).
"""

import lazy_loader

from ._xla import add_flags

add_flags()
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
