"""Steps from a recorded flight to one that can be fitted: usable parts, averages, joined pieces, drafts, inspection."""

from ..logs import Recording as Recording, read_recording as read_recording
from .motion import Excitation as Excitation, excitation as excitation
from .pieces import Stretch as Stretch, averaged as averaged, cut as cut, join as join
from .usable import stretches as stretches
