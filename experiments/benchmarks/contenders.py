"""Who takes part: each contender's file and function in `opponents/`, and what it needs."""

import importlib.util
from typing import Any, NamedTuple

from experiments.benchmarks.opponents.c_shots import COMPILERS, compiler

REFERENCE_FIT = "CasADi, single shooting"
REFERENCE_SHOT = "C -O3, one core"


class Contender(NamedTuple):
    """One contender.

    - `entry`: `"file:function"` in `opponents/`.
    - `needs`: the package that must be installed, or `"cc"` for a C compiler.
    - `alone`: whether it solves one flight after another; it then gets only a few.
    - `options`: of the function.
    """

    entry: str
    needs: str = "jaxos4"
    alone: bool = False
    options: dict[str, Any] = {}

    @property
    def missing(self) -> str | None:
        """Why it cannot take part, and what to do; `None` if it can."""
        if self.needs == "cc":
            return None if compiler() else f"no C compiler ({', '.join(COMPILERS)}): install one"
        if importlib.util.find_spec(self.needs):
            return None
        return f"{self.needs} is not installed: pip install {self.needs}"


def _ours(estimator: str, **options: Any) -> Contender:
    alone = options.get("lanes") == 1
    return Contender("jaxos4_fit:fit", alone=alone, options={"estimator": estimator, **options})


def _shots(**options: Any) -> Contender:
    return Contender("jaxos4_shots:shots", options=options)


COMPILED_FIT = Contender("casadi_fit:single", "casadi", alone=True, options={"compiled": True})
OURS = ("kalman", "output-error", "ibss", "hybrid")
FITS = {
    REFERENCE_FIT: Contender("casadi_fit:single", "casadi", alone=True),
    "CasADi, single shooting, compiled": COMPILED_FIT,
    "CasADi, multiple shooting": Contender("casadi_fit:multiple", "casadi", alone=True),
    "SciPy least_squares": Contender("scipy_fit:levenberg_marquardt", "scipy", alone=True),
    "pyPESTO, 4 starts": Contender("pypesto_fit:multi_start", "pypesto", alone=True),
    "JAX and optimistix": Contender("optimistix_fit:levenberg_marquardt", "optimistix"),
    **{f"jaxos4 {name}, all cores": _ours(name, all_cores=True) for name in OURS},
    **{f"jaxos4 {name}": _ours(name) for name in OURS},
    **{f"jaxos4 {name}, one flight": _ours(name, lanes=1) for name in OURS},
}
KINDS: dict[str, dict[str, Any]] = {
    "": {},
    ", slope": {"slope": True},
    ", rates": {"channels": "rates"},
    ", rates, slope": {"channels": "rates", "slope": True},
}
SHOTS = {
    REFERENCE_SHOT: Contender("c_shots:shots", "cc"),
    "JAX, plain": Contender("optimistix_fit:shots", "optimistix"),
    **{f"jaxos4{kind}": _shots(**options) for kind, options in KINDS.items()},
    **{f"jaxos4, same flight{kind}": _shots(same_flight=True, **options) for kind, options in KINDS.items()},
    "jaxos4, all cores": _shots(all_cores=True),
    "jaxos4, rates, all cores": _shots(all_cores=True, channels="rates"),
    "crazyflow (richer model)": Contender("crazyflow_steps:steps", "crazyflow"),
}
NETWORKS = {
    "jaxos4 network": Contender("jaxos4_network:network"),
    "sbi NPE, reduced budget": Contender("sbi_network:npe", "sbi"),
}
