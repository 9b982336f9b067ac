"""Steps from a recorded flight to one that can be fitted: usable stretches, averages, windows, drafts, inspection."""

from ..logs import Recording as Recording, read_recording as read_recording
from ..logs.values import plausible as plausible
from .checks import (
    Finding as Finding,
    different_vehicles as different_vehicles,
    self_checks as self_checks,
)
from .motion import Excitation as Excitation, excitation as excitation
from .stretches import Stretch as Stretch, cut as cut, stretches as stretches
from .windows import averaged as averaged, join as join
