"""Estimators: from a `ShootingProblem` and a `Bracket` to an `Estimate`. `__init__.pyi` names them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
