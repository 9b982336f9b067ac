"""An identified vehicle as a model for simulators: MuJoCo, RotorPy, SDF (Gazebo), drone_models (crazyflow) and URDF."""

from .formats import (
    TARGETS as TARGETS,
    Exported as Exported,
    Target as Target,
    export_vehicle as export_vehicle,
    sample_vehicles as sample_vehicles,
)
from .result import Identified as Identified, found_loop as found_loop, read_result as read_result
from .vehicle import RigidVehicle as RigidVehicle
