"""sbi: neural posterior estimation (NPE) of the parameters from the measured rates.

Its budget of simulations is small (`simulations`), and it looks at every `EVERY`-th sample of the three rates, because
a density of the raw trajectory takes long to train on a CPU. The answer is the posterior's mean.
"""

import time
from collections.abc import Callable

import numpy as np
import torch
from sbi.inference import NPE
from sbi.utils import BoxUniform

from experiments.benchmarks.case import RATES, Case, trajectories

EVERY = 10
_DRAWS = 1000  # samples of a posterior, for its mean


def npe(case: Case, *, simulations: int, epochs: int = 100) -> Callable[[], dict]:
    """The answers, flight by flight, with the time of the training [s]."""
    torch.manual_seed(0)
    generator = np.random.default_rng(0)
    low, high = case.truth - 2 * case.half_width, case.truth + 2 * case.half_width
    begin = time.perf_counter()
    alphas = generator.uniform(low, high, (simulations, 8))
    states = trajectories(case, alphas, np.zeros((simulations, 12)))
    seen = _features(case, states + generator.standard_normal(states.shape) * case.sigma)
    kept = np.isfinite(seen).all(axis=1)
    prior = BoxUniform(torch.as_tensor(low, dtype=torch.float32), torch.as_tensor(high, dtype=torch.float32))
    inference = NPE(prior, show_progress_bars=False)
    inference.append_simulations(*(torch.as_tensor(x[kept], dtype=torch.float32) for x in (alphas, seen)))
    inference.train(max_num_epochs=epochs)
    posterior = inference.build_posterior()
    training = time.perf_counter() - begin
    observed = torch.as_tensor(_features(case, case.measured), dtype=torch.float32)

    def run() -> dict:
        draws = [posterior.sample((_DRAWS,), x=one, show_progress_bars=False) for one in observed]
        return {"parameters": np.array([draw.mean(dim=0).numpy() for draw in draws]), "training_seconds": training}

    return run


def _features(case: Case, states: np.ndarray) -> np.ndarray:
    """Rates in multiples of 1 rad/s: they are of that size."""
    return states[:, ::EVERY, RATES].reshape(len(states), -1)
