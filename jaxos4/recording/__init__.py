"""Steps from a recorded flight to one that can be fitted: usable parts, averages, joined pieces, drafts, inspection."""

from ..logs import Recording as Recording, read_recording as read_recording
from .checks import (
    Finding as Finding,
    Limits as Limits,
    different_vehicles as different_vehicles,
    plausible as plausible,
    self_checks as self_checks,
)
from .motion import Excitation as Excitation, excitation as excitation
from .pieces import Stretch as Stretch, averaged as averaged, cut as cut, join as join
from .usable import stretches as stretches
