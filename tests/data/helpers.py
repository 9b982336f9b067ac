"""The standard flight, and an independent copy of the equations of motion in NumPy, from the printed equations."""

import contextlib
import functools
import itertools
import os
import pathlib
import re
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxos4
from jaxos4.models.state import CASCADE_ORDER
from jaxos4.recording import stretches

ROOT = pathlib.Path(__file__).resolve().parents[2]
# The constants of the OS4 thesis, typed again instead of imported.
OS4 = {"m": 0.650, "L": 0.23, "b": 3.13e-5, "d": 7.5e-7, "g": 9.81}
DT = 0.01
FULL_THRUST, FULL_SPEED = 0.15, 2500.0  # of one rotor of the Crazyflie [N, rad/s]
CRAZYFLIE = jaxos4.Airframe(
    mass=0.027,
    inertia=(1.66e-5, 1.7e-5, 2.9e-5),
    rotor_positions=[(0.028, -0.028), (-0.028, -0.028), (-0.028, 0.028), (0.028, 0.028)],
    rotor_spins=(1.0, -1.0, 1.0, -1.0),
    thrust_coefficient=FULL_THRUST / FULL_SPEED**2,
    drag_coefficient=0.005 * FULL_THRUST / FULL_SPEED**2,
    rotor_inertia=2e-8,
    max_rotor_speed=FULL_SPEED,
)
CRAZYFLIE_TOML = """
mass = 0.027
inertia = [1.66e-5, 1.7e-5, 2.9e-5]
rotor_positions = [[0.028, -0.028], [-0.028, -0.028], [-0.028, 0.028], [0.028, 0.028]]
thrust_coefficient = 2.4e-8
drag_coefficient = 1.2e-10
rotor_inertia = 2e-8
max_rotor_speed = 2500.0
"""


@contextlib.contextmanager
def compiled_programs():
    """The names of the programs that are compiled, or read from the persistent cache, inside the block."""
    names, inside = [], True

    def record(event, seconds, **details):
        if inside and event == "/jax/core/compile/backend_compile_duration":
            names.append(details.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(record)
    try:
        yield names
    finally:
        inside = False


@functools.cache
def standard_flight(model_class=jaxos4.PublishedOS4, duration=5.0):
    """The standard flight without noise. One of less than 5 s is its first part, so that it needs no new program."""
    model = model_class(jaxos4.OS4)
    if duration < 5.0:
        flight, samples = standard_flight(model_class), round(duration / DT) + 1
        return jaxos4.Flight(*(np.asarray(x)[:samples] for x in (flight.time, flight.omega, flight.states)))
    omega = jaxos4.multisine(model.airframe, duration=duration, dt=DT)
    return jaxos4.simulate(model, model.alpha, omega, dt=DT)


def standard_problem(
    model_class=jaxos4.PublishedOS4, channels="all", *, free=False, states=None, duration=5.0, method="euler"
):
    """The problem of the standard flight without noise, or with other measured `states`."""
    flight = standard_flight(model_class, duration)
    start = None if free else flight.states[0]
    if states is not None:
        flight = eqx.tree_at(lambda f: f.states, flight, states)
    arguments = {"channels": channels, "sigma": jaxos4.SENSOR_SIGMA, "initial_state": start, "method": method}
    return jaxos4.ShootingProblem(model_class(jaxos4.OS4), flight, **arguments)


def doublet_problem(*, only_roll, free=False):
    """The rates of a noisy flight of doublets, and a bracket whose center is off."""
    model = jaxos4.PublishedOS4(jaxos4.OS4)
    omega = jaxos4.doublet(model.airframe, duration=5.0, dt=DT)
    if only_roll:  # an axis has 1.5 s
        omega = jnp.concatenate([omega[:150], omega[:150], omega[:150], omega[450:]])
    flight = jaxos4.simulate(model, model.alpha, omega, dt=DT)
    noisy = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(0))
    start = None if free else flight.states[0]
    problem = jaxos4.ShootingProblem(model, noisy, sigma=jaxos4.SENSOR_SIGMA, initial_state=start, channels="rates")
    return problem, jaxos4.Bracket.around(model.alpha + 0.4 * model.half_width, model.half_width)


# As one program, where each operation would be one.


@eqx.filter_jit
def forcing_of(model, inputs, parameters):
    return model.forcing(inputs, parameters)


@eqx.filter_jit
def first_state(problem):
    return problem.first_state()[0]


@eqx.filter_jit
def local_model(problem, parameters, starts):
    return problem.local_model(problem.join(parameters, starts))


BLOCK = 64  # draws of one call, whatever the number wanted: one program


def noisy_states(count, model_class=jaxos4.PublishedOS4, *, seed=0, scale=1.0, duration=5.0):
    """Noisy states of `count` standard flights. Flight i draws from `fold_in(key, i)`, the same for all durations."""
    flight, noise = standard_flight(model_class, max(duration, 5.0)), jaxos4.WhiteNoise(scale * jaxos4.SENSOR_SIGMA)
    samples, key = round(duration / DT) + 1, jax.random.key(seed)
    blocks = [measured(noise, flight, folded(key, first + np.arange(BLOCK))) for first in range(0, count, BLOCK)]
    return jnp.asarray(np.concatenate([np.asarray(block)[:, :samples] for block in blocks])[:count])


@jax.jit
def folded(key, numbers):
    """`fold_in(key, i)` for each number i."""
    return jax.vmap(lambda i: jax.random.fold_in(key, i))(numbers)


@eqx.filter_jit
def measured(noise, flight, keys):
    """Noisy states of a flight for each key. In a loop, because a batch takes XLA seconds to compile."""
    return jax.lax.map(lambda key: noise(flight, key=key).states, keys)


def random_starts(model, count, *, seed=0, share=0.8):
    """Starts of searches: uniform within `share` of the default bracket."""
    around = jaxos4.Bracket.default(model)
    draws = uniform(jax.random.key(seed), -(-count // BLOCK) * BLOCK)
    return jnp.asarray(around.center + share * np.asarray(draws)[:count] * around.half_width)


@functools.partial(jax.jit, static_argnums=1)
def uniform(key, count):
    """Numbers from -1 to 1, eight in each row."""
    return jax.random.uniform(key, (count, 8), minval=-1, maxval=1)


def published_derivative(state, omega, alpha, constants=OS4):
    """dX/dt by Eqs. (1)-(13), state in the order of Eq. (14); leading axes are a batch."""
    _, vx, _, vy, _, vz, phi, p, theta, q, psi, r = np.moveaxis(np.asarray(state), -1, 0)
    w1, w2, w3, w4 = np.moveaxis(np.asarray(omega, dtype=float), -1, 0)
    a1, a2, a3, a4, a5, a6, a7, a8 = np.moveaxis(np.asarray(alpha), -1, 0)
    arm, b, d, m, g = (constants[name] for name in ("L", "b", "d", "m", "g"))
    roll = arm * b * (w4**2 - w2**2)
    pitch = arm * b * (w3**2 - w1**2)
    yaw = d * (w4**2 + w2**2 - w3**2 - w1**2)
    thrust = b * (w4**2 + w2**2 + w3**2 + w1**2)
    return np.stack(
        [
            vx,
            (np.sin(phi) * np.cos(psi) - np.sin(psi) * np.sin(theta) * np.cos(phi)) * thrust / m,
            vy,
            (-np.sin(psi) * np.sin(phi) - np.sin(theta) * np.cos(phi) * np.cos(psi)) * thrust / m,
            vz,
            -g + np.cos(theta) * np.cos(phi) * thrust / m,
            p + np.tan(theta) * (q * np.sin(phi) + r * np.cos(phi)),
            q * r * a1 - a2 * q + a3 * roll,
            q * np.cos(phi) - r * np.sin(phi),
            p * r * a4 + r * a5 + a6 * pitch,
            (q * np.sin(phi) + r * np.cos(phi)) / np.cos(theta),
            p * q * a7 + a8 * yaw,
        ],
        axis=-1,
    )


def corrected_derivative(state, omega, alpha, constants=OS4):
    """dX/dt of the corrected model: starts from the printed equations and replaces those that it corrects."""
    _, _, _, _, _, _, phi, p, theta, q, psi, r = np.moveaxis(np.asarray(state), -1, 0)
    w1, w2, w3, w4 = np.moveaxis(np.asarray(omega, dtype=float), -1, 0)
    a1, a2, a3, a4, a5, a6, a7, a8 = np.moveaxis(np.asarray(alpha), -1, 0)
    arm, b, d, m, g = (constants[name] for name in ("L", "b", "d", "m", "g"))
    residual_speed = w1 + w3 - w2 - w4
    thrust = b * (w1**2 + w2**2 + w3**2 + w4**2) / m
    derivative = published_derivative(state, omega, alpha, constants)
    derivative[..., 1] = (np.cos(psi) * np.sin(theta) * np.cos(phi) + np.sin(psi) * np.sin(phi)) * thrust
    derivative[..., 3] = (np.sin(psi) * np.sin(theta) * np.cos(phi) - np.cos(psi) * np.sin(phi)) * thrust
    derivative[..., 5] = np.cos(theta) * np.cos(phi) * thrust - g
    derivative[..., 7] = a1 * q * r - a2 * residual_speed * q + a3 * arm * b * (w4**2 - w2**2)
    derivative[..., 9] = a4 * p * r + a5 * residual_speed * p + a6 * arm * b * (w3**2 - w1**2)
    derivative[..., 11] = a7 * p * q + a8 * d * (w2**2 + w4**2 - w1**2 - w3**2)
    return derivative


REFERENCES = {jaxos4.PublishedOS4: published_derivative, jaxos4.CorrectedOS4: corrected_derivative}


def euler_trajectory(derivative, alpha, omega, *, dt=DT, start=None, constants=OS4):
    """x_{k+1} = x_k + T f(x_k, u_k), one row for each sample."""
    states, dt = [np.zeros(12) if start is None else np.asarray(start)], float(dt)
    for row in np.asarray(omega)[:-1]:
        states.append(states[-1] + dt * derivative(states[-1], row, alpha, constants))
    return np.stack(states)


def first_samples(problem):
    """The first sample of each window, and at the end the number of samples."""
    return [k * len(problem.flight.time) // problem.windows for k in range(problem.windows + 1)]


def numpy_residuals(problem, parameters, starts):
    """W (y - x) by the NumPy equations, each window from its own start; NaN where nothing was measured.

    Leading axes of parameters and starts are a batch.
    """
    flight, derivative = problem.flight, REFERENCES[type(problem.model)]
    order, ends = CASCADE_ORDER[: problem.size], first_samples(problem)
    first = np.zeros((*np.shape(starts)[:-1], problem.windows, 12), dtype=np.asarray(starts).dtype)
    first[..., order] = np.reshape(starts, (*np.shape(starts)[:-1], problem.windows, -1))
    states = np.concatenate(
        [
            euler_trajectory(derivative, parameters, flight.omega[begin:end], start=first[..., w, :], dt=flight.dt)
            for w, (begin, end) in enumerate(itertools.pairwise(ends))
        ]
    )
    return ((np.asarray(flight.states) - np.moveaxis(states, 0, -2)) / np.asarray(problem.sigma))[..., order]


def numpy_jacobian(problem, parameters, starts):
    """Derivatives of `numpy_residuals` in the parameters and the starts, by complex steps: to the last digits."""
    point, step = np.concatenate([parameters, starts]), 1e-30
    moved = point + 1j * step * np.eye(point.size)
    slopes = numpy_residuals(problem, *np.split(moved, [8], axis=1)).imag / step
    if problem.initial_state is not None:
        slopes[:, 0] = 0  # a known first sample is no data
    return slopes.reshape(point.size, -1).T


def inverse_square(slopes):
    """(J^T J)^-1, whatever the units of the columns."""
    scale = np.linalg.norm(slopes, axis=0)
    return np.linalg.inv((slopes / scale).T @ (slopes / scale)) / np.outer(scale, scale)


def same(one, other):
    """Whether two trees of arrays agree: structure, types, and every number, NaN too. Compiles no program."""
    leaves, others = ([np.asarray(x) for x in jax.tree.leaves(tree)] for tree in (one, other))
    return jax.tree.structure(one) == jax.tree.structure(other) and all(
        x.dtype == y.dtype and np.array_equal(x, y, equal_nan=x.dtype.kind == "f")
        for x, y in zip(leaves, others, strict=True)
    )


def refused(result: tuple[int, str, str], *fragments: str) -> None:
    """A command ended with exit code 2 and one line on stderr that contains the fragments."""
    code, _, err = result
    assert code == 2, result
    assert err.count("\n") == 1, err
    for fragment in fragments:
        assert fragment in err


def done(result: tuple[int, str, str]) -> str:
    """A command ended with exit code 0 and nothing on stderr. Returns what it printed."""
    code, out, err = result
    assert (code, err) == (0, "")
    return out


def blocks(page: pathlib.Path, language: str = "") -> list[str]:
    """The blocks of a page in this language."""
    every = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return [block for name, block in every if name == language]


def documented_class(page: str) -> str:
    """The class that a page of `docs/extend` shows, as a file of its own has it."""
    text = (ROOT / "docs" / "extend" / page).read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?class .*?)```", text, flags=re.DOTALL)
    return code.replace("from ..", "from jaxos4.")


COMMAND = "import sys; sys.argv[0] = 'jaxos4'; from jaxos4.cli import main; main()"
PROGRESS = r"jaxos4: .+, \d+ s"  # a line on stderr of a command that takes long
# Runs each line of its arguments. Prints its code, what it printed, and the packages that are loaded after it.
EACH = """
import contextlib, io, json, sys
from jaxos4.cli import main
for line in sys.argv[1:]:
    sys.argv, printed = ["jaxos4", *line.split()], io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main()
        except SystemExit as stop:
            code = stop.code or 0
    packages = sorted({name.split(".")[0] for name in sys.modules})
    sys.__stdout__.write(json.dumps([line, code, printed.getvalue(), packages]) + "\\n")
"""


def environment(**changes: str) -> dict[str, str]:
    """The environment of another process: without the tests' cache of compiled programs and flags of XLA."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "JAXOS4_", "XLA_"))}
    ours = {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]]), "JAX_PLATFORMS": "cpu"}
    return inherited | ours | changes


def start(*arguments: str, code: str = COMMAND, cwd=None, **changes: str) -> subprocess.CompletedProcess[str]:
    """Runs Python code in another process."""
    process = [sys.executable, "-c", code, *arguments]
    return subprocess.run(process, env=environment(**changes), cwd=cwd, capture_output=True, text=True, timeout=300)


def how_we_compile(devices: int = 1) -> dict[str, str]:
    """For the environment of another process: this process's cache, flags and level of optimisation."""
    settings = ("jax_compilation_cache_dir", "jax_disable_most_optimizations")
    ours = {name.upper(): str(jax.config.values[name]) for name in settings} | {"XLA_FLAGS": os.environ["XLA_FLAGS"]}
    return ours | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05", "JAX_NUM_CPU_DEVICES": str(devices)}


def usable_stretches(flight, airframe=None):
    return tuple(stretch for stretch in stretches(flight, airframe) if not stretch.reason)
