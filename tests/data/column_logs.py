"""Tables with columns of other names."""

import numpy as np
from recorded_logs import FRD, attitude, force, position, rates, speeds, table_csv
from scipy.spatial.transform import Rotation

T = 0.004 * np.arange(750)


def quaternions(turned=False):
    """w, x, y, z, from the body to the earth, in our frame; or `turned`: both with y to the right and z down."""
    rotation = FRD @ attitude(T) @ FRD if turned else attitude(T)
    return Rotation.from_matrix(rotation).as_quat()[:, [3, 0, 1, 2]]


def neurobem_csv(rows=None):
    names = "t,ang acc x,ang vel x,ang vel y,ang vel z,quat x,quat y,quat z,quat w,acc x,acc y,acc z,vel x,"
    names = [*f"{names}pos x,pos y,pos z".split(","), "mot 1", "mot 2", "mot 3", "mot 4", "dmot 1", "vbat"]
    quaternion = quaternions()[:, [1, 2, 3, 0]]
    columns = (T, T, rates(T), quaternion, force(T), T, position(T), speeds(T), T, 16 - 0.1 * T)
    return table_csv(names, *(column[:rows] for column in columns))
