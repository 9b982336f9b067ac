"""Which effects of real flights make moments of inertia wrong, one at a time and all together?

The flights are those of `run.py`: a quadrotor as small as a Crazyflie, 20 s of random references, gusts of 5 rad/s^2.
Each case adds one effect, of the size in `EFFECTS`. In the case `all`, each flight has every effect of `MIXED`, with a
random share of its size. Clock offsets and flapping have random signs. The airframe that is given, also to the
controller, has a thrust coefficient that is 20 % wrong and moments of inertia that are 25 % wrong. The motors of
`motors` are those of a Crazyflie. The true thrust of `sag` is that at the begin of the flight; on average it is 5 %
smaller. The battery of `battery` sags under load.
"""

import functools
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxos4
from experiments.fits import WRONG_INERTIA, fit, given_airframe, print_summaries
from experiments.monte_carlo import Row, check_names, product, study
from experiments.shared import Count, Estimators, Out, Seed
from jaxos4.estimators import ESTIMATORS
from jaxos4.excitation import STANDARD_TONES
from jaxos4.flight import ANGLES

VEHICLE = jaxos4.load_airframe(Path(__file__).with_name("crazyflie.toml"))
LAG, DELAY = 0.05, 0.01
DT = 0.004  # s
# The largest references of all flights: angles [rad] and vertical acceleration [m/s^2].
LARGEST = np.array([0.3, 0.3, 0.3, 1.5])
CHUNK = 25  # flights of one call
GUST = 5.0  # [rad/s^2]
VERTICAL_TONES = (0.4, 0.8, 1.2)  # of the vertical acceleration [Hz]


class Effect(NamedTuple):
    """Settings of `Air`, `Sensors` and `ClosedLoop`, and those that cannot be mixed in one batch.

    `motor`: by how much `thrust_curve` and `motor_braking` are below 1. `fastest`: the largest speed of the rotors as a
    share of that of `VEHICLE`. `soft`: references are sines instead of steps.
    """

    air: dict = {}
    sensors: dict = {}
    loop: dict = {}
    motor: dict = {}
    fastest: float = 1.0
    log_every: int = 1
    logged: str = "commands"
    soft: bool = False


MIXED = {
    "gusts": Effect(),
    "own gyro": Effect(sensors={"controller_gyro_noise": 0.0}),
    "fast controller": Effect(log_every=4),
    "wind": Effect(air={"wind": 1.5, "drag": 0.3, "inflow": 0.6, "flapping": 4.0}),
    "vibration": Effect(sensors={"gyro_vibration": 0.05, "force_vibration": 0.5}),
    "filters": Effect(sensors={"gyro_filter": 0.002, "force_filter": 0.005}),
    "rotor speeds": Effect(sensors={"speed_noise": 3.0, "speed_step": 2.0}, logged="speeds"),
    "clock": Effect(sensors={"clock_offset": 0.004}),
    "dropouts": Effect(sensors={"dropouts": 0.03}),
    "bad samples": Effect(sensors={"bad_samples": 5.0}),
    "motors": Effect(motor={"thrust_curve": 0.12, "motor_braking": 0.65}),
    "sag": Effect(loop={"sag": 0.1}),
    "saturation": Effect(fastest=0.78),
}
EFFECTS = MIXED | {
    "battery": Effect(loop={"load_sag": 0.06}),
    "filtered gyro": Effect(sensors={"gyro_filter": 0.0016, "gyro_delay": 0.0015}),
    "soft": Effect(soft=True),
    "soft, fast controller": Effect(soft=True, log_every=4),
}
ALL = "all"
_SIGNED = ("clock_offset", "flapping")


def effect_of(kind: str, random: np.random.Generator) -> Effect:
    """The effect of one flight."""
    single = kind != ALL
    every = [EFFECTS[kind]] if single else list(MIXED.values())

    def drawn(settings: dict) -> dict:
        shares = {name: 1.0 if single else random.uniform() for name in settings}
        signs = {name: random.choice([-1, 1]) if name in _SIGNED else 1 for name in settings}
        return {name: size * shares[name] * signs[name] for name, size in settings.items()}

    air, sensors, loop, motor = (
        drawn({k: v for e in every for k, v in getattr(e, part).items()})
        for part in ("air", "sensors", "loop", "motor")
    )
    if not single:
        # Half of the controllers answer the log.
        sensors["controller_gyro_noise"] = 0.02 * random.uniform() if random.uniform() < 0.5 else None
    fastest = min(e.fastest for e in every)
    fastest = fastest if single else 1 - random.uniform() * (1 - fastest)
    fixed = max(e.log_every for e in every), every[0].logged, every[0].soft
    return Effect(air, sensors, loop, motor, fastest, *fixed)


def turned_over(flight: jaxos4.Flight) -> bool:
    """True if the gusts threw the vehicle on its side: then it is lost, and nobody has its log."""
    tilt = np.asarray(flight.states)[:, ANGLES[:2]]
    return bool(flight.result != jaxos4.RESULTS.successful) or bool((np.abs(tilt) > np.pi / 2).any())


def stacked(modules: list) -> object:
    """Modules of equal shapes as one batch."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *modules)


def flights_of(
    kind: str,
    flights: int,
    duration: float,
    seed: int,
    gust: float = GUST,
    *,
    wrong: float = WRONG_INERTIA,
    references: np.ndarray | None = None,
) -> list[jaxos4.Flight | None]:
    """The flights of a case, in batches of `CHUNK`; `None`: the vehicle is lost.

    `wrong`: error of the moments of inertia that the controller knows, as a share. `references`: of all flights; by
    default random, other ones for each flight.
    """
    loops, keys = [], []
    for i in range(flights):
        effect = effect_of(kind, np.random.default_rng([seed, i]))
        vehicle = eqx.tree_at(lambda a: a.max_rotor_speed, VEHICLE, VEHICLE.max_rotor_speed * effect.fastest)
        settings = {"gust": gust, "rotor_lag": LAG, "rotor_delay": DELAY, **effect.loop}
        settings |= {name: 1 - below for name, below in effect.motor.items()}
        loop = jaxos4.ClosedLoop(
            vehicle,
            air=jaxos4.Air(**effect.air),
            sensors=jaxos4.Sensors(**effect.sensors),
            controller_inertia=given_airframe(vehicle, i, inertia=wrong).inertia,
            **{"log_every": effect.log_every, "logged": effect.logged, **settings},
        )
        loops.append(loop)
        keys.append(jax.random.fold_in(jax.random.key(seed), i))
    flown: list[jaxos4.Flight | None] = []
    for first in range(0, flights, CHUNK):
        some = slice(first, first + CHUNK)
        soft = kind != ALL and EFFECTS[kind].soft
        batch = _fly(stacked(loops[some]), jnp.stack(keys[some]), duration, references, soft=soft)
        for k in range(len(keys[some])):
            flight = jax.tree.map(lambda x, k=k: np.asarray(x)[k], batch)
            flown.append(None if turned_over(flight) else flight)
    return flown


def sines(*, duration: float, dt: float, key: jax.Array) -> jaxos4.excitation.References:
    """References of a soft flight: the tones of the standard multisine, with frequencies and phases of the flight."""
    tones = np.array([*STANDARD_TONES, VERTICAL_TONES])
    spread, phases = jax.random.uniform(key, (2, *tones.shape))
    time = dt * np.arange(round(duration / dt) + 1)[:, None, None]
    flown = np.clip(np.minimum(time, duration - time)[:, 0] - 0.5, 0, 1)  # level at both ends
    waves = jnp.sin(2 * np.pi * (time * tones * (0.8 + 0.45 * spread) + phases)).mean(axis=2)
    return flown * LARGEST * waves


@eqx.filter_jit
def _fly(
    loops: jaxos4.ClosedLoop, keys: jax.Array, duration: float, references: np.ndarray | None, *, soft: bool
) -> jaxos4.Flight:
    def one(loop: jaxos4.ClosedLoop, key: jax.Array) -> jaxos4.Flight:
        flown, settings = references, {"duration": duration, "dt": DT, "key": jax.random.fold_in(key, 0)}
        if flown is None:
            flown = sines(**settings) if soft else jaxos4.random_references(amplitude=LARGEST.tolist(), **settings)
        return jaxos4.fly_closed_loop(loop, flown, dt=DT, key=jax.random.fold_in(key, 1))

    return eqx.filter_vmap(one)(loops, keys)


def main(
    flights: Count = 50,
    effects: list[str] = (*EFFECTS, ALL),
    duration: float = 20.0,
    seed: Seed = 22,
    estimators: Estimators = ("filter-error",),
    out: Out = None,
) -> None:
    """Measure errors and coverage for each effect.

    - `effects`: The cases.
    """
    check_names("effects", effects, (*EFFECTS, ALL))
    check_names("estimators", estimators, ESTIMATORS)
    flown = functools.cache(lambda kind: flights_of(kind, flights, duration, seed))

    def row_of(kind: str, estimator: str, flight: int) -> Row:
        return fit(estimator, flown(kind)[flight], VEHICLE, flight)

    trials = product(kind=effects, estimator=estimators, flight=range(flights))
    rows = study(out, {"flights": flights, "duration": duration, "seed": seed}, trials, row_of)
    print_summaries(f"effects of real flights, {duration:g} s in closed loop", rows)
