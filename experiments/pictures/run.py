"""The pictures of the documentation, drawn from real results: `python -m experiments pictures.run docs/pictures`."""

import shutil
import tomllib
from html import escape
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import jaxos4
from experiments.real_flights import PENDULUM
from jaxos4._files import write_file
from jaxos4.estimators.solver import before_search
from jaxos4.identification.verdict import ADVICE
from jaxos4.report.identification_figures import vehicle
from jaxos4.report.matplotlib_figures import draw, drawing, rendered
from jaxos4.report.panels import style
from jaxos4.results import NINETY_FIVE

BLUE, ORANGE, INK, GREY = "#0072b2", "#d55e00", "#1b1e23", "#b9bec6"
_ON_PAPER = {"savefig.facecolor": "white", "text.parse_math": True}  # pages may be dark; powers of ten are formulas
PICTURES = ("estimate", "halving", "sweeps", "floors", "real", "page")
ROOMS = {
    "cli": "reads the arguments, calls the library, prints",
    "report": "tables, figures, HTML pages",
    "study": "many flights: specification, storage, resume",
    "identification": "one answer: noise, intervals, notes, checks",
    "recording": "usable stretches, excitation, held-out parts",
    "design": "what to fly",
    "logs": "file formats to Flight",
    "estimators": "one algorithm a file",
    "networks": "features, training, network file",
    "analysis": "Fisher information, intervals, diagnostics",
    "estimate": "what every estimator returns",
    "closed_loop": "a controller in gusts",
    "shooting": "model + flight: cost, residuals, slope",
    "bracket": "where to look",
    "noise": "sensors",
    "simulation": "Euler, RK4, diffrax",
    "models": "equations with parameters",
    "excitation": "inputs",
    "flight": "time, rotor speeds, states",
    "airframe": "mass, geometry, inertia",
}


def simulated() -> tuple[jaxos4.AbstractModel, jaxos4.ShootingProblem, jaxos4.Bracket, jaxos4.Estimate]:
    """The flight of `jaxos4 simulate --noise 1 --seed 0`, identified by IBSS."""
    model = jaxos4.PublishedOS4(jaxos4.OS4)
    omega = jaxos4.multisine(model.airframe, duration=5.0, dt=0.01)
    flight = jaxos4.simulate(model, model.alpha, omega, dt=0.01)
    noisy = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(0))
    problem = jaxos4.ShootingProblem(model, noisy, sigma=jaxos4.SENSOR_SIGMA)
    bracket = jaxos4.Bracket.default(model)
    return model, problem, bracket, jaxos4.IBSS()(problem, bracket)


def estimate_picture(model, problem, bracket, estimate) -> Figure:
    """Left: measured and simulated body rates. Right: each parameter's bracket and its 95 % interval."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.25, 1.0))
    names = list(jaxos4.STATE_NAMES)
    flown = jaxos4.simulate(model, estimate.parameters, problem.flight.omega, dt=0.01)
    for axes, name in zip(left.subplots(3, sharex=True), ("p", "q", "r"), strict=True):
        at, few = names.index(name), slice(None, None, 7)
        measured = problem.flight.time[few], problem.flight.states[few, at]
        axes.plot(*measured, "o", color=ORANGE, mfc="none", mew=0.8, ms=4, label="measured (one in seven)")
        axes.plot(flown.time[::2], flown.states[::2, at], color=BLUE, lw=1.2, label="simulated with the estimate")
        axes.set_ylabel(f"{name} [rad/s]")
    axes.set_xlabel("time [s]")
    left.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)

    truth, width = np.asarray(model.alpha), np.asarray(bracket.half_width)
    error = 100 * (np.asarray(estimate.parameters) - truth) / width
    reach = 100 * np.asarray(estimate.half_width(0.95)) / width
    rows, axes = np.arange(len(truth)), right.subplots()
    axes.barh(rows, 200, left=-100, height=0.62, color=GREY, alpha=0.5, label="bracket before")
    axes.barh(rows, 2 * reach, left=error - reach, height=0.62, color=BLUE, label="95 % interval after")
    axes.axvline(0, color=INK, lw=0.9, ls="--")
    axes.set_xscale("symlog", linthresh=1.0)
    ticks = (-100, -10, -1, 0, 1, 10, 100)
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.set_yticks(rows, model.parameter_names)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("error [% of the bracket's half-width]")
    right.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def halving_picture(problem, estimate) -> Figure:
    """A search interval of alpha3, halved six times by the slope's sign; the other parameters stay at the estimate."""
    rates = problem.restrict("rates")
    cost = eqx.filter_jit(jax.value_and_grad(lambda value: rates.cost(estimate.parameters.at[2].set(value))))
    low, high = 75.0, 180.0
    grid = np.linspace(low, high, 81)
    costs = [float(cost(value)[0]) for value in grid]
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    above, below = figure.subplots(2, sharex=True, height_ratios=(1.0, 1.15))
    above.plot(grid, costs, color=INK, lw=1.3)
    above.set_yscale("log")
    above.set_ylabel("cost of a shot")
    for number in range(7):
        middle = (low + high) / 2
        value, slope = (float(x) for x in cost(middle))
        below.barh(number, high - low, left=low, height=0.55, color=BLUE, alpha=0.35)
        below.plot(middle, number, ">" if slope < 0 else "<", color=ORANGE, ms=7)
        above.plot(middle, value, ">" if slope < 0 else "<", color=ORANGE, ms=7)
        low, high = (middle, high) if slope < 0 else (low, middle)
    below.set_xlim(grid[0] - 3, grid[-1] + 3)
    below.set_yticks(range(7))
    below.invert_yaxis()
    below.set_ylabel("halvings")
    below.set_xlabel("alpha3 [1/(kg m²)]")
    return figure


def sweep_widths(problem: jaxos4.ShootingProblem) -> np.ndarray:
    """Half-widths of the search intervals as each sweep of IBSS opens them: of each parameter, sweep by sweep."""
    solver, count, widths = jaxos4.IBSS(), problem.unknowns.count, []
    stages = problem.stages(solver.shares)
    found = before_search(problem)
    for number in range(stages.number):
        stage = stages.at(number, found.unknowns)
        stage = stage._replace(local_model=jax.jit(stage.local_model))
        state = solver.init(stage, found)
        while not solver.terminate(stage, state):
            opened = (state.intervals.highest - state.intervals.lowest)[0] / 2
            along = jnp.where(stage.searched[:count, None], state.directions.basis[0, :count], 0.0)
            if opened.any():  # the first shot of a stage needs no interval
                widths.append(np.asarray(jnp.abs(along * opened).sum(axis=1)))
            state = solver.step(stage, state)
        found = solver.postprocess(stage, state, found)._replace(done=jnp.zeros((), dtype=bool))
    return np.array(widths)


def sweeps_picture(model, problem, bracket, estimate) -> Figure:
    """Half-widths of the bracket, then of the search intervals by sweep, in standard deviations of the estimate."""
    opened = sweep_widths(problem.within(bracket))
    widths = np.concatenate([np.asarray(bracket.half_width)[None], opened]) / np.asarray(estimate.std)
    figure = Figure(figsize=(7.0, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.axhline(1.0, color=INK, lw=0.9, ls="--")
    for place, name in enumerate(model.parameter_names):
        axes.plot(widths[:, place], f"{'os^Dv*PX'[place]}-", lw=1.1, ms=5, label=name)
    axes.set_yscale("log")
    axes.set_xticks(range(len(widths)), ["given", *map(str, range(1, len(widths)))])
    axes.set_xlabel("sweep")
    axes.set_ylabel("half-width of the interval\n[standard deviations of the estimate]")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def floors_picture(pyproject: Path) -> str:
    """The floors of the package as SVG, from the layers that import-linter checks."""
    contract = tomllib.loads(pyproject.read_text())["tool"]["importlinter"]["contracts"][0]
    width, height, gap = 860, 44, 8
    floors = [[room.strip() for room in layer.split("|")] for layer in contract["layers"]]
    total = len(floors) * (height + gap) + gap
    shapes = []
    for place, rooms in enumerate(floors):
        own = (width - 60 - gap * (len(rooms) + 1)) / len(rooms)
        for number, room in enumerate(rooms):
            x, y = gap + number * (own + gap), gap + place * (height + gap)
            text = escape(ROOMS.get(room, ""))
            name = escape(room)
            shapes.append(
                f'<rect x="{x:.0f}" y="{y}" width="{own:.0f}" height="{height}" rx="6" class="room"/>'
                f'<text x="{x + own / 2:.0f}" y="{y + (19 if text else 27)}" class="name">{name}</text>'
                f'<text x="{x + own / 2:.0f}" y="{y + 35}" class="does">{text}</text>'
            )
    arrow = width - 38
    style = (
        f".room{{fill:#eef4f9;stroke:{BLUE};stroke-width:1.2}} text{{font-family:sans-serif;text-anchor:middle}}"
        f".name{{font-size:14px;font-weight:bold;fill:{INK}}} .does{{font-size:11.5px;fill:#444b55}}"
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {total}" role="img">'
        f"<title>The floors of jaxos4</title><style>{style}</style>"
        f'<rect width="{width}" height="{total}" fill="#ffffff"/>\n' + "\n".join(shapes) + "\n"
        f'<path d="M{arrow} {gap} V{total - 14} m-6 -10 l6 10 l6 -10" fill="none" stroke="{ORANGE}" stroke-width="2"/>'
        f'<text transform="translate({arrow + 22} {total / 2}) rotate(90)" class="does">'
        "a file imports only from floors below its own</text></svg>\n"
    )


def real_picture(found: jaxos4.Identification) -> Figure:
    """A real flight of the CineRat: the vehicle, rates that were not fitted, moments of inertia with their verdicts."""
    figure = Figure(figsize=(9.6, 3.0), layout="constrained")
    above, rates, bars = figure.subfigures(1, 3, width_ratios=(0.75, 1.35, 1.3))
    axes = above.subplots()
    draw(vehicle(found.airframe, {}, (), style(0)).panels[0], axes)
    axes.set(title="3-inch quadrotor, 43 s")
    axes.axis("off")
    ahead = found.predictions
    first = found.provenance.sample_time * ahead.start[: ahead.breaks[0]]  # the part that was not fitted first [s]
    for axes, rate in zip(rates.subplots(2, sharex=True), "pq", strict=True):
        found.plot.rates(rate, horizon=0.1, ax=axes).get_legend().remove()
        axes.set_xlim(first[0], first[-1])
        axes.label_outer()
    rates.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    axes = bars.subplots()
    for row, (name, pendulum) in enumerate(PENDULUM.items()):
        value, status = found.rigid_body.constants[name], found.verdicts[name].status
        spans = {"jaxos4, 95 %": (value.estimate, NINETY_FIVE * value.std, BLUE)}
        spans |= {"pendulum, ± 7 %": (pendulum, 0.07 * pendulum, ORANGE)}
        for place, (label, (middle, half, color)) in enumerate(spans.items()):
            pale = 0.35 if color == BLUE and not status.startswith("identified") else 1.0
            span, y = 1e4 * np.array([middle - half, middle + half]), row + 0.2 * place - 0.1
            axes.plot(span, [y, y], color=color, alpha=pale, lw=4, label=label if row == 0 else None)
        axes.text(0.02, row + 0.2, ADVICE[status], va="top", color=BLUE, transform=axes.get_yaxis_transform())
    axes.set(xlabel="moment of inertia [1e-4 kg m²]", ylim=(2.6, -0.4))
    axes.set_yticks(range(len(PENDULUM)), PENDULUM)
    bars.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def page_picture(page: Path, picture: Path) -> None:
    """The top of a page of `jaxos4 estimate --report` as a browser shows it, as PNG."""
    from playwright.sync_api import sync_playwright  # brings no browser, and only this picture needs it

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        sight = browser.new_page(viewport={"width": 1280, "height": 640})
        sight.goto(page.resolve().as_uri())
        sight.screenshot(path=picture)


def main(
    out: Path,
    only: list[str] | None = None,
    pyproject: Path = Path("pyproject.toml"),
    result: Path | None = None,
    page: Path | None = None,
) -> None:
    """Draws the pictures of the documentation.

    - `out`: The folder to write to. `only`: Some of estimate, halving, sweeps, floors, real, page; all by default.
    - `pyproject`: Where the floors are written.
    - `result`: For `real`: README's result of the CineRat.
    - `page`: For `page`: README's page of the simulated flight.
    """
    chosen = only or list(PICTURES)
    for name, needed, given in (("real", "--result", result), ("page", "--page", page)):
        if name in chosen and given is None:
            raise SystemExit(f"{needed}: give the file for the picture `{name}`, or choose other pictures by --only.")
    out.mkdir(parents=True, exist_ok=True)
    if "floors" in chosen:
        (out / "floors.svg").write_text(floors_picture(pyproject))
    drawings = {}
    if page is not None and "page" in chosen:
        page_picture(page, out / "page.png")
    if result is not None and "real" in chosen:
        drawings["real"] = lambda: real_picture(jaxos4.read_result(result))
    if {"estimate", "halving", "sweeps"} & set(chosen):
        model, problem, bracket, estimate = simulated()
        drawings |= {
            "estimate": lambda: estimate_picture(model, problem, bracket, estimate),
            "halving": lambda: halving_picture(problem, estimate),
            "sweeps": lambda: sweeps_picture(model, problem, bracket, estimate),
        }
    for name, draw_picture in drawings.items():
        if name in chosen:
            with drawing(), mpl.rc_context(_ON_PAPER):
                write_file(out / f"{name}.svg", rendered(draw_picture(), "svg"))
