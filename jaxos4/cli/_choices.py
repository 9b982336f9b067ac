"""What the options choose from."""

from enum import StrEnum

from ..dynamics import CHANNELS, MODELS
from ..estimators import APPROXIMATORS, BASELINES
from ..excitation import EXCITATIONS
from ..features import FEATURES
from ..simulate import METHODS

Model = StrEnum("Model", list(MODELS))
Excitation = StrEnum("Excitation", list(EXCITATIONS))
Method = StrEnum("Method", list(METHODS))
Channels = StrEnum("Channels", list(CHANNELS))
InitialState = StrEnum("InitialState", ["free", "known"])
Estimator = StrEnum("Estimator", list(("ibss", "network", "hybrid", *BASELINES)))
Features = StrEnum("Features", list(FEATURES))
Approximator = StrEnum("Approximator", list(APPROXIMATORS))
