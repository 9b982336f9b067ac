"""An identified vehicle as a model for simulators: MuJoCo, RotorPy and SDF (Gazebo)."""

from .result import Identified as Identified, read_result as read_result
from .targets import TARGETS as TARGETS, Target as Target
from .vehicle import RigidVehicle as RigidVehicle
from .writing import Exported as Exported, export_vehicle as export_vehicle
