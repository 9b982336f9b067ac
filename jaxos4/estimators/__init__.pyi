from .ant_colony import AntColony as AntColony
from .equation_error import EquationError as EquationError, RecursiveLeastSquares as RecursiveLeastSquares
from .hybrid import Hybrid as Hybrid
from .ibss import IBSS as IBSS
from .kalman import JointEKF as JointEKF
from .levenberg_marquardt import LevenbergMarquardt as LevenbergMarquardt
from .output_and_filter_error import FilterError as FilterError, OutputError as OutputError
from .registry import ESTIMATORS as ESTIMATORS, make_estimator as make_estimator
from .svsf import SVSF as SVSF
