"""The studies that compare the estimators: the whole one, and a short one."""

from ..estimators import ESTIMATORS
from .specification import Study, Training

# The training is shorter than the best one. The network loses accuracy, the hybrid does not: its search starts from a
# network of the rates, and a short training is enough for that.
STANDARD = Study(
    title="IBSS, network, hybrid and baselines under sensor noise",
    # The ant colony alone takes longer than all the others: `experiments/comparison` has it.
    estimators=tuple(name for name in ESTIMATORS if name != "ant-colony"),
    flights=256,
    network=Training(steps=2000, held_out=5000, hybrid_channels="rates"),
)
QUICK = Study(
    title="IBSS, network, hybrid and a Kalman filter under sensor noise, body rates alone, in short",
    channels=("rates",),
    estimators=("ibss", "network", "hybrid", "kalman"),  # kalman: the baseline that compiles fastest
    flights=128,
    network=Training(steps=500, held_out=1000),
)
