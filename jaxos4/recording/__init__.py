"""What a recorded flight goes through before it is fitted."""

from .averaging import averaged as averaged
from .excited import Excitation as Excitation, excitation as excitation, gyro_noise as gyro_noise
from .stretches import (
    Stretch as Stretch,
    cut as cut,
    stretches as stretches,
    usable_stretches as usable_stretches,
)
