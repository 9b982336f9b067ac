"""Networks that identify a flight: features, architecture, training, calibration, file."""

from .estimator import APPROXIMATORS as APPROXIMATORS, NetworkEstimator as NetworkEstimator
from .features import FEATURES as FEATURES
from .file import load_network as load_network, save_network as save_network
from .trained import TrainedNetwork as TrainedNetwork
from .training import CHECK as CHECK
