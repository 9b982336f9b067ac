"""Numbers as a reader wants them: as many digits as they are worth, in powers of ten only where they must be."""

import math

MISSING = "–"


def plain(value: float, digits: int = 3) -> str:
    """`value` to `digits` significant digits; a dash where it is missing."""
    if not math.isfinite(value):
        return MISSING if math.isnan(value) else f"{value:g}"
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    if not -3 <= exponent < 6:
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}e{int(power)}"
    return f"{round(value, digits - 1 - exponent):.{max(digits - 1 - exponent, 0)}f}"


def percent(share: float, digits: int = 1) -> str:
    """A share as a percentage without its sign."""
    return MISSING if math.isnan(share) else f"{100 * share:.{digits}f}"
