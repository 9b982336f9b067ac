"""Iterative Bi-Section Shooting (IBSS): halve brackets on the slope of the trajectory mismatch.

The paper names the method but does not give its steps; the steps here are our choice. Read the files in this order:

- `estimator`: the class `IBSS`, its stages down the cascade of channels, and one sweep.
- `stage`: the data of one stage, and the slope of its cost along a direction (one *shot*).
- `view`: what a sweep sees when it looks around; `directions`: where it can go.
- `brackets`: how wide it searches along each direction.
- `bisection`: how it halves a bracket, and moves along all directions in turn.
- `progress`: what it remembers from sweep to sweep and from stage to stage.
"""

from .estimator import DIRECTIONS as DIRECTIONS, IBSS as IBSS
