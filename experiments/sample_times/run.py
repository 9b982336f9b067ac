"""Is the answer the same at every sample time? And is it right if the logged rotor speeds are noisy?

Each flight: a CineRat (3-inch quadrotor, rotors with a lag of 25 ms) flies random references through gusts. The
estimator gets the true airframe. Rotor speeds or commands are logged every `--dt` seconds, and the flight is fitted at
several sample times. A sample time of 0 is the one that the rule chooses.

The simulator is finer than the controller, which runs every 4 ms, or as often as the log is written if that is more
often: four steps in each of its runs. Its references change as often as it runs. A slower log has some of its rows: if
references changed only where the log has a row, commands would change little in between. A command that the log holds
for n runs of the controller is late by (n - 1) / 2 runs: the true delay of the rotors is then negative.
"""

from pathlib import Path

import equinox as eqx
import jax
import numpy as np

import jaxos4
from experiments.fits import identified
from experiments.monte_carlo import Row, groups, plus_minus, print_table, product, results_of, statistics, study
from experiments.shared import Count, Out
from jaxos4.recording import Recording

VEHICLE = jaxos4.load_airframe(Path(__file__).with_name("cinerat.toml"))
SAMPLE_TIMES = (0, 0.004, 0.008, 0.016, 0.032)
LAG, PERIOD = 0.025, 0.004  # of rotors and controller [s]
TRUTH = {
    "Ix": 6.3e-4,
    "Iy": 7.5e-4,
    "Iz": 8.9e-4,
    "rotor_reaction": 9e-7 / 8.9e-4,
    "rotor_delay": 0.0,
    "rotor_lag": LAG,
    "roll_damping": 0.0,
    "yaw_damping": 0.0,
}
UNITS = {"rotor_delay": (1e3, "ms"), "roll_damping": (1.0, "1/s"), "yaw_damping": (1.0, "1/s")}


def fly(logged: str, dt: float, duration: float, gust: float, noise: float, seed: int) -> jaxos4.Flight:
    """One flight. `noise`: of logged rotor speeds, as a share of the median of their changes from sample to sample."""
    every = max(round(dt / PERIOD), 1)
    loop = jaxos4.ClosedLoop(VEHICLE, rotor_lag=LAG, rotor_delay=0.0, gust=gust, logged=logged)
    first, second = jax.random.split(jax.random.key(seed))
    references = jaxos4.random_references(duration=duration, dt=dt / every, key=first)
    flight = jaxos4.fly_closed_loop(loop, references, dt=dt / every, key=second, substeps=4)
    flight = Recording.of(flight, "flight").rows(slice(None, None, every)).flight
    if not noise:
        return flight
    omega = np.asarray(flight.omega)
    size = noise * np.median(np.abs(np.diff(omega, axis=0)))
    noisy = omega + size * np.random.default_rng(seed).normal(size=omega.shape)
    return eqx.tree_at(lambda f: f.omega, flight, np.maximum(noisy, 0.0))


def fit(flight: jaxos4.Flight, sample_time: float) -> Row:
    """The answer at one sample time: value and standard deviation of each quantity."""
    row, found = identified(
        flight, VEHICLE, settings=jaxos4.VehicleSettings(sample_time=sample_time or None, holdout=0.0)
    )
    if found is None:
        return row | {"found": {}}
    known = {name: one for name, one in (found.parameters | found.rigid_body.constants).items() if name in TRUTH}
    pairs = {name: (one.estimate, one.std) for name, one in known.items() if None not in (one.estimate, one.std)}
    return row | {"sampled": found.provenance.sample_time, "found": pairs}


def truth_of(logged: str, dt: float) -> dict[str, float]:
    """The true values for a log with rows every `dt` seconds."""
    held = (max(round(dt / PERIOD), 1) - 1) * PERIOD / 2 if logged == "commands" else 0.0
    return TRUTH | {"rotor_delay": -held}


def summary(rows: list[Row], true: dict[str, float]) -> dict[str, Row]:
    """The `statistics` of each quantity. Shares of the truth if that is not 0."""
    found = {}
    for name, truth in true.items():
        pairs = np.array([row["found"][name] for row in rows if name in row["found"]])
        if len(pairs) >= 2:
            scale = (name not in UNITS and truth) or 1.0
            found[name] = statistics((pairs[:, 0] - truth) / scale, pairs[:, 1] / scale)
    return found


def print_cases(rows: list[Row], true: dict[str, float]) -> None:
    """One line for each sample time and quantity."""
    lines = []
    for (sample_time,), some in groups(rows, "sample_time").items():
        for name, row in summary(some, true).items():
            factor, unit = UNITS.get(name, (100.0, "%"))
            mean, covered = f"{plus_minus(row, scale=factor)} {unit}", plus_minus(row, "covered")
            lines.append((f"{1e3 * sample_time:g}", name, str(row["flights"]), mean, covered, results_of(some)))
    headings = "ms", "", "flights", "mean error", "covered [%]", "results"
    print_table("errors by sample time", headings, lines, width=120)


def main(
    flights: Count = 40,
    logged: str = "speeds",
    sample_times: list[float] = SAMPLE_TIMES,
    dt: float = 0.004,
    noise: float = 0.0,
    gust: float = 1.0,
    duration: float = 60.0,
    seed: int = 0,
    out: Out = None,
) -> None:
    """Measure errors and coverage at several sample times.

    - `logged`: speeds or commands. `dt`: Sample time of the log [s].
    - `sample_times`: [s]; 0: the rule chooses.
    - `noise`: Noise of rotor speeds, as a share of their median change.
    - `gust`: Standard deviation of the gusts [rad/s^2].
    - `seed`: Random seed of the first flight; each has one more.
    """
    settings = {"logged": logged, "dt": dt, "noise": noise, "gust": gust, "duration": duration, "seed": seed}
    flown = [fly(logged, dt, duration, gust, noise, seed + i) for i in range(flights)]

    def row_of(sample_time: float, flight: int) -> Row:
        return fit(flown[flight], sample_time)

    rows = study(out, settings, product(sample_time=sample_times, flight=range(flights)), row_of)
    print_cases(rows, truth_of(logged, dt))
