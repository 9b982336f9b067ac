"""Coverage of 95 % intervals on dirty flights: rotor lag, late commands, vibration, coloured noise, lost samples.

Each flight is simulated at 1 kHz by Runge-Kutta with its own true parameters: rotors follow their commands with a lag
of 60 ms and a delay of 8 ms, thrust is between linear and quadratic in the rotor speed, and there are offsets and
damping. Gyro and accelerometer show coloured noise, vibration and rounding, and lose samples, alone and in bursts. The
recording is averaged to 4 ms and fitted by the likelihood of its innovations. Parameters that a fit holds are not
counted.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, monte_carlo, print_table
from jaxos4.estimators import make_estimator
from jaxos4.identification.search import search
from jaxos4.identification.uncertainty import corrected
from jaxos4.logs.sampling import averages
from jaxos4.models.flight_model import DEFAULT_TERMS
from jaxos4.results import NINETY_FIVE

# As large as a Crazyflie 2.
CRAZYFLIE = jaxos4.Airframe(
    mass=0.032,
    inertia=(1.66e-5, 1.66e-5, 2.93e-5),
    rotor_positions=[(0.0325, -0.0325), (-0.0325, -0.0325), (-0.0325, 0.0325), (0.0325, 0.0325)],
    rotor_spins=(1.0, -1.0, 1.0, -1.0),
    thrust_coefficient=2.25e-8,
    drag_coefficient=1.34e-10,
    rotor_inertia=1.0e-8,
    max_rotor_speed=2600.0,
)
# The paper gives no largest rotor speed: twice that of hover.
FAST_OS4 = eqx.tree_at(lambda a: a.max_rotor_speed, jaxos4.OS4, 450.0)
AIRFRAMES = {"os4": FAST_OS4, "crazyflie": CRAZYFLIE}
TERMS = (*(term for term in DEFAULT_TERMS if term != "lag"), "motor", "accelerometer")
# Parameters whose true values are those that follow from the airframe.
FROM_AIRFRAME = ("alpha1", "alpha2", "alpha4", "alpha5", "alpha7", "rotor_reaction", "az_bias")
LAG, DELAY, CURVE = 0.06, 0.008, (0.4, 1.0)
# Sample times of the simulation and of the fit [s]; a new command comes every other millisecond.
FINE, COARSE, COMMANDED = 1e-3, 4e-3, 2
# Designed rates [rad/s] and tones [Hz] of roll, pitch and yaw; amplitude of the thrust as a share of the weight.
AMPLITUDE, TONES, HEAVE = (1.6, 1.6, 0.5), ((0.5, 5.0), (0.5, 5.0), (0.3, 2.0)), 0.15
# Coloured noise, vibration, rounding: of the gyro [rad/s] and of the accelerometer [m/s^2].
COLOUR, VIBRATION, STEP = (0.02, 0.2), (0.05, 0.5), (2e-3, 0.02)
MEMORY, VIBRATING, WANDER = (0.005, 0.02), (80.0, 150.0), 5.0
# The share of samples lost alone; bursts of lost samples per second, and their lengths [s].
LOST, BURSTS, BURST = 0.02, 0.5, (0.005, 0.03)


def truth_of(model: jaxos4.FlightModel, rng: np.random.Generator) -> np.ndarray:
    """A flight's true parameters: some follow from the airframe, the others are random around it."""
    center, half_width = np.asarray(model.alpha), np.asarray(model.half_width)
    values = center + half_width * rng.uniform(-0.4, 0.4, center.size)
    for i, name in enumerate(model.parameter_names):
        if name in FROM_AIRFRAME:
            values[i] = center[i]
        elif name.endswith("damping"):
            values[i] = rng.uniform(0.5, 3.0)
        elif name in ("rotor_lag", "rotor_delay"):
            values[i] = LAG if name == "rotor_lag" else DELAY
        elif name == "thrust_curve":
            values[i] = rng.uniform(*CURVE)
    return values


def commands(model: jaxos4.FlightModel, truth: np.ndarray, duration: float, rng: np.random.Generator) -> np.ndarray:
    """Commanded rotor speeds [rad/s] every millisecond: three tones for each axis, one for thrust, offsets trimmed."""
    airframe, values = model.airframe, dict(zip(model.parameter_names, truth, strict=True))
    tones = [np.sort(rng.uniform(*span, 3)).tolist() for span in TONES]
    omega = np.array(jaxos4.multisine(airframe, duration=duration, dt=FINE, amplitude=AMPLITUDE, tones=tones))
    t, phase = FINE * np.arange(omega.shape[0]), rng.uniform(0, 2 * np.pi)
    squares = omega**2 * (1 + HEAVE * np.sin(2 * np.pi * rng.uniform(0.4, 1.5) * t + phase))[:, None]
    axes = zip(("roll", "pitch", "yaw"), ("alpha3", "alpha6", "alpha8"), strict=True)
    trim = np.array([-values[f"{axis}_offset"] / values[alpha] for axis, alpha in axes] + [0.0])
    squares = np.maximum(squares + np.linalg.solve(np.asarray(airframe.mixer), trim), 0.0)
    # Commands that give this thrust through the thrust curve.
    curve, speeds = values["thrust_curve"], np.sqrt(squares)
    omega = speeds * (curve + (1 - curve) * speeds / float(airframe.max_rotor_speed))
    held = np.arange(omega.shape[0]) // COMMANDED * COMMANDED
    return omega[held]


@eqx.filter_jit
def fly(model: jaxos4.FlightModel, parameters: jax.Array, omega: jax.Array) -> jax.Array:
    """The rates and the vertical specific force [m/s^2], every millisecond, from rest."""
    empty = jaxos4.Flight(FINE * jnp.arange(omega.shape[0]), omega, jnp.full((omega.shape[0], 12), jnp.nan))
    sigma = jnp.ones(12)
    problem = jaxos4.ShootingProblem(
        model, empty, sigma=sigma, initial_state=jnp.zeros(12), channels="rates", method="rk4"
    )
    return problem.predict(parameters, jnp.zeros(3))


def dirty(exact: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The sensors' readings of `exact`, with every fault."""
    samples, channels = exact.shape
    t, seen = FINE * np.arange(samples), np.array(exact)
    scale = np.array([0, 0, 0, 1])
    colour, vibration, step = (np.array(pair)[scale] for pair in (COLOUR, VIBRATION, STEP))
    decay = np.exp(-FINE / rng.uniform(*MEMORY, channels))
    error = rng.standard_normal(channels)
    for k in range(samples):
        seen[k] += colour * error
        error = decay * error + np.sqrt(1 - decay**2) * rng.standard_normal(channels)
    # Rotors do not turn evenly: the phase of the vibration wanders.
    wander = np.cumsum(np.sqrt(WANDER * FINE) * rng.standard_normal(samples))
    phase = 2 * np.pi * rng.uniform(*VIBRATING) * t + wander
    seen += vibration * np.sin(phase[:, None] + rng.uniform(0, 2 * np.pi, channels))
    seen = step * np.round(seen / step)
    seen[rng.uniform(size=samples) < LOST] = np.nan
    for start in rng.uniform(0, t[-1], rng.poisson(BURSTS * t[-1])):
        seen[(t >= start) & (t < start + rng.uniform(*BURST))] = np.nan
    return seen


def recorded(omega: np.ndarray, seen: np.ndarray) -> jaxos4.Flight:
    """The averaged recording."""
    t = FINE * np.arange(omega.shape[0])
    grid, speeds, channels = averages(t, omega, seen, held=True)(COARSE)
    states, force = np.full((grid.size, 12), np.nan), np.full((grid.size, 3), np.nan)
    states[:, [7, 9, 11]], force[:, 2] = channels[:, :3], channels[:, 3]
    return jaxos4.Flight(grid, speeds, states, force)


def identify(airframe: jaxos4.Airframe, estimator: str, settings: Row, flight: int) -> Row:
    """One flight: its true parameters, their estimates, and why others are fixed."""
    rng = np.random.default_rng([settings["seed"], flight])
    model = jaxos4.FlightModel(airframe, terms=TERMS)
    truth = truth_of(model, rng)
    omega = commands(model, truth, settings["duration"], rng)
    exact = np.asarray(fly(model, jnp.asarray(truth), jnp.asarray(omega)))
    measured = recorded(omega, dirty(exact, rng))
    sigma = np.append(3 * jaxos4.SENSOR_SIGMA, np.full(3, 0.3))
    problem = jaxos4.ShootingProblem(model, measured, sigma=sigma, channels="rates", method="rk4")
    begin = time.perf_counter()
    optimum = search(make_estimator(estimator), jaxos4.InnovationsProblem(problem))
    answer = corrected(optimum, problem, np.zeros(measured.time.shape[0], dtype=int))
    seconds, values = time.perf_counter() - begin, np.asarray(answer.estimate.parameters)
    half_width = np.asarray(answer.estimate.half_width(0.95))
    free = {model.parameter_names[i]: i for i in answer.free}
    return {
        "fastest": float(np.abs(exact[:, :3]).max()),
        "result": str(jaxos4.result_names(answer.estimate.result)),
        "truth": dict(zip(model.parameter_names, truth.tolist(), strict=True)),
        "estimate": {name: float(values[i]) for name, i in free.items()},
        "half_width": {name: float(half_width[i]) for name, i in free.items()},
        "bound": {name: float(answer.bound[i]) for name, i in free.items()},
        "held": {name: fixed.note for name, fixed in answer.fixed.items()},
        "seconds": seconds,
    }


def summary(flights: list[Row]) -> dict[str, Row]:
    """For each parameter: in how many flights it was identified, and how often the interval held the truth.

    `bias`, `spread`: mean and standard deviation of the errors, in standard deviations of the fits.
    """
    rows = {}
    for name in flights[0]["truth"]:
        some = [f for f in flights if name in f["estimate"] and np.isfinite(f["half_width"][name])]
        errors = np.array([f["estimate"][name] - f["truth"][name] for f in some])
        half_width = np.array([f["half_width"][name] for f in some])
        if some:
            scaled = NINETY_FIVE * errors / half_width
            rows[name] = {
                "identified": len(some),
                "covered": float((np.abs(errors) <= half_width).mean()),
                "monte_carlo_error": float(np.sqrt(0.95 * 0.05 / len(some))),
                "bias": float(scaled.mean()),
                "spread": float(scaled.std(ddof=1)) if len(some) > 1 else None,
                "mean_error": float(errors.mean()),
                "claimed_over_bound": float(
                    np.median([f["half_width"][name] / NINETY_FIVE / f["bound"][name] for f in some])
                ),
            }
    return rows


def table_rows(summary: Row) -> Iterator[tuple[str, ...]]:
    """One line for each parameter."""
    for parameter, row in summary.items():
        yield (
            *(parameter, str(row["identified"])),
            *(f"{100 * row['covered']:.1f}", f"{100 * row['monte_carlo_error']:.1f}", f"{row['bias']:.2f}"),
            "-" if row["spread"] is None else f"{row['spread']:.2f}",
            *(f"{row['mean_error']:.2g}", f"{row['claimed_over_bound']:.2f}"),
        )


def main(
    flights: Annotated[int, typer.Option(help="Flights of each airframe.")] = 120,
    duration: Annotated[float, typer.Option(help="Length of a flight [s].")] = 15.0,
    seed: Annotated[int, typer.Option(help="Random seed of parameters, commands and noise.")] = 17,
    airframes: Annotated[list[str], typer.Option(help="Names of airframes.")] = tuple(AIRFRAMES),
    estimator: Annotated[str, typer.Option(help="filter-error or ibss.")] = "filter-error",
    out: Annotated[Path | None, typer.Option(help="JSON file for the figures; continued if it exists.")] = None,
) -> None:
    """Coverage of 95 % intervals on dirty flights."""
    settings = {"seed": seed, "duration": duration, "estimator": estimator}

    def row_of(flight: int, i: int, airframe: str) -> Row:
        return identify(AIRFRAMES[airframe], estimator, settings, flight)

    cases = [{"airframe": name} for name in airframes]
    report = monte_carlo(out, settings, cases, lambda airframe: range(flights), row_of, summary)
    for case in report["cases"]:
        seconds = float(np.median([flight["seconds"] for flight in case["flights"]]))
        title = f"95 % intervals of {flights} flights of {duration:g} s, {case['airframe']}, {seconds:.1f} s a fit"
        headings = "parameter", "identified", "covered [%]", "+-", "bias [std]", "spread [std]", "mean error", "/ CRB"
        print_table(title, headings, table_rows(case["summary"]), width=120)
