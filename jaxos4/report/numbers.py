"""Numbers as text: significant digits, and powers of ten only for very small and very large numbers."""

import math

MISSING = "–"


def plain(value: float, digits: int = 3) -> str:
    """`value` with so many significant digits; a dash if it is NaN."""
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
    """A share in percent, without the sign %; a dash if it is NaN."""
    return MISSING if math.isnan(share) else f"{100 * share:.{digits}f}"
