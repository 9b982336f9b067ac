"""The public names. Each is imported when it is first used, see `__init__.py`."""

from . import (
    airframe as airframe,
    analysis as analysis,
    bracket as bracket,
    closed_loop as closed_loop,
    comparison as comparison,
    design as design,
    errors as errors,
    estimate as estimate,
    estimators as estimators,
    excitation as excitation,
    export as export,
    flight as flight,
    forecast as forecast,
    identification as identification,
    linalg as linalg,
    logs as logs,
    models as models,
    networks as networks,
    noise as noise,
    recording as recording,
    report as report,
    results as results,
    rotations as rotations,
    shooting as shooting,
    simulation as simulation,
    study as study,
)
from ._version import __version__ as __version__
from .airframe import (
    OS4 as OS4,
    OS4_SIMULATOR as OS4_SIMULATOR,
    VOOS as VOOS,
    Airframe as Airframe,
    alpha_from_inertia as alpha_from_inertia,
    load_airframe as load_airframe,
    plus_layout as plus_layout,
)
from .analysis.diagnostics import Diagnostics as Diagnostics, residual_diagnostics as residual_diagnostics
from .analysis.evaluation import (
    Evaluation as Evaluation,
    Identifiability as Identifiability,
    cramer_rao_bound as cramer_rao_bound,
    evaluate as evaluate,
    identifiability as identifiability,
    robust_covariance as robust_covariance,
)
from .analysis.frequency_response import (
    Agreement as Agreement,
    AxisResponse as AxisResponse,
    FrequencyResponse as FrequencyResponse,
    frequency_response as frequency_response,
)
from .analysis.inertia import (
    CenterOfMass as CenterOfMass,
    InertiaFit as InertiaFit,
    center_of_mass as center_of_mass,
    fit_inertia as fit_inertia,
)
from .analysis.prediction import Predictions as Predictions, Skill as Skill, predictions as predictions, skill as skill
from .batching import on_all_cores as on_all_cores
from .bracket import Bracket as Bracket
from .closed_loop import (
    Air as Air,
    ClosedLoop as ClosedLoop,
    Sensors as Sensors,
    fly_closed_loop as fly_closed_loop,
)
from .comparison import Comparison as Comparison, compare_results as compare_results
from .design import (
    Design as Design,
    Designed as Designed,
    Envelope as Envelope,
    design_input as design_input,
    design_references as design_references,
)
from .errors import InputError as InputError, TrainingError as TrainingError
from .estimate import AbstractEstimator as AbstractEstimator, Estimate as Estimate
from .estimators import (
    IBSS as IBSS,
    SVSF as SVSF,
    AntColony as AntColony,
    EquationError as EquationError,
    FilterError as FilterError,
    Hybrid as Hybrid,
    JointEKF as JointEKF,
    OutputError as OutputError,
    RecursiveLeastSquares as RecursiveLeastSquares,
)
from .excitation import (
    chirp as chirp,
    doublet as doublet,
    multisine as multisine,
    random_references as random_references,
    step3211 as step3211,
)
from .flight import STATE_NAMES as STATE_NAMES, STATE_UNITS as STATE_UNITS, Flight as Flight
from .forecast import FlightPrediction as FlightPrediction, predict as predict
from .identification import (
    FlightInformation as FlightInformation,
    Identification as Identification,
    OS4Identification as OS4Identification,
    OS4Settings as OS4Settings,
    VehicleIdentification as VehicleIdentification,
    VehicleSettings as VehicleSettings,
    assess as assess,
    identify as identify,
)
from .logs import read_flight as read_flight, read_log as read_log, write_flight as write_flight
from .models.abstract import DEFAULT_HALF_WIDTH as DEFAULT_HALF_WIDTH, AbstractModel as AbstractModel
from .models.flight_model import TERMS as TERMS, FlightModel as FlightModel
from .models.os4 import CorrectedOS4 as CorrectedOS4, PublishedOS4 as PublishedOS4
from .networks import NetworkEstimator as NetworkEstimator, TrainedNetwork as TrainedNetwork
from .networks.file import load_network as load_network, save_network as save_network
from .noise import (
    SENSOR_SIGMA as SENSOR_SIGMA,
    AbstractNoise as AbstractNoise,
    Chain as Chain,
    ConstantBias as ConstantBias,
    Dropouts as Dropouts,
    GaussMarkov as GaussMarkov,
    Quantisation as Quantisation,
    WhiteNoise as WhiteNoise,
)
from .recording import Recording as Recording, join as join
from .result_file import read_result as read_result
from .results import RESULTS as RESULTS, result_names as result_names
from .shooting import (
    InnovationsProblem as InnovationsProblem,
    ShootingProblem as ShootingProblem,
    Unknowns as Unknowns,
)
from .simulation import simulate as simulate
