"""Does the frequency response of a right model hold 1? Nothing is fitted: the model has the true parameters.

The flights are those of `closed_loop/effects.py`, in gusts of several strengths, and with those effects that the model
can describe exactly or that are effects of the sensors. A second table says how often an axis would have a reservation,
for the right model and for wrong ones.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

import jaxos4
from experiments.closed_loop.effects import DELAY, EFFECTS, GUST, LAG, VEHICLE, flights_of
from experiments.monte_carlo import LOST, Row, print_table, share, study
from experiments.shared import Count, Out, Seed
from experiments.verdicts.run import agreements, print_responses
from jaxos4.airframe import MOTIONS
from jaxos4.analysis.frequency_response import Agreement
from jaxos4.identification.verdict import MAX_SHARE
from jaxos4.models.terms import default_terms
from jaxos4.recording import Recording
from jaxos4.recording.prepared import prepare

# Factors by which the torque of a wrong model is too weak: the gain is larger by as much.
TOO_WEAK = (1.0, 1.12, 1.25, 1.5, 2.0)
DESCRIBED = ("own gyro", "fast controller", "filters", "rotor speeds", "dropouts", "bad samples", "motors")


def true_parameters(model: jaxos4.FlightModel, kind: str) -> jax.Array:
    """The parameters of a model of `VEHICLE` that are true in a flight of this kind."""
    own = {"rotor_lag": LAG, "rotor_delay": DELAY, "thrust_curve": 1.0, "motor_braking": 1.0, "z_drag": 0.0}
    own |= {name: 1 - below for name, below in EFFECTS[kind].motor.items()}
    values = zip(model.parameter_names, np.asarray(model.alpha).tolist(), strict=True)
    return jnp.array([own.get(name, value) for name, value in values])


def answered(flight: jaxos4.Flight, kind: str) -> Row:
    """The mean gain of each axis, and its error, at each sample time."""
    found = {}
    for prepared in prepare([Recording.of(flight, kind)], VEHICLE, holdout=0.0):
        model = jaxos4.FlightModel(VEHICLE, terms=default_terms(prepared.available), recordings=prepared.recordings)
        problem = jaxos4.ShootingProblem(model, prepared.fitted, sigma=np.ones(12), channels="rates", method="rk4")
        response = jaxos4.frequency_response(problem, true_parameters(model, kind))
        found[f"{1e3 * float(prepared.fitted.dt):.3g} ms"] = agreements(response)
    return {"responses": found}


def main(
    flights: Count = 200,
    gusts: list[float] = (2.5, 5.0, 10.0),
    effects: list[str] = DESCRIBED,
    sample_times: list[str] = ("4 ms", "8 ms"),
    duration: float = 20.0,
    seed: Seed = 48,
    out: Out = None,
) -> None:
    """Count how often the intervals of the frequency response hold 1 at the true parameters.

    - `gusts`: Their strengths, without other effects [rad/s^2]. `effects`: Other effects, in gusts of 5 rad/s^2.
    - `sample_times`: Those of the table.
    """
    kinds = [("gusts", gust) for gust in gusts] + [(kind, GUST) for kind in effects]
    flown = functools.cache(lambda kind, gust: flights_of(kind, flights, duration, seed, gust))
    trials = ({"kind": kind, "gust": gust, "flight": i} for kind, gust in kinds for i in range(flights))

    def row_of(kind: str, gust: float, flight: int) -> Row:
        recorded = flown(kind, gust)[flight]
        return {"result": LOST} if recorded is None else answered(recorded, kind)

    groups: dict[str, list[Row]] = {}
    for row in study(out, {"duration": duration, "seed": seed}, trials, row_of):
        name = f"gusts of {row['gust']:g}" if row["kind"] == "gusts" else row["kind"]
        for step in sample_times:
            own = row.get("responses", {}).get(step, {})
            groups.setdefault(f"{name}, {step}", []).append({"response": own})
    print_responses("frequency response at the true parameters", groups)
    print_reservations(groups)


def print_reservations(groups: dict[str, list[Row]]) -> None:
    """For each group and axis: how often it has a reservation, if the model's torque is too weak by each factor."""
    lines = []
    for name, rows in groups.items():
        for axis in MOTIONS:
            every = [row["response"][axis] for row in rows if axis in row["response"]]
            shares = []
            for factor in TOO_WEAK:
                agreements = (Agreement(factor * ratio, error, math.nan, math.nan) for ratio, error in every)
                reserved = [each.excludes_one(MAX_SHARE) for each in agreements]
                shares.append(share(sum(reserved), len(reserved)))
            lines.append((name, axis, *shares))
    print_table(
        "reservations [%]", ("case", "axis", *(f"torque too weak by {x:g}" for x in TOO_WEAK)), lines, width=170
    )
