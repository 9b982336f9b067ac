"""What several simulators cannot have, or have differently: one line each."""

from .vehicle import RigidVehicle

NO_ROTOR_INERTIA = (
    "rotor inertia: not carried: no gyroscopic torque (alpha2, alpha5), no yaw torque of rotors that accelerate"
)
DRAG_OF_ROTORS = "drag: as drag of the rotors, the mean of x and y, right at the hover speed; it also damps yaw"


def curve_of_speed(vehicle: RigidVehicle, largest: str) -> str:
    """How commands become rotor speeds in a simulator that calls the largest speed `largest`."""
    return f"thrust_curve: for the u-th part of a full command, rotor speed = {largest} x sqrt({vehicle.thrust_share})"
