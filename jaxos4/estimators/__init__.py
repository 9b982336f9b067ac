"""Estimators: from a likelihood, with the bracket of its unknowns, to an `Estimate`. Each algorithm has its own file.

`__init__.pyi` names them. An estimator is imported when it is first used. Its base class is `AbstractEstimator` in
`jaxos4.estimate`, or `AbstractSolver` in `solver.py` for a search in stages.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
