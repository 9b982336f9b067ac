"""Iterative Bi-Section Shooting (IBSS): halve brackets on the slope of the trajectory mismatch.

The paper names the method but does not give its steps; the steps here are our choice. Read the files in this order:

- `estimator`: the class `IBSS`, its stages down the cascade of channels, and what one shot does.
- `stage`: the data of one stage, and the curvature of its cost.
- `directions`: along which a sweep searches; `view`: from where.
- `brackets`: how wide it searches along each direction.
- `bisection`: how the slopes narrow the brackets.
- `progress`: what it remembers from shot to shot and from stage to stage.
"""

from .estimator import DIRECTIONS as DIRECTIONS, IBSS as IBSS
