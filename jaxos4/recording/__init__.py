"""Steps from a recorded flight to one that can be fitted: usable parts, averages, joined pieces, drafts, inspection."""

from .motion import Excitation as Excitation, excitation as excitation
from .pieces import averaged as averaged, cut as cut, join as join
from .reading import Recording as Recording, read_recording as read_recording, vehicle_evidence as vehicle_evidence
from .usable import Stretch as Stretch, stretches as stretches
