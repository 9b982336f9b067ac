"""Tables with columns of other names."""

import numpy as np
from recorded_logs import force, position, quaternions, rates, speeds, table_csv

T = 0.004 * np.arange(750)


def neurobem_csv(rows=None):
    names = "t,ang acc x,ang vel x,ang vel y,ang vel z,quat x,quat y,quat z,quat w,acc x,acc y,acc z,vel x,"
    names = [*f"{names}pos x,pos y,pos z".split(","), "mot 1", "mot 2", "mot 3", "mot 4", "dmot 1", "vbat"]
    columns = (T, T, rates(T), quaternions(T)[:, [1, 2, 3, 0]], force(T), T, position(T), speeds(T), T, 16 - 0.1 * T)
    return table_csv(names, *(column[:rows] for column in columns))
