"""Static misuse is an error that names the argument, what it got and what it wants: one row for each way to misuse."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CRAZYFLIE, standard_flight, standard_problem

import jaxos4
from jaxos4.airframe import OS4
from jaxos4.estimators import ESTIMATORS, make_estimator
from jaxos4.excitation import EXCITATIONS, chirp, doublet, multisine, step3211
from jaxos4.models import Parameter, Term
from jaxos4.noise import SENSOR_SIGMA, ConstantBias, Dropouts, GaussMarkov, Quantisation, WhiteNoise

MODEL = jaxos4.PublishedOS4()
BRACKET = jaxos4.Bracket.default(MODEL)
SEVEN = jaxos4.Bracket(np.zeros(7), np.ones(7))
FLAT = jaxos4.Bracket(BRACKET.lower, BRACKET.upper.at[2].set(BRACKET.lower[2]))
NAMES = [name for name, kind in ESTIMATORS.items() if not kind.needs_network]


def simulate(**changes):
    good = {"parameters": MODEL.alpha, "omega": np.ones((5, 4)), "dt": 0.01, "initial_state": None} | changes
    arrays = {name: jnp.asarray(value) if np.ndim(value) else value for name, value in good.items()}
    return jaxos4.simulate(MODEL, arrays.pop("parameters"), arrays.pop("omega"), **arrays)


def shoot(model=MODEL, *, flight=None, **changes):
    arguments = {"sigma": SENSOR_SIGMA, "channels": "rates"} | changes
    return jaxos4.ShootingProblem(model, standard_flight(duration=0.1) if flight is None else flight, **arguments)


def start():
    return {"initial_state": np.zeros(12)}


def hold(**values):
    return standard_problem(jaxos4.CorrectedOS4, channels="rates").hold(values)


def vehicle(**settings):
    """The cost of a flight without measurements beside the rates."""
    model = jaxos4.FlightModel(**settings)
    blank = jaxos4.Flight(0.01 * np.arange(51), np.full((51, 4), 226.0), np.full((51, 12), np.nan))
    return shoot(model, flight=blank).cost(model.alpha)


def fit(bracket=BRACKET, **settings):
    network = jaxos4.NetworkEstimator(**settings)
    return network.fit(shoot(**start()), bracket, key=jax.random.key(0))


def evaluate(windows=1, parameters=MODEL.alpha):
    return jaxos4.evaluate(shoot(flight=standard_flight(), windows=windows), parameters, jnp.zeros(3))


def estimate(name, bracket=BRACKET, model=MODEL, **arguments):
    return make_estimator(name)(shoot(model, **({} if "windows" in arguments else start()), **arguments), bracket)


def flat_flight(samples, dt=0.01, rows=None):
    return jaxos4.Flight(dt * np.arange(samples), np.ones((samples, 4)), np.ones((rows or samples, 12)))


def loop(**settings):
    return jaxos4.ClosedLoop(CRAZYFLIE, **settings)


def fly(samples=5, every=1, **settings):
    loop = jaxos4.ClosedLoop(CRAZYFLIE, log_every=every)
    return jaxos4.fly_closed_loop(loop, jnp.zeros((samples, 4)), key=jax.random.key(0), **settings)


def references(**settings):
    return jaxos4.random_references(**settings, key=jax.random.key(0))


LAGGING = jaxos4.FlightModel(terms=("lag",))
MISUSE = [
    # A simulation and its flight.
    ("parameters", lambda: simulate(parameters=np.zeros(3))),
    ("omega", lambda: simulate(omega=np.ones((5, 3)))),
    ("omega", lambda: simulate(omega=np.ones((1, 5, 4)))),
    ("initial_state", lambda: simulate(initial_state=np.zeros(6))),
    *(("`dt` must be positive and finite", lambda dt=dt: simulate(dt=dt)) for dt in (0.0, np.inf)),
    ("`log_every` must be an integer", lambda: loop(log_every=1.5)),
    ("dt", lambda: simulate(dt=np.ones(2))),
    ("`method` must be one of euler, rk4, diffrax, got 'heun'", lambda: simulate(method="heun")),
    ("`time`, `omega` and `states`", lambda: flat_flight(3, rows=4)),
    ("at least two samples", lambda: flat_flight(1)),
    (
        "must have one sample time, got 0.01, 0.02 s",
        lambda: jaxos4.join([flat_flight(9), flat_flight(9, 0.02)], length=9),
    ),
    ("`flights` must hold at least `length` = 40 samples", lambda: jaxos4.join([], length=40)),
    # Noise.
    ("`sigma`", lambda: WhiteNoise(-0.1)),
    ("`sigma`", lambda: WhiteNoise(np.nan)),
    ("`mean`", lambda: ConstantBias(1.0, mean=np.ones((2, 12)))),
    ("`correlation_time`", lambda: GaussMarkov(1.0, correlation_time=0.0)),
    ("`step`", lambda: Quantisation(-1.0)),
    ("`probability`", lambda: Dropouts(1.5)),
    # A problem, its unknowns, and what is computed of it.
    ("`channels` must be one of rates, attitude, all, got 'some'", lambda: shoot(channels="some")),
    ("`method` must be one of euler, rk4, got 'diffrax'", lambda: shoot(method="diffrax")),
    *(("`windows` must be an integer from 1 to 5", lambda n=n: shoot(windows=n)) for n in (0, -1, 6)),
    ("`initial_state` must be `None` if there are several windows", lambda: shoot(**start(), windows=2)),
    ("`length` must be `None`", lambda: shoot(windows=5, length=jnp.asarray(7))),
    ("`values`: wind is no unknown; the unknowns are alpha1, ", lambda: hold(alpha1=0.0, wind=1.0)),
    ("`values` holds every unknown", lambda: hold(**dict.fromkeys(MODEL.parameter_names, 0.0))),
    ("`values` holds every unknown", lambda: hold(alpha1=0.0).hold(dict.fromkeys(MODEL.parameter_names[1:], 0.0))),
    (r"`start` must hold 17 unknowns, got shape \(8,\)", lambda: jaxos4.InnovationsProblem(shoot(), start=np.zeros(8))),
    ("`many` must hold at least one lane", lambda: jaxos4.on_all_cores(jaxos4.IBSS())({"lanes": np.zeros((0, 3))})),
    ("`limits`: knows no `speed`; the limits are ", lambda: jaxos4.design_input(MODEL, limits={"speed": 3.0}, key=0)),
    (
        "`limits`: `slew` is a limit of rotor speeds",
        lambda: jaxos4.design_references(loop(), limits={"slew": 9}, key=0),
    ),
    (r"`initial_state` must be of shape \(6,\)", lambda: evaluate(windows=2)),
    (r"`parameters` must be of shape \(8,\)", lambda: evaluate(parameters=MODEL.alpha[:7])),
    ("`bracket` must hold 8", lambda: jaxos4.identifiability(evaluate(), SEVEN)),
    # Vehicles.
    ("max_rotor_speed", lambda: vehicle(terms=("motor",))),
    ("leave out lag", lambda: vehicle(terms=("motor", "lag"))),
    ("`battery_voltage` must be given for the term voltage", lambda: vehicle(terms=("voltage",))),
    ("`terms` must be some of offset, center_of_mass, damping", lambda: vehicle(terms=("wind",))),
    ("`terms` must be some of", lambda: vehicle(terms=("lag", "Lag"))),
    *(("`recordings` must count from 0", lambda r=r: vehicle(recordings=r)) for r in ((), (1,), (0, 2), (-1, 0))),
    ("velocity, inflow, drag need `Flight.body_vel", lambda: vehicle(terms=("velocity",))),
    (
        "acts on the forcing",
        lambda: Term("", (Parameter("own_lag", "s", 0.1, each_recording=True),), speed=lambda omega, *other: omega),
    ),
    ("voltage need `Flight.voltage`", lambda: vehicle(terms=("voltage",), battery_voltage=11.1)),
    # Brackets, results and estimators.
    *(
        ("`lower` and `upper` must be one-dimensional and of one shape", lambda ends=ends: jaxos4.Bracket(*ends))
        for ends in ((np.zeros(8), np.ones(7)), (np.zeros((2, 8)), np.ones((2, 8))), (0.0, 1.0))
    ),
    ("`bracket` must hold 8 parameters, got 7", lambda: shoot().within(SEVEN)),
    *(("`bracket` must hold 8 parameters, got 7", lambda n=n: estimate(n, SEVEN)) for n in NAMES),
    *(("`problem.windows` must be 1", lambda n=n: estimate(n, windows=2)) for n in ("rls", "svsf", "kalman")),
    ("linear in its parameters|no rotor lag", lambda: estimate("equation-error", None, LAGGING)),
    *(("`network` must be a trained network", lambda n=n: make_estimator(n)) for n in ("network", "hybrid")),
    ("`name` must be one of ibss, .*, got 'newton'", lambda: make_estimator("newton")),
    (r"`start` must hold 8 unknowns, got shape \(7,\)", lambda: jaxos4.IBSS()(shoot(), BRACKET, start=jnp.zeros(7))),
    # Networks.
    ("`features` must be one of score, raw, got 'fourier'", lambda: fit(features="fourier")),
    ("`steps` must be an integer of at least 1", lambda: fit(steps=0)),
    ("`held_out` must be an integer of at least 1000", lambda: fit(held_out=10)),
    (r"`noise` must be \(lowest, highest\)", lambda: fit(noise=(1.0, 0.1))),
    ("`channels` 'attitude' are more than the problem's", lambda: fit(channels="attitude")),
    ("`bracket` of alpha3 must have", lambda: fit(FLAT)),
    ("`bracket` must hold 8 parameters, got 7", lambda: fit(SEVEN)),
    # A flight in closed loop.
    *(("`gust`", lambda gust=gust: loop(gust=gust)) for gust in (-1.0, np.nan)),
    (r"`gust`.*\(2,\)", lambda: loop(gust=(1.0, 2.0))),
    ("`rotor_lag`", lambda: loop(rotor_lag=-0.1)),
    ("`gust_time`", lambda: loop(gust_time=np.array([0.1, 0.2]))),
    ("`offset`", lambda: loop(offset=np.inf)),
    ("`controller_inertia`", lambda: loop(controller_inertia=-1.0)),
    ("`logged`.*'both'", lambda: loop(logged="both")),
    ("`sag`", lambda: loop(sag=2.0)),
    ("`log_every`", lambda: loop(log_every=0)),
    ("`references`", lambda: fly(samples=1)),
    ("`substeps`", lambda: fly(substeps=0)),
    ("`substeps`.*multiple of `log_every` = 3, got 4", lambda: fly(every=3)),
    ("`duration`", lambda: references(duration=0.0)),
    ("`amplitude`", lambda: references(amplitude=(1.0,))),
    ("`wind`.*at least 0", lambda: jaxos4.Air(wind=-1.0)),
    (r"`drag`.*2 \(x, y\).*\(3,\)", lambda: jaxos4.Air(drag=(1.0, 2.0, 3.0))),
    ("`inflow`", lambda: jaxos4.Air(inflow=None)),
    ("`dropouts`.*at most 1", lambda: jaxos4.Sensors(dropouts=1.5)),
    ("`clock_offset`", lambda: jaxos4.Sensors(clock_offset=np.inf)),
    ("`controller_gyro_noise`", lambda: jaxos4.Sensors(controller_gyro_noise=-1.0)),
    # A rotor that cannot carry the weight.
    ("`airframe` cannot hover", lambda: multisine(eqx.tree_at(lambda a: a.max_rotor_speed, OS4, np.asarray(200.0)))),
]


@pytest.mark.parametrize(("said", "misuse"), MISUSE, ids=[f"{i} {said[:40]}" for i, (said, _) in enumerate(MISUSE)])
def test_misuse_is_named(said, misuse):
    with pytest.raises((ValueError, TypeError), match=said):
        misuse()


# Arguments of excitations, and settings of estimators: each value of a row.

ARGUMENTS = [
    (EXCITATIONS.values(), "duration", (0.0, -1.0, np.nan, np.inf, 0.001)),
    (EXCITATIONS.values(), "dt", (0.0, np.nan)),
    (EXCITATIONS.values(), "amplitude", (np.nan, (1.0, 1.0))),
    ([multisine], "tones", [((1.0,), (1.0,)), ((50.0,), (1.0,), (1.0,)), ((0.0,), (1.0,), (1.0,))]),
    ([doublet, step3211], "duration", [4.0]),
    ([chirp], "duration", [1.0]),
]


@pytest.mark.parametrize(("excitations", "name", "values"), ARGUMENTS)
def test_arguments_of_excitations_out_of_range_are_named(excitations, name, values):
    for excite in excitations:
        for value in values:
            with pytest.raises(ValueError, match=f"`{name}`"):
                excite(OS4, **{name: value})


SETTINGS = [
    (jaxos4.IBSS, "halvings", [1], "must be an integer of at least 2"),
    (jaxos4.IBSS, "tolerance", [0.0, np.nan], "must be positive"),
    (jaxos4.IBSS, "reach", [-1.0], "must be positive"),
    (jaxos4.OutputError, "tolerance", [0.0, -1.0], "must be positive"),
    (jaxos4.OutputError, "max_steps", [0, 2.5, "x", True, None], "must be an integer of at least 1"),
    (jaxos4.IBSS, "max_sweeps", [2**70], "must be at most 2147483647"),
    (jaxos4.FilterError, "tolerance", [0.0, np.nan], "must be positive"),
    (jaxos4.EquationError, "memory", [-0.1, 1.5, np.nan], "must be finite and at least 0 and at most 1"),
    (jaxos4.EquationError, "bridge", [-1], "must be an integer of at least 0"),
    (jaxos4.RecursiveLeastSquares, "forgetting", [0.0, 1.1], "must be positive and finite and at most 1"),
    (jaxos4.RecursiveLeastSquares, "memory", [2.0], "must be finite and at least 0 and at most 1"),
    (jaxos4.SVSF, "rates_layer", [0.0], "must be positive and finite"),
    (jaxos4.SVSF, "parameter_layer", [-1.0], "must be positive and finite"),
    (jaxos4.SVSF, "damping", [np.inf], "must be positive and finite"),
    (jaxos4.SVSF, "equilibration", [0.5], "must be finite and at least 1"),
    (jaxos4.JointEKF, "passes", [0, -1], "must be an integer of at least 1"),
    (jaxos4.AntColony, "archive", [1], "must be an integer of at least 2"),
    (jaxos4.AntColony, "ants", [0], "must be an integer of at least 1"),
    (jaxos4.AntColony, "q", [0.0, np.nan], "must be positive and finite"),
    (jaxos4.NetworkEstimator, "learning_rate", [0.0, np.inf, np.nan], "must be positive and finite"),
    (jaxos4.NetworkEstimator, "architecture", ["rbf"], "must be one of mlp, cmac"),
    (jaxos4.NetworkEstimator, "cells", [1], "must be an integer of at least 2"),
]


@pytest.mark.parametrize(("make", "setting", "values", "message"), SETTINGS)
def test_settings_out_of_range_are_named(make, setting, values, message):
    for value in values:
        with pytest.raises(ValueError, match=f"`{setting}` {message}.*, got '?{value}'?"):
            make(**{setting: value})


def test_settings_out_of_range_are_named_while_a_function_is_traced_and_may_be_integers_of_numpy():
    assert jaxos4.IBSS(max_sweeps=np.int64(5)).max_sweeps == 5
    bad = (jaxos4.IBSS, "max_sweeps", 0), (jaxos4.OutputError, "tolerance", -1.0), (jaxos4.EquationError, "bridge", -1)
    for make, setting, value in bad:
        with pytest.raises(ValueError, match=f"`{setting}` must be .*, got {value}"):
            eqx.filter_eval_shape(make, **{setting: value})
    with pytest.raises(ValueError, match="`passes` must be an integer of at least 1"):
        jax.eval_shape(lambda passes: jaxos4.JointEKF(passes=passes).passes, 2.5)
