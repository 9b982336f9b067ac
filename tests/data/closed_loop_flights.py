"""Flights in closed loop of one length, which share one program."""

import jax
import numpy as np

import jaxos4

DT, SAMPLES = 0.004, 4001
RATES, ANGLES, VELOCITY = [7, 9, 11], [6, 8, 10], [1, 3, 5]
SUCCESS = jaxos4.RESULTS.successful
QUIET = {"gyro_noise": 0.0, "attitude_noise": 0.0, "force_noise": 0.0}
LEVEL = np.zeros((SAMPLES, 4))


def references(seed=0):
    return jaxos4.random_references(duration=DT * (SAMPLES - 1), dt=DT, key=jax.random.key(seed))
