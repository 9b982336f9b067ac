"""Networks that identify a flight: features, architecture, training, calibration, file."""

from .architecture import ARCHITECTURES as ARCHITECTURES
from .estimator import NetworkEstimator as NetworkEstimator, TrainedNetwork as TrainedNetwork
from .features import FEATURES as FEATURES
from .file import encode_network as encode_network, load_network as load_network, save_network as save_network
