"""A small network that predicts body rates, for comparison: trained on the flights that are identified.

An MLP of equinox maps the rates at a step, and the commands of the last 0.1 s and of this step, to the change of the
rates. It is trained over 50 steps, by Adam.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxos4.flight import RATES
from jaxos4.forecast import FlightPrediction
from jaxos4.recording import Recording

PAST, STEPS, BATCH, WIDTH, RATE = 10, 50, 256, 32, 2e-3


class RateNetwork(eqx.Module):
    """The rates after each of `STEPS` steps, by their changes."""

    layers: eqx.nn.MLP
    scale: jax.Array
    size: jax.Array

    def __call__(self, rates: jax.Array, commands: jax.Array) -> jax.Array:
        """From the rates at a start (3,) and commands (PAST + STEPS, 4) to the rates after each step (STEPS, 3)."""

        def step(now, k):
            window = jax.lax.dynamic_slice_in_dim(commands, k, PAST + 1).ravel()
            now = now + self.size * self.layers(jnp.concatenate([now / self.scale[:3], window]))
            return now, now

        return jax.lax.scan(step, rates, jnp.arange(STEPS))[1]


def _data(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Rates [rad/s], and commands about their mean."""
    commands = recording.omega / recording.omega.mean()
    return recording.states[:, RATES], 5 * (commands - 1.0)


def trained(recordings: list[Recording], *, batches: int, seed: int) -> RateNetwork:
    """A network of the recordings; samples with missing rates are left out."""
    data, places = [_data(recording) for recording in recordings], []
    for i, (rates, _) in enumerate(data):
        known = np.asarray(np.isfinite(rates).all(axis=1))
        start = np.arange(PAST, len(rates) - STEPS)
        rows = start[:, None] + np.arange(-PAST, STEPS + 1)
        places += [(i, k) for k in start[known[rows].all(axis=1)]]
    scale = jnp.asarray(np.nanstd(np.concatenate([rates for rates, _ in data]), axis=0))
    layers = eqx.nn.MLP(3 + 4 * (PAST + 1), 3, WIDTH, 2, activation=jax.nn.tanh, key=jax.random.key(seed))
    network = RateNetwork(layers, scale, 0.1 * scale)
    optimiser = optax.adam(RATE)
    state, generator = optimiser.init(eqx.filter(network.layers, eqx.is_array)), np.random.default_rng(seed)

    @eqx.filter_jit
    def update(network, state, rates, commands, truth):
        def loss(layers):
            one = eqx.tree_at(lambda n: n.layers, network, layers)
            return jnp.abs((jax.vmap(one)(rates, commands) - truth) / network.scale).mean()

        slope = eqx.filter_grad(loss)(network.layers)
        change, state = optimiser.update(slope, state)
        return eqx.tree_at(lambda n: n.layers, network, eqx.apply_updates(network.layers, change)), state

    for _ in range(batches):
        some = generator.integers(len(places), size=BATCH)
        chosen = [(*data[places[k][0]], places[k][1]) for k in some]
        rates = np.stack([r[k] for r, _, k in chosen])
        commands = np.stack([u[k - PAST : k + STEPS] for _, u, k in chosen])
        truth = np.stack([r[k + 1 : k + STEPS + 1] for r, _, k in chosen])
        network, state = update(network, state, *map(jnp.asarray, (rates, commands, truth)))
    return network


@eqx.filter_jit
def _from_starts(network: RateNetwork, begin: jax.Array, commands: jax.Array) -> jax.Array:
    return jax.vmap(network)(begin, commands)


def errors_of(
    networks: list[RateNetwork], recording: Recording, prediction: FlightPrediction
) -> dict[str, list[float]]:
    """The mean absolute error by horizon of the rates, over the starts of a prediction and the networks."""
    rates, commands = _data(recording)
    start = np.searchsorted(recording.time, prediction.time - 0.5 * recording.dt)
    usable = (start >= PAST) & (start + STEPS < len(rates))
    rows = start[usable]
    windows = jnp.asarray(np.stack([commands[k - PAST : k + STEPS] for k in rows]))
    begin, truth = jnp.asarray(prediction.begin[usable, 10:]), prediction.measured[usable][:, :STEPS, 10:]
    departed = np.stack([np.asarray(_from_starts(network, begin, windows)) - truth for network in networks])
    sizes = {"rates": np.linalg.norm(departed, axis=-1)}
    sizes |= {name: np.abs(departed[..., i]) for i, name in enumerate("pqr")}
    return {name: [float(x) for x in np.nanmean(size, axis=(0, 1))] for name, size in sizes.items()}
