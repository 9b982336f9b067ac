"""What does a designed input gain, and do estimates reach the bounds that the design promises?

For each model and each choice of channels: an input is designed within the envelope of the standard multisine, for all
vehicles of the default bracket and for the airframe's vehicle alone. Its bounds are compared with those of the standard
inputs. Then IBSS identifies simulated flights of the designed input. The initial state is known.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxos4
from experiments.monte_carlo import Column, Row, check_names, print_rows, product, study
from experiments.shared import DT, SPAN, Count, Out, Seed, fit_noisy, scores, standard_problem
from jaxos4.design.rotor_speeds import drawn, fly_finely
from jaxos4.models import MODELS

WIDTHS = {"default": 1.0, "airframe": 1e-3}  # of brackets, in default half-widths


def main(
    models: list[str] = ("published", "corrected"),
    channels: list[str] = ("all", "rates"),
    widths: list[str] = ("default", "airframe"),
    flights: Count = 256,
    duration: float = 5.0,
    seed: Seed = 0,
    out: Out = None,
) -> None:
    """Measure what designed inputs gain."""
    check_names("models", models, MODELS)
    check_names("widths", widths, WIDTHS)

    def row_of(model: str, channels: str, vehicles: str) -> Row:
        subject, width = MODELS[model](jaxos4.OS4), WIDTHS[vehicles]
        bracket = jaxos4.Bracket.around(subject.alpha, width * np.asarray(subject.half_width))
        task = {"bracket": bracket, "duration": duration, "dt": DT, "channels": channels, "start_is_known": True}
        found = jaxos4.design_input(subject, **task, compare=True, key=seed)
        inputs = jnp.asarray(found.designed.inputs)
        problem = standard_problem(subject, channels, omega=inputs)
        # The largest share of a limit that other vehicles from the bracket use, at a tenth of the step.
        others = drawn(bracket, jax.random.key(seed + 1000), found.task.vehicles)
        shares = found.task.envelope.shares(inputs, fly_finely(subject, others, inputs, jnp.asarray(DT)), DT)
        return {
            "gains": {key: found.gain(key) for key in found.standard},
            "bounds": found.designed.bounds.tolist(),
            "uses": found.designed.uses,
            "others": float(max(shares.values())),
            **scores(problem, fit_noisy(jaxos4.IBSS(), problem, flights, seed)[0]),
        }

    every = product(model=models, channels=channels, vehicles=widths)
    # In the default bracket of the corrected model some vehicles turn over in the standard multisine.
    trials = (trial for trial in every if trial["vehicles"] == "airframe" or trial["model"] != "corrected")
    rows = study(out, {"seed": seed, "duration": duration}, trials, row_of, rows="cases")
    columns: dict[str, Column] = {name: name for name in ("model", "channels", "vehicles")}
    for name in ("multisine", "doublet"):
        columns[f"/ {name}"] = lambda row, name=name: "{:.3g} ({})".format(*row["gains"][name])
    columns |= {"largest use": "others", **SPAN, "results": "results"}
    print_rows(f"geometric mean of the bounds, of {duration:g} s", rows, columns)
