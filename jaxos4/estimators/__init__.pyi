from .ant_colony import AntColony as AntColony
from .equation_error import EquationError as EquationError
from .filter_error import FilterError as FilterError
from .hybrid import Hybrid as Hybrid
from .ibss import IBSS as IBSS
from .kalman import JointEKF as JointEKF
from .output_error import OutputError as OutputError
from .profile import Profile as Profile, profile_likelihood as profile_likelihood
from .recursive_least_squares import RecursiveLeastSquares as RecursiveLeastSquares
from .registry import ESTIMATORS as ESTIMATORS, make_estimator as make_estimator
from .svsf import SVSF as SVSF
