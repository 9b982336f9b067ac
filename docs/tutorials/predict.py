# %% [markdown]
# # Predict another flight, and export the vehicle
#
# A model is worth what it predicts. Here one flight identifies a vehicle, another flight tests
# it, and the vehicle is exported to MuJoCo.

# %%
import json
from pathlib import Path

import jax
import matplotlib.pyplot as plt

jax.config.update("jax_enable_x64", True)  # double precision; JAX's default is single
import jaxos4

# %% [markdown]
# ## Two flights
#
# Both are simulated: 20 s in gusts of 2 rad/s², with [the vehicle of the first
# tutorial](own_drone.py). Their references differ. `jaxos4 simulate --closed-loop --airframe
# vehicle.toml` takes the same file of the vehicle.

# %%
Path("vehicle.toml").write_text("""
mass = 0.027
inertia = [1.66e-5, 1.7e-5, 2.9e-5]
rotor_positions = [[0.028, -0.028], [-0.028, -0.028], [-0.028, 0.028], [0.028, 0.028]]
rotor_spins = [1, -1, 1, -1]
thrust_coefficient = 2.4e-8
drag_coefficient = 1.2e-10
rotor_inertia = 2e-8
max_rotor_speed = 2500.0
""")
airframe = jaxos4.load_airframe("vehicle.toml")
loop = jaxos4.ClosedLoop(airframe, gust=2.0)


def fly(seed):
    first, second = jax.random.split(jax.random.key(seed))
    references = jaxos4.random_references(duration=20.0, dt=0.004, key=first)
    return jaxos4.fly_closed_loop(loop, references, dt=0.004, key=second)


found = jaxos4.identify(fly(0), airframe, settings=jaxos4.VehicleSettings(sample_time=0.008))
for name, verdict in found.verdicts.items():
    print(f"{name:15} {verdict.status}")

# %% [markdown]
# ## Predict
#
# Every 0.1 s, a prediction starts from the measured attitude and rates, and then knows only
# the commands.

# %%
prediction = jaxos4.predict(found, fly(1))
quality = prediction.quality["attitude"]
print("mean error of the attitude [rad], from", prediction.time.size, "starts")
for ahead in (0.1, 0.25, 0.5):
    place = abs(prediction.horizons - ahead).argmin()
    error, constant = quality.error[place], quality.constant[place]
    print(f"{ahead:.2f} s ahead: {error:.3f}, constant rates {constant:.3f}")

# %%
figure, axes = plt.subplots(figsize=(6, 3.2))
for label, error in (
    ("identified vehicle", quality.error),
    ("without the disturbance at the start", quality.unaware),
    ("regression", quality.regression),
    ("constant rates", quality.constant),
):
    axes.plot(prediction.horizons, error, label=label)
axes.set(xlabel="time ahead [s]", ylabel="error of the attitude [rad]")
axes.legend()

# %% [markdown]
# Trust the model as far ahead as it beats the simple predictions. In gusts no model predicts
# far, because nobody knows the gusts to come. The 95 % band says so: it should contain 95 % of
# what was measured.

# %%
print(f"inside the band: {100 * quality.coverage.mean():.0f} %")

# %% [markdown]
# ## Keep the result
#
# The file holds everything: `jaxos4 report found.json` makes a page of it, and
# `jaxos4.read_result` reads it.

# %%
Path("found.json").write_text(json.dumps(found.to_dict()))
print(jaxos4.read_result("found.json").verdicts["Ix"].status)

# %% [markdown]
# ## Export
#
# Each note names a difference between the identified vehicle and the one in the simulator.

# %%
exported = jaxos4.export.export_vehicle(jaxos4.export.read_result("found.json"), "mujoco")
print(*exported.notes, sep="\n")

# %%
body = exported.text[exported.text.index("<inertial") :]
print(body[: body.index("\n")])

# %% [markdown]
# `exported.text` is the whole file. [Into your simulator](../into_your_simulator.md) flies it,
# and lists the other formats.

# %% [check]
assert (quality.error < quality.constant).all()
from xml.etree import ElementTree

assert ElementTree.fromstring(exported.text).tag == "mujoco"
