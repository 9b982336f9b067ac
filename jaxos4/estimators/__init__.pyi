from .ant_colony import AntColony as AntColony
from .equation_error import EquationError as EquationError, RecursiveLeastSquares as RecursiveLeastSquares
from .hybrid import Hybrid as Hybrid
from .ibss import IBSS as IBSS
from .levenberg_marquardt import (
    FilterError as FilterError,
    LevenbergMarquardt as LevenbergMarquardt,
    OutputError as OutputError,
)
from .recursive import SVSF as SVSF, JointEKF as JointEKF
from .registry import ESTIMATORS as ESTIMATORS, make_estimator as make_estimator
