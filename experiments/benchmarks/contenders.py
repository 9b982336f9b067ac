"""Who takes part: each contender's file and function in `opponents/`, what it needs, and with whom it is compared."""

import importlib.util
from typing import Any, NamedTuple

from experiments.benchmarks.opponents.in_c import COMPILERS, compiler
from jaxos4.batching import cores

REFERENCE_FIT = "CasADi, single shooting, compiled"
BEST_FIT = "C, Levenberg-Marquardt"
REFERENCE_SHOT = "C, 8 lanes"
ALL_CORES, ONE, SAME = ", all cores", ", one flight", ", same flight"


class Contender(NamedTuple):
    """One contender.

    - `entry`: `"file:function"` in `opponents/`.
    - `needs`: the package that must be installed, or `"cc"` for a C compiler.
    - `alone`: whether it solves one flight after another; it then gets only a few.
    - `options`: of the function.
    - `rivals`: the contenders to whose times its times are compared. They have as many cores, and do the same.
    """

    entry: str
    needs: str = "jaxos4"
    alone: bool = False
    options: dict[str, Any] = {}
    rivals: tuple[str, ...] = ()

    @property
    def missing(self) -> str | None:
        """Why it cannot take part, and what to do; `None` if it can."""
        if self.needs == "cc":
            return None if compiler() else f"no C compiler ({', '.join(COMPILERS)}): install one"
        if importlib.util.find_spec(self.needs):
            return None
        return f"{self.needs} is not installed: pip install {self.needs}"


def is_ours(name: str) -> bool:
    """Whether a contender of this name is a method of this package."""
    return name.startswith("jaxos4")


def _casadi(method: str = "single", **options: Any) -> Contender:
    return Contender(f"casadi_fit:{method}", "casadi", alone=True, options=options)


def _in_c(**options: Any) -> Contender:
    return Contender("in_c:levenberg_marquardt", "cc", alone=options["lanes"] == 1, options=options)


def _ours(estimator: str, **options: Any) -> Contender:
    alone = options.get("lanes") == 1
    return Contender("ours:fit", alone=alone, options={"estimator": estimator, **options})


def _compared_fit(name: str, contender: Contender) -> Contender:
    """A fit with its rivals: several flights at a time or one, on one core or all."""
    if name.endswith(ALL_CORES):
        return contender._replace(rivals=(REFERENCE_FIT + ALL_CORES, BEST_FIT + ALL_CORES))
    return contender._replace(rivals=(REFERENCE_FIT, BEST_FIT + ONE * contender.alone))


OURS = ("kalman", "output-error", "ibss", "hybrid")
_FITS = {
    BEST_FIT: _in_c(lanes=4),
    BEST_FIT + ALL_CORES: _in_c(lanes=4, cores=cores()),
    BEST_FIT + ONE: _in_c(lanes=1),
    REFERENCE_FIT: _casadi(compiled=True),
    REFERENCE_FIT + ALL_CORES: _casadi(compiled=True, cores=cores()),
    "CasADi, single shooting": _casadi(),
    "CasADi, multiple shooting": _casadi("multiple"),
    "SciPy least_squares": Contender("least_squares:levenberg_marquardt", "scipy", alone=True),
    "pyPESTO, 4 starts": Contender("least_squares:multi_start", "pypesto", alone=True),
    "JAX and optimistix": Contender("optimistix_fit:levenberg_marquardt", "optimistix"),
    **{f"jaxos4 {name}{ALL_CORES}": _ours(name, all_cores=True) for name in OURS},
    **{f"jaxos4 {name}": _ours(name) for name in OURS},
    **{f"jaxos4 {name}{ONE}": _ours(name, lanes=1) for name in OURS},
}
FITS = {name: _compared_fit(name, contender) for name, contender in _FITS.items()}
# Slower than others in the race, or trained anew: they take part if they are named.
SLOW = ("SciPy least_squares", "pyPESTO, 4 starts", "JAX and optimistix") + tuple(
    f"jaxos4 {name}{how}" for name in ("kalman", "hybrid") for how in (ALL_CORES, ONE)
)
QUICK = tuple(name for name in FITS if name not in SLOW)

KINDS: dict[str, dict[str, Any]] = {
    "": {},
    ", slope": {"slope": True},
    ", rates": {"channels": "rates"},
    ", rates, slope": {"channels": "rates", "slope": True},
}


def _shots(entry: str, needs: str = "jaxos4", kind: str = "", **options: Any) -> Contender:
    rival = REFERENCE_SHOT + SAME * options.get("same_flight", False) + kind
    return Contender(entry, needs, options=KINDS[kind] | options, rivals=(rival,))


SHOTS = {
    **{REFERENCE_SHOT + kind: _shots("in_c:lanes", "cc", kind) for kind in KINDS},
    **{f"{REFERENCE_SHOT}{SAME}{kind}": _shots("in_c:lanes", "cc", kind, same_flight=True) for kind in KINDS},
    "C, plain": _shots("in_c:plain", "cc"),
    "JAX, plain": _shots("optimistix_fit:shots", "optimistix"),
    **{f"jaxos4{kind}": _shots("ours:shots", kind=kind) for kind in KINDS},
    **{f"jaxos4{SAME}{kind}": _shots("ours:shots", kind=kind, same_flight=True) for kind in KINDS},
    "jaxos4, all cores": Contender("ours:shots", options={"all_cores": True}),
    "jaxos4, rates, all cores": Contender("ours:shots", options={"all_cores": True, "channels": "rates"}),
    "crazyflow (richer model)": Contender("crazyflow_steps:steps", "crazyflow"),
}
NETWORKS = {
    "jaxos4 network": Contender("ours:network"),
    "sbi NPE, reduced budget": Contender("sbi_network:npe", "sbi"),
}
