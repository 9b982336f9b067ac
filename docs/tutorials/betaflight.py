# %% [markdown]
# # A Betaflight log
#
# A blackbox log with measured rotor speeds (bidirectional DShot) identifies a 5-inch
# quadrotor. Rotors are in the order of Betaflight, and one line of the airframe file is wrong
# at first.

# %%
from pathlib import Path

import jax
import numpy as np
import pandas as pd

jax.config.update("jax_enable_x64", True)  # double precision; JAX's default is single
import jaxos4

# %% [markdown]
# ## A log to begin with
#
# With a `.bbl` of your own, skip this cell. Here a controller flies a simulated quadrotor of
# 0.6 kg for 20 s in gusts, and the log is written in the columns and units of
# `blackbox_decode`.

# %%
truth = jaxos4.Airframe(
    mass=0.6,
    inertia=[2.4e-3, 2.8e-3, 4.6e-3],
    rotor_positions=[[-0.08, -0.08], [0.08, -0.08], [-0.08, 0.08], [0.08, 0.08]],
    rotor_spins=[-1, 1, 1, -1],
    thrust_coefficient=1.6e-6,
    drag_coefficient=2.2e-8,
    rotor_inertia=6e-6,
)
loop = jaxos4.ClosedLoop(truth, gust=(2.0, 2.0, 0.5), rotor_lag=0.03, logged="speeds")
references = jaxos4.random_references(duration=20.0, dt=0.004, key=jax.random.key(0))
flown = jaxos4.fly_closed_loop(loop, references, dt=0.004, key=jax.random.key(1))
log = {
    "loopIteration": np.arange(flown.time.size),
    "time (us)": np.rint(1e6 * flown.time).astype(int),
}
log |= {f"gyroADC[{i}]": np.rint(np.degrees(flown.states[:, 7 + 2 * i])) for i in range(3)}
log |= {f"accSmooth[{i}]": np.rint(flown.specific_force[:, i] / 9.81 * 2048) for i in range(3)}
log |= {f"eRPM[{i}]": np.rint(flown.omega[:, i] * 30 / np.pi * 7 / 100) for i in range(4)}
pd.DataFrame(log).to_csv("flight.csv", index=False)

# %% [markdown]
# ## Read it
#
# The format is recognised. The notes say what the reader assumed, because this file has no
# settings; a `.bbl` has them.

# %%
recording = jaxos4.recording.read_recording("flight.csv")
print(*recording.notes, sep="\n")

# %% [markdown]
# ## Describe the vehicle
#
# `jaxos4 inspect flight.csv --airframe-out mine.toml` begins this file from the log.
# Betaflight numbers the rotors rear right, front right, rear left, front left. We write the
# spins as if the propellers turned outwards in front ("props out"), which is a mistake here:

# %%
MINE = """
mass = 0.6
rotor_positions = [[-0.08, -0.08], [0.08, -0.08], [-0.08, 0.08], [0.08, 0.08]]
rotor_spins = {spins}
hover_speed = 959.0
inertia = "guess"
drag_coefficient = 2.2e-8
rotor_inertia = "guess"
"""
Path("mine.toml").write_text(MINE.format(spins=[1, -1, -1, 1]))
settings = jaxos4.VehicleSettings(sample_time=0.008)
wrong = jaxos4.identify(recording, jaxos4.load_airframe("mine.toml"), settings=settings)
print(f"Iz: {wrong.verdicts['Iz'].status}")
print(*wrong.verdicts["Iz"].reasons, sep="\n")

# %% [markdown]
# ## Identify
#
# The reason names the remedy: we reverse the spins.

# %%
Path("mine.toml").write_text(MINE.format(spins=[-1, 1, 1, -1]))
found = jaxos4.identify(recording, jaxos4.load_airframe("mine.toml"), settings=settings)
print(found.summary())

# %% [markdown]
# The true moments of inertia are 2.4, 2.8 and 4.6 e-3 kg m². Iz is as accurate as the drag
# coefficient, which this airframe file knows, and yours probably does not. In the picture,
# crosses are not the truth but the guesses with which the search began.

# %%
found.plot.inertias()

# %% [check]
for name, true in (("Ix", 2.4e-3), ("Iy", 2.8e-3)):
    value = found.rigid_body.constants[name]
    assert found.verdicts[name].status == "identified"
    assert abs(value.estimate - true) < 3 * value.std
assert wrong.verdicts["Iz"].status == "contradicted"
