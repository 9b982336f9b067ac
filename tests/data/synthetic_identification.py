"""Identifications that nobody computed, of a flight and of a vehicle, with everything that a page can show."""

import msgspec
import numpy as np
from helpers import CRAZYFLIE

from jaxos4 import AxisResponse, FrequencyResponse, Predictions
from jaxos4.analysis.diagnostics import residual_correlations
from jaxos4.analysis.traces import Traces
from jaxos4.identification.results import (
    ChannelFit,
    Constant,
    FixedParameter,
    OS4Identification,
    ParameterEstimate,
    PredictionSkill,
    Provenance,
    RateSkill,
    RigidBody,
    SampleTime,
    Validation,
    VehicleIdentification,
)
from jaxos4.identification.verdict import Verdict

INERTIA = "1/(kg m^2)"
KNOWN = ParameterEstimate(57712.3, 512.0, 130.0, (56708.8, 58715.8), INERTIA, "", 431.0)
UNKNOWN = ParameterEstimate(None, None, 2e6, None, INERTIA, "not identifiable: not excited", 0.1)
SMALL = ParameterEstimate(0.0011, 0.001, 0.001, (-0.0009, 0.0031), "1/s", "below noise", 0.25)
WHITE = ChannelFit(0.01, "rad/s", 97.53, 1.0, 0.5, 0.02, 0.4, {"roll": 0.0, "pitch": 0.0, "yaw": 0.0}, 0.3)
COLOURED = msgspec.structs.replace(WHITE, percent=81.26, level=4.0, correlation=0.8, white_p=1e-9, input_p=1e-5)
CONSTANTS = {"Ix": Constant(1.733e-5, 1.5e-7, "kg m^2"), "J_R": Constant(1e-8, 1e-7, "kg m^2")}
NOTED = {"Ix": msgspec.structs.replace(CONSTANTS["Ix"], note="if arms and mass are right"), "J_R": CONSTANTS["J_R"]}
COMMON = {"estimator": "ibss", "result": "successful", "rollouts": 812, "cost": 1234.5, "seconds": 35.4}
COMMON |= {"covariance": None, "airframe": CRAZYFLIE}
VERSIONS = {"airframe": "os4", "version": "0", "jax": "0", "device": "cpu", "precision": "float64"}

VERDICTS = {
    "Ix": Verdict("identified", "1.73e-05 +- 2.9e-07 kg m^2 (95 %), if arms and mass are right"),
    "Iz": Verdict(
        "not identified", "", ("the flights say less about alpha8 than its bracket; fly more yaw",), ("fly more yaw",)
    ),
}
WRONG = {"Ix": Verdict("contradicted", "", ("Ix is negative; check the arms",))}
SAMPLE_TIMES = tuple(
    SampleTime(step, {"Ix": Constant(ix, 2e-7, "kg m^2"), "Iy": Constant(1.8e-5, 3e-7, "kg m^2")}, 0.1, samples=1000)
    for step, ix in ((0.004, 1.64e-5), (0.008, 1.78e-5), (0.016, 1.8e-5))
)


def identified_flight(*, provenance=None, **changes) -> OS4Identification:
    settings = {"flight": "flight.csv", "channels": "rates", "windows": 1, "sample_time": 0.01}
    given = {
        "model": "published",
        "parameters": {"alpha3": KNOWN, "alpha6": UNKNOWN, "alpha2": SMALL},
        "rigid_body": RigidBody(CONSTANTS, 0.21, True),
        "fit": {"p": WHITE, "q": COLOURED},
        "validation": Validation("other.csv", 10.0, {"p": COLOURED}),
        "provenance": Provenance(**VERSIONS | settings | (provenance or {})),
    }
    return OS4Identification(**COMMON | given | changes)


def identified_vehicle(*, provenance=None, **changes) -> VehicleIdentification:
    rate = RateSkill(
        [0.91, 0.731, None], [0.02, 0.14, None], [0.2, 0.4, None], [0.7, 0.8, 0.9], equation_error=[0.5, 0.41, None]
    )
    settings = {
        "command": "jaxos4 estimate flight.csv --model flight --report flight.html",
        "flights": ["flight.csv"],
        "sample_time": 0.004,
        "terms": ["offset", "damping"],
        "fitted_seconds": 32.0,
        "notes": ["t is not uniform"],
    }
    if "predictions" in changes:
        changes = {"trajectories": None} | changes
    given = {
        "parameters": {"alpha3": KNOWN, "alpha6": UNKNOWN},
        "rigid_body": RigidBody(NOTED, 0.21, True),
        "verdicts": VERDICTS,
        "held": {"alpha1": FixedParameter(-0.8125, "1", "not identifiable")},
        "noise": {"p": 0.41},
        "skill": PredictionSkill([0.1, 0.248, 0.5], 377, rate, rate, rate),
        "predictions": synthetic_predictions(),
        "trajectories": synthetic_trajectories(),
        "traces": vehicle_traces(),
        "response": synthetic_response(),
        "provenance": Provenance(**VERSIONS | settings | (provenance or {})),
    }
    return VehicleIdentification(**COMMON | given | changes)


def synthetic_response() -> FrequencyResponse:
    """Roll 1.25 times the model, pitch half of it, yaw without a clear response."""
    frequency = np.arange(1.0, 60.0)
    coherence = 0.97 / (1 + (frequency / 14) ** 6)

    def axis(ratio: float, share: float) -> AxisResponse:
        error = np.sqrt((1 - share * coherence) / (share * coherence * 80))
        flat = np.full(frequency.size, ratio)
        return AxisResponse(frequency, flat, 0.01 * frequency, share * coherence, np.diag(error**2), 41.0)

    return FrequencyResponse(axis(1.25, 1.0), axis(0.5, 0.9), axis(1.0, 0.03))


def synthetic_trajectories(starts=160) -> Predictions:
    """Every fourth of `synthetic_predictions` with these starts, each 20 ms."""
    return synthetic_predictions(starts, 0.02 * np.arange(1, 26)).thinned(starts // 4)


def synthetic_predictions(starts=160, horizons=(0.1, 0.248, 0.5)) -> Predictions:
    """Predictions in two stretches. One measurement is missing."""
    start = 5 + 12 * np.arange(starts)
    start[starts // 2 :] += 300
    horizons = np.array(horizons)
    time = 0.004 * start[:, None, None] + horizons[:, None] + 0.7 * np.arange(3)
    measured = np.sin(3 * time)
    measured[3, 1, 0] = np.nan
    predicted = np.sin(3 * time) + 0.3 * horizons[:, None] * np.cos(40 * time)
    return Predictions(start, horizons, np.sin(3 * time[:, 0]), predicted, measured)


def synthetic_traces(time, log, measured) -> Traces:
    """Traces of rotors at one speed, with a disturbance and no position."""
    rotors, none = np.full((time.size, 4), 200.0), np.zeros((time.size, 0))
    gusts = np.stack([np.sin(time), np.cos(time), time], axis=1)
    return Traces(time, log, rotors, measured, none, gusts, none, time[:0], log[:0])


def behind_an_estimate() -> dict:
    """What stands behind an estimate of twelve channels: traces, correlations of residuals, brackets, a covariance."""
    time, rng = 0.01 * np.arange(400), np.random.default_rng(0)
    flown = synthetic_traces(time, np.zeros(400, int), np.sin(time[:, None] * np.arange(1, 13)))
    path = np.stack([np.sin(time), np.cos(time), time], axis=1)
    predicted = flown.measured + 0.01 * rng.normal(size=(400, 12))
    traces = msgspec.structs.replace(flown, predicted=predicted, disturbance=flown.measured[:, :0], position=path)
    torques, noise = rng.normal(size=(400, 3)), rng.normal(size=(400, 12))
    noise[5:, 1] = 0.5 * torques[:-5, 2]  # q follows the yaw torque
    rows = {name: msgspec.structs.replace(KNOWN, bracket=(5e4, 6e4)) for name in ("alpha3", "alpha6")}
    behind = {"traces": traces, "correlations": residual_correlations(noise, torques), "parameters": rows}
    return behind | {"covariance": [[4.0, -1.9], [-1.9, 1.0]]}


def vehicle_traces(start=None) -> Traces:
    """Those of `synthetic_predictions` with these starts: the first seconds of the flight were fitted."""
    start = synthetic_predictions().start if start is None else start
    time = 0.025 * np.arange(400)
    measured = np.where(time[:, None] < 3.5, np.sin(3 * time[:, None]), np.nan) * np.ones(3)
    found = synthetic_traces(time, np.zeros(400, int), measured)
    return msgspec.structs.replace(found, start_time=0.004 * start, start_log=np.zeros(start.size, int)).thinned()
