# %% [markdown]
# # A simulated study: IBSS, network and hybrid
#
# 64 noisy flights are identified by four estimators, and their errors are compared with the
# Cramer-Rao bound. [Studies](../studies.md) do the same from the command line, for any number
# of flights.

# %%
import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)  # double precision; JAX's default is single
import jaxos4

# %% [markdown]
# ## One flight
#
# The OS4 has eight unknown parameters, alpha1 to alpha8. A multisine excites all axes for 5 s,
# and the sensors add noise.

# %%
model = jaxos4.PublishedOS4(jaxos4.OS4)
omega = jaxos4.multisine(model.airframe, duration=5.0, dt=0.01)
clean = jaxos4.simulate(model, model.alpha, omega, dt=0.01)
noise, bracket = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA), jaxos4.Bracket.default(model)


def problem(key):
    """The likelihood of a noisy flight whose start is known exactly."""
    start, sigma = clean.states[0], jaxos4.SENSOR_SIGMA
    return jaxos4.ShootingProblem(
        model, noise(clean, key=key), sigma=sigma, initial_state=start
    )


estimate = jaxos4.IBSS()(problem(jax.random.key(0)), bracket)
for name, value, std in zip(model.parameter_names, estimate.parameters, estimate.std):
    print(f"{name} {value:10.5f} +- {1.96 * std:.5f}")

# %% [markdown]
# ## A network for these inputs
#
# It is trained on simulated flights with the same inputs and random parameters from the
# bracket. It sees the body rates alone. By default, training takes 4,000 steps; 1,000 steps
# keep this page fast.

# %%
network = jaxos4.NetworkEstimator(steps=1000).fit(
    problem(jax.random.key(0)), bracket, key=jax.random.key(1)
)

# %% [markdown]
# ## 64 flights at once
#
# Estimators are written for one flight, and `vmap` makes a batch of them. All flights have the
# same true parameters, those of the OS4, in the centre of the bracket. `jaxos4 study` moves the
# bracket at random for each flight, or draws other parameters.

# %%
ESTIMATORS = {
    "IBSS": jaxos4.IBSS(),
    "network": network,
    "hybrid": jaxos4.Hybrid(network),
    "Levenberg-Marquardt": jaxos4.OutputError(),
}
keys = jax.random.split(jax.random.key(2), 64)


def search(estimator):
    return eqx.filter_vmap(lambda key: estimator(problem(key), bracket))(keys)


found = {name: search(estimator) for name, estimator in ESTIMATORS.items()}
for name, estimates in found.items():
    print(f"{name:20} {estimates.rollouts.mean():4.0f} simulated flights for each answer")

# %% [markdown]
# ## As accurate as possible?
#
# No unbiased estimator has a smaller standard deviation than the Cramer-Rao bound. An RMS
# error over 64 flights has a Monte-Carlo error of 9 %.

# %%
bound = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(problem(keys[0]), model.alpha)))
ratio = {
    name: np.sqrt(np.mean((e.parameters - model.alpha) ** 2, axis=0)) / bound
    for name, e in found.items()
}
for name, each in ratio.items():
    print(f"{name:20} RMSE / bound {each.min():.2f} to {each.max():.2f}")

# %% [markdown]
# The network sees the body rates alone, and their bound is up to eight times as large as the
# bound of all channels. The hybrid does not suffer from this: the network only chooses where
# IBSS begins, and IBSS finds the optimum in all channels.

# %%
figure, axes = plt.subplots(figsize=(6, 3.2))
for (name, each), marker in zip(ratio.items(), "os^x"):
    axes.plot(model.parameter_names, each, marker, label=name, markerfacecolor="none")
axes.axhline(1, color="gray", linewidth=0.8)
axes.set(ylabel="RMSE / bound", ylim=0)
axes.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1))

# %% [check]
for name in ("IBSS", "hybrid"):
    assert 0.7 < ratio[name].min() <= ratio[name].max() < 1.3
