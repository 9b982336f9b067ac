"""Rates that the true vehicle predicts in open loop, if a controller answers gusts: what no model can do better.

Simulated flights of a Crazyflie, of which all commands are logged, are predicted with the true parameters and the true
noise. Only the gusts after a start are unknown. The commands answer them: a prediction that has the commands and lacks
the gusts turns the other way.
"""

import numpy as np

import jaxos4
from jaxos4.closed_loop import fly_standard
from jaxos4.forecast import FlightPrediction, Vehicle
from jaxos4.shooting.gains import LogNoise

AIRFRAME = jaxos4.load_airframe("crazyflie")
TERMS = "offset", "damping", "lag", "delay", "reaction", "accelerometer"
LAG, DELAY, DAMPING = 0.05, 0.01, 0.5  # [s], [s], [1/s]
GUST_TIME, GYRO, FORCE = 0.1, 0.005, 0.03  # [s], [rad/s], [m/s^2]: as the NanoBench flights show
STEP, DURATION = 0.01, 20.0  # of a flight [s]
KINDS = "error", "constant"


def predicted(gust: float, seed: int) -> FlightPrediction:
    """The prediction of a flight through gusts with this standard deviation [rad/s^2]."""
    model = jaxos4.FlightModel(AIRFRAME, terms=TERMS)
    values = dict(zip(model.parameter_names, np.asarray(model.alpha).tolist(), strict=True))
    values |= {"rotor_lag": LAG, "rotor_delay": DELAY}
    values |= {f"{axis}_damping": DAMPING for axis in ("roll", "pitch", "yaw")}
    turning, pushing = np.ones(3), np.ones(len(model.force_axes))
    calm = 1e-3  # a filter needs some disturbance
    noise = LogNoise(
        np.log(np.concatenate([max(gust, calm) * turning, calm * pushing])),
        np.log(np.full(turning.size + pushing.size, GUST_TIME)),
        np.log(np.concatenate([GYRO * turning, FORCE * pushing])),
    )
    nothing = np.zeros((len(values), len(values)))
    known = np.array(list(values.values()))
    vehicle = Vehicle("the truth", model, known, nothing, np.zeros(3), noise, STEP, "successful", ())
    loop = jaxos4.ClosedLoop(
        AIRFRAME,
        rotor_lag=LAG,
        rotor_delay=DELAY,
        damping=DAMPING,
        gust=gust,
        gust_time=GUST_TIME,
        gyro_noise=GYRO,
        force_noise=FORCE,
    )
    return jaxos4.predict(vehicle, fly_standard(loop, duration=DURATION, dt=STEP, seed=seed))


def measured_share(predictions: list[FlightPrediction]) -> dict[str, list[float]]:
    """How much of a predicted rate is measured on average, by horizon: 1 if the prediction lacks only noise."""
    states = ([getattr(each, which) for each in predictions] for which in ("predicted", "measured"))
    predicted, measured = (np.concatenate(each)[..., 10:12] for each in states)
    product = np.where(np.isfinite(measured), predicted * measured, 0.0).sum(axis=0)
    shares = product / np.where(np.isfinite(measured), predicted**2, 0.0).sum(axis=0)
    return dict(zip("pq", shares.T.tolist(), strict=True))


def simulated(gust: float, flights: int) -> dict[str, dict[str, list[float]]]:
    """The mean absolute errors of p and q over simulated flights, of constant rates too, and `measured_share`."""
    found = [predicted(gust, seed) for seed in range(flights)]
    quality = [each.quality for each in found]
    errors = {
        axis: {kind: np.mean([getattr(each[axis], kind) for each in quality], axis=0).tolist() for kind in KINDS}
        for axis in "pq"
    }
    return {axis: errors[axis] | {"share": share} for axis, share in measured_share(found).items()}
