"""Identification of a quadrotor's dynamics from recorded flights.

Precision is the caller's choice: `jax.config.update("jax_enable_x64", True)` before anything else, for double.
"""

from importlib.metadata import version as _version

from .airframe import (
    OS4 as OS4,
)
from .airframe import (
    OS4_SIMULATOR as OS4_SIMULATOR,
)
from .airframe import (
    VOOS as VOOS,
)
from .airframe import (
    Airframe as Airframe,
)
from .airframe import (
    alpha_from_inertia as alpha_from_inertia,
)
from .airframe import (
    inertia_from_alpha as inertia_from_alpha,
)
from .airframe import (
    load_airframe as load_airframe,
)
from .airframe import (
    plus_layout as plus_layout,
)
from .bracket import Bracket as Bracket
from .dynamics import (
    DEFAULT_HALF_WIDTH as DEFAULT_HALF_WIDTH,
)
from .dynamics import (
    AbstractModel as AbstractModel,
)
from .dynamics import (
    CorrectedOS4 as CorrectedOS4,
)
from .dynamics import (
    PublishedOS4 as PublishedOS4,
)
from .errors import InputError as InputError
from .estimators import (
    IBSS as IBSS,
)
from .estimators import (
    AbstractEstimator as AbstractEstimator,
)
from .estimators import (
    Estimate as Estimate,
)
from .excitation import (
    chirp as chirp,
)
from .excitation import (
    doublet as doublet,
)
from .excitation import (
    multisine as multisine,
)
from .excitation import (
    step3211 as step3211,
)
from .flight import STATE_NAMES as STATE_NAMES
from .flight import STATE_UNITS as STATE_UNITS
from .flight import Flight as Flight
from .information import cramer_rao_bound as cramer_rao_bound
from .information import fisher_information as fisher_information
from .logs import read_flight as read_flight
from .logs import write_flight as write_flight
from .noise import (
    SENSOR_SIGMA as SENSOR_SIGMA,
)
from .noise import (
    AbstractNoise as AbstractNoise,
)
from .noise import (
    Chain as Chain,
)
from .noise import (
    ConstantBias as ConstantBias,
)
from .noise import (
    Dropouts as Dropouts,
)
from .noise import (
    GaussMarkov as GaussMarkov,
)
from .noise import (
    Quantisation as Quantisation,
)
from .noise import (
    WhiteNoise as WhiteNoise,
)
from .results import RESULTS as RESULTS
from .results import result_names as result_names
from .shooting import ShootingProblem as ShootingProblem
from .simulate import simulate as simulate

__version__ = _version("jaxos4")
