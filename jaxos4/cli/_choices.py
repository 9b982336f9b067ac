"""What the options choose from."""

from enum import StrEnum

from ..dynamics import CHANNELS, MODELS
from ..excitation import EXCITATIONS
from ..simulate import METHODS

Model = StrEnum("Model", list(MODELS))
Excitation = StrEnum("Excitation", list(EXCITATIONS))
Method = StrEnum("Method", list(METHODS))
Channels = StrEnum("Channels", list(CHANNELS))
InitialState = StrEnum("InitialState", ["free", "known"])
Estimator = StrEnum("Estimator", ["ibss"])
