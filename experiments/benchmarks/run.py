"""How fast are the methods of this package, against the tools that others use?

All contenders identify the same noisy standard flights, on all channels, from the same starts, in double precision. A
contender is timed only if it reaches the same optimum. Each runs in a process of its own. The laps of all contenders
alternate, so that each ratio compares laps under the same load of the machine.
"""

from typing import Any

import numpy as np

import jaxos4
from experiments.benchmarks.case import ALL, RATES, Case, costs, trajectories
from experiments.benchmarks.contenders import FITS, NETWORKS, QUICK, SHOTS, Contender
from experiments.benchmarks.opponents.ours import problem_of
from experiments.benchmarks.race import line_up, race, ratios
from experiments.benchmarks.tables import print_report
from experiments.monte_carlo import machine, write_report
from experiments.shared import Report, Seed
from jaxos4.flight import Inputs

DT = 0.01
SAME_COST = 0.01  # an error of a seventh of a standard deviation costs as much
REACHED = 0.99  # the share of flights in which a contender must reach the least cost, to be timed
CENTRE = 0.8  # starts lie within this share of the half-widths around the truth
NEAR = 0.1  # the same for shots, so that no trajectory diverges
MANY = 10_000  # flights; more are fitted in one lap, because it is long
SHOT_TOLERANCE = 1e-6  # relative: costs of one shot by two programs


def make_case(flights: int, steps: int, *, known: bool = True, share: float = CENTRE, seed: int = 0) -> Case:
    """Noisy standard flights; the first flights of a larger case are those of a smaller one."""
    model = jaxos4.PublishedOS4(jaxos4.OS4)
    omega = np.asarray(jaxos4.multisine(model.airframe, duration=steps * DT, dt=DT))
    forcing = model.forcing(Inputs(omega, np.asarray(DT)), model.alpha)
    torques_and_thrust = forcing.roll, forcing.pitch, forcing.yaw, forcing.mean_specific_thrust
    columns = np.stack([np.asarray(x) for x in torques_and_thrust], axis=1)
    truth, half_width = np.asarray(model.alpha), np.asarray(jaxos4.DEFAULT_HALF_WIDTH)
    sigma = np.asarray(jaxos4.SENSOR_SIGMA)
    blank = Case(
        forcing=columns[:-1],
        omega=omega,
        measured=np.zeros((flights, steps + 1, 12)),
        starts=np.zeros((flights, 8)),
        half_width=half_width,
        sigma=sigma,
        truth=truth,
        dt=DT,
        gravity=float(model.airframe.gravity),
        known=known,
    )
    exact = trajectories(blank, truth[None], np.zeros((1, 12)))[0]
    for which in range(flights):
        generator = np.random.default_rng([seed, which])
        blank.measured[which] = exact + sigma * generator.standard_normal(exact.shape)
        blank.starts[which] = truth + share * half_width * generator.uniform(-1, 1, 8)
    return blank


def reached(case: Case, answers: dict[str, dict[str, np.ndarray]]) -> dict[str, float]:
    """The share of flights in which each one's cost is the least that anyone found."""
    found, least = {}, np.full(case.flights, np.inf)
    for name, answer in answers.items():
        count = len(answer["parameters"])
        found[name] = costs(case.first(count), answer["parameters"], answer["first"])
        least[:count] = np.fmin(least[:count], found[name])
    return {name: float(np.mean(values - least[: len(values)] < SAME_COST)) for name, values in found.items()}


def fits(contenders: dict[str, Contender], case: Case, alone: int, repeats: int, skipped: list[str]) -> dict[str, Any]:
    """Rows of all contenders that reach the least cost that anyone found for each flight."""
    racers = line_up(contenders, case, alone, skipped)
    shares = reached(case, {name: racer.answer for name, racer in racers.items()})
    ready = {name: racer for name, racer in racers.items() if shares[name] >= REACHED}
    rows: dict[str, Any] = {name: {"flights": r.flights} for name, r in racers.items()} | race(ready, repeats)
    for name in set(racers) - set(ready):
        racers[name].stop()
    for name, row in rows.items():
        row["reached"] = shares[name]
    ratios(rows, contenders)
    return rows


def shots(contenders: dict[str, Contender], case: Case, repeats: int, skipped: list[str]) -> dict[str, Any]:
    """Rows of all contenders whose costs are those of plain NumPy."""
    racers = line_up(contenders, case, case.flights, skipped)
    first = np.zeros((case.flights, 12))
    for name, racer in list(racers.items()):
        if "costs" not in racer.answer:
            continue
        options = contenders[name].options
        compared = case.first(1) if options.get("same_flight") else case
        expected = costs(compared, case.starts, first, RATES if options.get("channels") == "rates" else ALL)
        if not np.allclose(racer.answer["costs"], expected, rtol=SHOT_TOLERANCE):
            skipped.append(f"{name}: its costs are not those of NumPy")
            racers.pop(name).stop()
    rows = race(racers, repeats)
    ratios(rows, contenders)
    for row in rows.values():
        row["steps_per_second"] = len(case.forcing) / row["median_seconds"]
    return rows


def growth(
    estimator: str, flights: list[int], steps: list[int], parameters: list[int], repeats: int, skipped: list[str]
) -> list[dict[str, Any]]:
    """Time and memory of one method as the number of flights, steps or unknowns grows.

    Growth in steps: rates alone. The most unknowns are the eight parameters and a free initial state.
    """
    plan: list[tuple[str, int, dict[str, Any], dict[str, Any]]] = []  # axis, size, of the case, of the method
    plan += [("flights", count, {"flights": count, "steps": 500}, {}) for count in flights]
    plan += [("steps", count, {"flights": 10, "steps": count}, {"channels": "rates"}) for count in steps]
    if parameters:
        same = {"flights": 100, "steps": 500}
        plan += [("unknowns", count, same, {"parameters": count}) for count in parameters]
        plan += [("unknowns", 20, same | {"known": False}, {})]
    rows = []
    for axis, size, flown, options in plan:
        contender = Contender("ours:fit", options={"estimator": estimator, **options})
        racers = line_up({f"{axis} {size}": contender}, make_case(**flown), 1, skipped)
        found = race(racers, repeats if flown["flights"] <= MANY else 1)
        rows += [{"axis": axis, "size": size, **row} for row in found.values()]
    return rows


def networks(steps: int, simulations: int, flights: int, skipped: list[str]) -> dict[str, Any]:
    """Time of training, and root mean square errors in Cramer-Rao bounds of the rates."""
    case = make_case(flights, 500)
    bound = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(problem_of(case, "rates"), case.truth)))
    budgets = ({"steps": steps}, {"simulations": simulations})
    pairs = zip(NETWORKS.items(), budgets, strict=True)
    contenders = {name: c._replace(options=budget) for (name, c), budget in pairs if any(budget.values())}
    racers = line_up(contenders, case, flights, skipped)
    answers = {name: racer.answer for name, racer in racers.items()}
    rows = race(racers, 1)
    for name, row in rows.items():
        error = (answers[name]["parameters"] - case.truth) / bound
        row["rmse_in_bounds"] = np.sqrt(np.mean(np.square(error), axis=0)).tolist()
        row["training_seconds"] = float(answers[name]["training_seconds"])
    return rows


def roofline(shot_rows: dict[str, Any], skipped: list[str]) -> dict[str, Any]:
    """The peak of the machine, the operations of one step, and the share of the peak that our shots reach."""
    racers = line_up({"roofline": Contender("ours:roofline")}, make_case(1, 10), 1, skipped)
    found: dict[str, Any] = {}
    for racer in racers.values():
        found = {name: float(value) for name, value in racer.answer.items()}
        racer.stop()
    if found and "jaxos4" in shot_rows:
        reached = shot_rows["jaxos4"]["steps_per_second"] * found["operations_per_step"]
        found |= {"operations_per_second": reached, "share": reached / found["peak_operations_per_second"]}
    return found


def main(
    flights: int = 1000,
    alone: int = 10,
    repeats: int = 7,
    steps: int = 500,
    starts: list[str] = ("known", "free"),
    contenders: list[str] = QUICK,
    shooters: list[str] = tuple(SHOTS),
    growing: str = "output-error",
    grow_flights: list[int] = (1, 10, 100, 1000, 10_000, 100_000),
    grow_steps: list[int] = (100, 1000, 10_000, 100_000),
    grow_parameters: list[int] = (1, 2, 4, 8),
    network_steps: int = 3000,
    simulations: int = 10_000,
    seed: Seed = 0,
    out: Report = None,
) -> None:
    """Time all contenders, and print tables.

    - `flights`: Number of flights in one call. `alone`: The same for contenders that take one after another.
    - `repeats`: Number of laps. `steps`: Number of steps of a flight. `starts`: Initial states: known, free.
    - `contenders`: Names of the fits; by default the quick ones. `shooters`: Names of the shots; by default all.
    - `growing`: The estimator whose growth is measured; empty: none. `grow_flights`: Numbers of flights.
    - `grow_steps`: Numbers of steps. `grow_parameters`: Numbers of parameters.
    - `network_steps`: Steps of the network's training; 0: no networks.
    - `simulations`: Simulated flights for sbi; 0: without sbi.
    """
    skipped: list[str] = []
    report: dict[str, Any] = {
        "provenance": {
            **machine(),
            "settings": {"flights": flights, "alone": alone, "repeats": repeats, "steps": steps, "seed": seed},
        }
    }
    chosen = {name: FITS[name] for name in contenders}
    report["fits"] = {
        start: fits(chosen, make_case(flights, steps, known=start == "known", seed=seed), alone, repeats, skipped)
        for start in starts
    }
    near = make_case(flights, steps, share=NEAR, seed=seed)
    report["shots"] = shots({name: SHOTS[name] for name in shooters}, near, repeats, skipped)
    sizes = list(grow_flights), list(grow_steps), list(grow_parameters)
    report["growth"] = growth(growing, *sizes, repeats, skipped) if growing else []
    report["networks"] = networks(network_steps, simulations, min(flights, 100), skipped) if network_steps else {}
    report["roofline"] = roofline(report["shots"], skipped)
    report["skipped"] = list(dict.fromkeys(skipped))
    print_report(report)
    write_report(out, report)
