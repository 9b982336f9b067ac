# %% [markdown]
# # Your own drone, from a CSV
#
# A log in a format of your own becomes moments of inertia with intervals and verdicts. You
# need a CSV with the gyro and the motors at 40 Hz or more, the mass, and the rotors'
# positions.

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
# This page must run without your drone, so it flies a simulated one: a quadrotor of 27 g under
# a controller, for 30 s in gusts. Its log has columns that jaxos4 does not know. With a log of
# your own, skip this cell.

# %%
truth = jaxos4.Airframe(
    mass=0.027,
    inertia=[1.66e-5, 1.7e-5, 2.9e-5],
    rotor_positions=[[0.028, -0.028], [-0.028, -0.028], [-0.028, 0.028], [0.028, 0.028]],
    rotor_spins=[1, -1, 1, -1],
    thrust_coefficient=2.4e-8,
    drag_coefficient=1.2e-10,
    rotor_inertia=2e-8,
    max_rotor_speed=2500.0,
)
references = jaxos4.random_references(duration=30.0, dt=0.004, key=jax.random.key(0))
flown = jaxos4.fly_closed_loop(
    jaxos4.ClosedLoop(truth, gust=2.0, thrust_curve=0.85),
    references,
    dt=0.004,
    key=jax.random.key(1),
)
log = {"time_ms": 1000 * flown.time}
log |= {f"motor{i + 1}_percent": 100 * flown.omega[:, i] / 2500.0 for i in range(4)}
log |= {f"gyro_{name}": np.degrees(flown.states[:, 7 + 2 * i]) for i, name in enumerate("xyz")}
log |= {f"acc_{name}": flown.specific_force[:, i] / 9.81 for i, name in enumerate("xyz")}
pd.DataFrame(log).round(5).to_csv("mylog.csv", index=False)
print(*Path("mylog.csv").read_text().splitlines()[:3], sep="\n")

# %% [markdown]
# ## Say what the columns are
#
# A [column map](../logs.md#any-csv-by-a-column-map) names the source of each quantity and its
# unit. Here it is a table in Python; the command line takes a file (`--columns map.toml`).

# %%
columns = {"t": {"source": "time_ms", "unit": "ms"}}
columns |= {f"command{i}": {"source": f"motor{i}_percent", "unit": "%"} for i in range(1, 5)}
columns |= {
    ours: {"source": f"gyro_{name}", "unit": "deg/s"} for ours, name in zip("pqr", "xyz")
}
columns |= {f"a{name}": {"source": f"acc_{name}", "unit": "g"} for name in "xyz"}
recording = jaxos4.recording.read_recording(
    "mylog.csv", full_scale=2500.0, columns={"columns": columns}
)
print(f"{recording.time.size} samples, one every {1000 * recording.dt:.3g} ms")
print(f"notes: {recording.notes}")

# %% [markdown]
# ## Describe the vehicle
#
# `jaxos4 inspect mylog.csv --columns map.toml --airframe-out mine.toml` writes what the log
# shows: how the rotors turn, and the speed in hover. Weigh the vehicle, measure where the
# rotors are, and write both into the file.

# %%
Path("mine.toml").write_text("""
mass = 0.027
rotor_positions = [[0.028, -0.028], [-0.028, -0.028], [-0.028, 0.028], [0.028, 0.028]]
rotor_spins = [1, -1, 1, -1]
hover_speed = 1661.0
max_rotor_speed = 2500.0
inertia = "guess"
drag_coefficient = "guess"
rotor_inertia = "guess"
""")
airframe = jaxos4.load_airframe("mine.toml")

# %% [markdown]
# ## Check the log against itself
#
# Each finding would have a cause, a size, a remedy, and the quantities that it makes wrong.
# This log has none.

# %%
jaxos4.recording.self_checks(recording, airframe)

# %% [markdown]
# ## Identify
#
# The verdicts come first: which numbers may be used, and which may not.

# %%
found = jaxos4.identify(recording, airframe, settings=jaxos4.VehicleSettings(sample_time=0.008))
print(found.summary())

# %% [markdown]
# `sample_time` makes this page faster; without it, a rule chooses the sample time. This flight
# is simulated, so we know the truth:

# %%
for name, true in (("Ix", 1.66e-5), ("Iy", 1.70e-5)):
    value = found.rigid_body.constants[name]
    print(f"{name}: {value.estimate:.3g} +- {1.96 * value.std:.2g} kg m^2, truth {true:.3g}")

# %% [markdown]
# ## Look at what was not fitted
#
# A quarter of the flight was held out. From the recorded motors, the model predicts the roll
# rate 0.25 s ahead:

# %%
found.plot.rates("p")

# %% [markdown]
# ## A fault, and what it looks like
#
# Suppose that the map says nothing about the unit of the accelerometer, so that it counts as
# m/s². The finding names the cause and what would be wrong:

# %%
columns |= {f"a{name}": f"acc_{name}" for name in "xyz"}
wrong = jaxos4.recording.read_recording(
    "mylog.csv", full_scale=2500.0, columns={"columns": columns}
)
for finding in jaxos4.recording.self_checks(wrong, airframe):
    print(f"contradicts {', '.join(finding.quantities)}: {finding}")

# %% [check]
for name, true in (("Ix", 1.66e-5), ("Iy", 1.70e-5)):
    value = found.rigid_body.constants[name]
    assert found.verdicts[name].status == "identified"
    assert abs(value.estimate - true) < 3 * value.std
assert jaxos4.recording.self_checks(recording, airframe) == ()
assert "units of g" in str(jaxos4.recording.self_checks(wrong, airframe)[0])
