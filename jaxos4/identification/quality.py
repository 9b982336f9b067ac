"""How well a model explains each channel of a flight."""

from ..analysis.diagnostics import Diagnostics, diagnostics_of
from ..analysis.evaluation import Evaluation
from ..flight import STATE_NAMES, STATE_UNITS
from ..models.state import CASCADE_ORDER
from ..shooting import ShootingProblem
from .results import ChannelFit, finite_or_none

# Correlations of residuals are computed up to this many samples apart.
_LAGS = 25
_FEWEST_SAMPLES = 2


def diagnose(evaluation: Evaluation, *, fitted: bool) -> Diagnostics:
    """Diagnostics of the residuals; `fitted`: whether the parameters were fitted to this flight."""
    return diagnostics_of(evaluation, fitted=fitted, lags=min(_LAGS, evaluation.measured.shape[0] // 2))


def channel_fits(problem: ShootingProblem, diagnostics: Diagnostics) -> dict[str, ChannelFit]:
    """The diagnostics of each measured channel, by its name."""
    return {
        STATE_NAMES[column]: ChannelFit(
            rms=float(diagnostics.rms[i]),
            unit=STATE_UNITS[column],
            percent=finite_or_none(diagnostics.percent[i]),
            level=float(diagnostics.level[i]),
            level_p=float(diagnostics.level_p[i]),
            correlation=float(diagnostics.colour[i]),
            white_p=float(diagnostics.white_p[i]),
            input_correlation=dict(
                zip(("roll", "pitch", "yaw"), diagnostics.input_correlation[i].tolist(), strict=True)
            ),
            input_p=float(diagnostics.input_p[i]),
        )
        for i, column in enumerate(CASCADE_ORDER[: problem.size])
        if diagnostics.count[i] > _FEWEST_SAMPLES
    }
