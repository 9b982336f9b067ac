"""What commands write for programs."""

import json
from pathlib import Path
from typing import Any

from .._files import write_atomically


def write_json(report: dict[str, Any], out: Path) -> None:
    """Write a JSON file, whole or not at all. A number that is not finite is an error of the program."""
    with write_atomically(out) as beside:
        beside.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
