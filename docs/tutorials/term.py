# %% [markdown]
# # A term of your own
#
# The model of a vehicle is a rigid body and a list of terms. Here is a term that jaxos4 lacks:
# friction of the air against yaw that grows with the square of the rate. We compare a fit that
# ignores the friction with a fit that has the term. [Add a vehicle term](../extend/term.md)
# describes all that a term can do.

# %%
import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)  # double precision; JAX's default is single
import jaxos4
from jaxos4.models import Parameter, Term

# %% [markdown]
# ## The term
#
# One object holds the name, the unit and the bracket of its parameter, and a function that
# adds its effect to the angular acceleration.


# %%
def add_friction(total, values, rates, forcing):
    return total._replace(r=total.r - values["yaw_friction"] * rates.r * jnp.abs(rates.r))


jaxos4.TERMS["friction"] = Term(
    "a moment against the yaw rate, proportional to its square: yaw_friction [1/rad]",
    (Parameter("yaw_friction", "1/rad", half_width=1.0),),
    by_default=lambda available: False,
    angular_acceleration=add_friction,
)

# %% [markdown]
# ## A flight with friction
#
# An OS4 flies a multisine of 5 s in open loop, and its gyro has noise.

# %%
model = jaxos4.FlightModel(jaxos4.OS4, terms=("friction",))
truth = model.alpha.at[-1].set(0.5)
omega = jaxos4.multisine(jaxos4.OS4, duration=5.0, dt=0.01)
clean = jaxos4.simulate(model, truth, omega, dt=0.01)
flight = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(clean, key=jax.random.key(0))
print(f"largest yaw rate: {np.abs(clean.states[:, 11]).max():.2f} rad/s")

# %% [markdown]
# ## Two fits
#
# Both maximise the same likelihood of the body rates. If the model is right, the cost is about
# half of the number of measurements. A much larger cost means that the model lacks an effect.

# %%
expected = 3 * flight.time.size / 2


def fit(terms):
    model = jaxos4.FlightModel(jaxos4.OS4, terms=terms)
    problem = jaxos4.ShootingProblem(
        model,
        flight,
        sigma=jaxos4.SENSOR_SIGMA,
        channels="rates",
        initial_state=clean.states[0],
    )
    found = jaxos4.OutputError()(problem, jaxos4.Bracket.default(model))
    noise = np.sqrt(expected)
    print(f"terms {terms}: cost {found.cost:.0f}, expected {expected:.0f} +- {noise:.0f}")
    return dict(zip(model.parameter_names, zip(found.parameters, found.std)))


without, within = fit(()), fit(("friction",))

# %% [markdown]
# Without the term, the error goes into alpha8, so the moment of inertia about yaw is wrong:

# %%
for name, found in (("without", without), ("with", within)):
    alpha8, std = found["alpha8"]
    print(f"{name:8} alpha8 {alpha8:.2f} +- {1.96 * std:.2f}, truth {truth[7]:.2f} 1/(kg m^2)")
value, std = within["yaw_friction"]
print(f"yaw_friction {value:.3f} +- {1.96 * std:.3f}, truth 0.5 1/rad")

# %% [markdown]
# A log of a real vehicle needs no more than the name: `jaxos4.VehicleSettings(terms=("offset",
# "damping", "friction"))`. For `--terms friction` on the command line, put the term into [a
# package of your own](../extend/index.md#from-a-package-of-your-own).

# %% [check]
for name, true in (("alpha8", truth[7]), ("yaw_friction", truth[8])):
    value, std = within[name]
    assert abs(value - true) < 3 * std
value, std = without["alpha8"]
assert value < truth[7] - 10 * std
