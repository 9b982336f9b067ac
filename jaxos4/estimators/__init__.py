"""Estimators: from a `ShootingProblem` and a `Bracket` to an `Estimate`. Each algorithm has its own file.

The names are in `__init__.pyi`. Each is imported when it is first used: an estimate needs one estimator, not all.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
