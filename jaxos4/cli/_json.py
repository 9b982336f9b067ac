"""What commands write for programs."""

import json
import math
from pathlib import Path
from typing import Any, SupportsFloat

from .._files import write_atomically


def write_json(report: dict[str, Any], out: Path) -> None:
    """Whole or not at all; numbers that are not finite are a mistake of ours."""
    with write_atomically(out) as beside:
        beside.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def finite(x: SupportsFloat) -> float | None:
    """A number, or nothing where it is not finite."""
    return float(x) if math.isfinite(float(x)) else None
