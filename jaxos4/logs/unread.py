"""Files that no reader takes, named by their first bytes, and how to make a log of them that is read."""

import re

_IN_PYTHON = "read it in Python, and give its arrays to jaxos4.read_log"
_KINDS = {
    rb"PK\x03\x04": ("an archive (zip, or .xlsx, .npz)", f"unpack it, export its table as CSV, or {_IN_PYTHON}"),
    rb"\x1f\x8b|BZh|\xfd7zXZ|7z\xbc\xaf|\x28\xb5\x2f\xfd|\x04\x22\x4d\x18": ("a compressed file", "unpack it"),
    rb"\x89HDF": ("an HDF5 file (netCDF, MATLAB 7.3)", f"{_IN_PYTHON} (xarray.open_dataset, h5py)"),
    rb"MATLAB 5": ("a MATLAB file", f"{_IN_PYTHON} (scipy.io.loadmat), or export CSV by `writetable`"),
    rb"\x93NUMPY": ("a NumPy file", f"{_IN_PYTHON} (numpy.load)"),
    rb"PAR1|ARROW1|FEA1": ("a Parquet or Arrow file", f"{_IN_PYTHON} (pandas.read_parquet, pandas.read_feather)"),
    rb"\xd0\xcf\x11\xe0": ("an Excel file", "export it as CSV"),
    rb"\xff\xfe|\xfe\xff": ("text in UTF-16", "save it as CSV in UTF-8"),
    rb"FMT, ": ("a text log of ArduPilot", "give the .BIN file of which it was made"),
    rb"\0[\x03-\x07].{6}[\xfd\xfe]": ("a telemetry log of MAVLink (.tlog)", "give the log of the vehicle's own card"),
    rb".{16}BUILD|.{242}DJI": ("a log of DJI", "decode it by DatCon, and give its CSV with a column map"),
    rb"[^\n]{0,4000}[\0-\x08\x0e-\x1f]": ("of a kind that is not known", "export it as CSV, and give a column map"),
}


def unread_kind(begin: bytes) -> str:
    """The kind of a file by its first bytes, and what to do with it; empty if it may be a CSV."""
    return next(
        (f"is {what}; {remedy}" for magic, (what, remedy) in _KINDS.items() if re.match(magic, begin, re.DOTALL)), ""
    )
