"""Vehicles drawn from an answer: mean and covariance, reservations and guesses as width, and the limits of physics."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refused
from synthetic_results import AIRFRAME, SHARE, VALUES as OF_MORE_THRUST, held, vehicle_result as any_vehicle_result

import jaxos4
from jaxos4.export import TARGETS, export_vehicle, read_result, sample_vehicles
from jaxos4.export.vehicle import RigidVehicle

VALUES = OF_MORE_THRUST | {"thrust_gain": 1.05}  # a thrust that says nothing against the airframe's coefficients
ALPHAS = ("alpha3", "alpha6", "alpha8")
COUNT = 10_000


def vehicle_result(values=VALUES, **changes):
    return any_vehicle_result(values, **changes)


def doubt(quantity, share=None, deviations=2.0, result="successful"):
    """A doubt that would move a quantity by this share, or by nobody knows how much."""
    move = None if share is None else {"share": share, "deviations": deviations}
    return {"result": result, "cause": "why", "remedy": "how", "moves": {quantity: move}}


def stds(found):
    return {name: row["std"] for name, row in found.gaussian.items()}


def agree(drawn, mean, covariance):
    """Whether mean and covariance of the rows are within four standard errors."""
    count, off = len(drawn), drawn - drawn.mean(axis=0)
    variances = np.diag(covariance)
    error = np.sqrt((np.outer(variances, variances) + covariance**2) / count)
    of_mean = np.abs(drawn.mean(axis=0) - mean) < 4 * np.sqrt(variances / count)
    return bool(of_mean.all() and (np.abs(off.T @ off / (count - 1) - covariance) < 4 * error).all())


def test_ten_thousand_vehicles_have_the_mean_and_the_covariance_of_the_estimate(write):
    result, shares = vehicle_result(), np.full(len(VALUES), 0.02)
    correlation = np.eye(len(VALUES))
    places = {name: place for place, name in enumerate(VALUES)}
    correlation[:3, :3] += 0.5 * (1 - np.eye(3))
    correlation[places["rotor_lag"], 0] = correlation[0, places["rotor_lag"]] = -0.4
    std = shares * np.abs(list(VALUES.values()))
    result["covariance"] = (np.outer(std, std) * correlation).tolist()
    drawn = sample_vehicles(write(result), COUNT, key=jax.random.key(5))
    inertia = np.asarray(drawn["inertia"])
    gain = np.asarray(drawn["thrust_coefficient"]) / AIRFRAME["thrust_coefficient"]
    # The load of the propeller shortens the lag; see `rigid_vehicle`.
    curve = np.asarray(drawn["thrust_curve"])
    hover = np.sqrt(0.027 * 9.81 / (4 * np.asarray(drawn["thrust_coefficient"]))) / AIRFRAME["max_rotor_speed"]
    lag = np.asarray(drawn["lag"]) * (curve + 2 * (1 - curve) * hover)
    damping = np.asarray(drawn["damping"]) / inertia
    # Relative errors of inertia are those of thrust_gain, with the accelerometer's scale, less those of alpha.
    names = ["rotor_lag", "roll_damping", "pitch_damping", "yaw_damping"]
    share = 0.02**2 * correlation[np.ix_([*range(3), *map(places.get, names)], [*range(3), *map(places.get, names)])]
    signs = np.array([-1, -1, -1, 1, 1, 1, 1])
    share = np.pad(share * np.outer(signs, signs), (0, 1))
    scaled = np.array([1, 1, 1, 0, 0, 0, 0, 1])
    share += (0.02**2 + 0.01**2) * np.outer(scaled, scaled)
    mean = np.array([*(1.05 / VALUES[name] for name in ALPHAS), *(VALUES[name] for name in names), 1.05])
    every, covariance = np.column_stack([inertia, lag, damping, gain]), share * np.outer(mean, mean)
    assert agree(every, mean, covariance)
    # The comparison can fail.
    assert not agree(every, mean * 1.001, covariance)
    assert not agree(every, mean, 1.1 * covariance)
    assert (inertia > 0).all()
    assert (2 * inertia.max(axis=1) < inertia.sum(axis=1)).all()
    positions = np.asarray(drawn["rotor_positions"])
    assert ((positions.min(axis=1) < 0) & (positions.max(axis=1) > 0)).all()


def test_reservations_widen_the_quantity_that_they_concern(write):
    """By the share of an inertia, and of the half-width of a parameter's bracket: 5 1/s, 5 1/s and 0.5 1/s."""
    plain = stds(read_result(write(vehicle_result())))
    doubts = [doubt("Ix", 0.06), doubt("Ix", 0.08), doubt("Iy"), doubt("damping", 0.1), doubt("Iz", 0.03, 0.5)]
    found = read_result(write(vehicle_result(doubts=doubts)))
    added = {name: std**2 - plain[name] ** 2 for name, std in stds(found).items()}
    ix, iy, _ = found.vehicle.inertia
    expected = {"Ix": (0.1 * ix) ** 2, "Iy": (0.05 * iy) ** 2}  # 5 % if nothing says how far
    expected |= {"roll_damping": 0.25, "pitch_damping": 0.25, "yaw_damping": 0.0025}
    for name, variance in added.items():
        assert variance == pytest.approx(expected.get(name, 0.0), abs=1e-9 * plain[name] ** 2), name
    widened = {name for name, row in found.gaussian.items() if row["origin"] != "the estimate"}
    assert widened == expected.keys()  # the doubt about Iz is a mere note
    assert all(f"{name}: varies by" in " ".join(found.notes_on_draws) for name in expected)
    # The bracket of the estimate counts.
    result = vehicle_result(doubts=doubts)
    result["parameters"]["roll_damping"]["bracket"] = [-1.0, 1.0]
    variance = stds(read_result(write(result)))["roll_damping"] ** 2
    assert variance == pytest.approx(plain["roll_damping"] ** 2 + 0.01)


def test_refused_quantities_are_as_wide_as_a_guess(write):
    refusal = {"result": "unidentifiable"}
    doubts = [doubt("Ix", **refusal), doubt("Iy", 0.5, **refusal), doubt("damping", **refusal)]
    found = read_result(write(vehicle_result(doubts=doubts)))
    std, (ix, iy, _) = stds(found), found.vehicle.inertia
    assert (std["Ix"], std["Iy"], std["roll_damping"]) == pytest.approx((0.4 * ix, 0.4 * iy, 5.0))
    assert std["Iz"] < 0.03 * found.vehicle.inertia[2]
    assert "refuses it" in found.gaussian["Ix"]["origin"]
    # A verdict can refuse without a doubt: an interval that is too long, or reservations that contradict together.
    std = stds(read_result(write(vehicle_result(verdicts={"Iy": {"status": "not identified"}}))))
    assert std["Iy"] == pytest.approx(0.4 * iy)
    std = stds(read_result(write(vehicle_result(verdicts={"thrust": {"status": "contradicted"}}))))
    assert std["thrust_gain"] == pytest.approx(0.5)


def test_an_inertia_that_was_not_identified_is_a_guess(write):
    values = {name: value for name, value in VALUES.items() if name != "alpha8"}
    found = read_result(write(vehicle_result(values, held={"alpha8": held(3.5e4)})))
    drawn = [found.draw(number, seed=0)[0] for number in range(200)]
    drag = {vehicle.drag_coefficient / vehicle.thrust_coefficient for vehicle in drawn}
    assert stds(found)["Iz"] == pytest.approx(0.4 * found.vehicle.inertia[2])
    assert max(drag) == pytest.approx(min(drag))
    assert "Iz: varies by 1.2e-05 kg m^2 (std): a guess: it was not identified" in found.notes_on_draws


def test_another_drag_coefficient_means_another_iz(write):
    """Flights show the yaw torque over Iz, whatever the drag is."""
    guessed = AIRFRAME | {"guessed": ["drag_coefficient", "rotor_inertia"]}
    of_drag = doubt("Iz", result="unidentifiable")
    found = read_result(write(vehicle_result(airframe=guessed, doubts=[of_drag])))
    std, (*_, iz) = stds(found), found.vehicle.inertia
    ratio = std["Iz"] / iz
    assert std["drag_coefficient"] == pytest.approx(0.4 * AIRFRAME["drag_coefficient"])
    assert ratio == pytest.approx(np.sqrt(0.4**2 + 2 * SHARE**2 + 0.01**2))  # alpha8, thrust_gain and its scale
    drawn = [found.draw(number, seed=0)[0] for number in range(300)]
    drag, inertia = (np.array(each) for each in zip(*((x.drag_coefficient, x.inertia[2]) for x in drawn), strict=True))
    spread = np.std(drag / inertia) / np.mean(drag / inertia)
    assert spread < 0.05 < 0.2 < np.std(drag) / np.mean(drag)
    # Another reason to refuse Iz says that the yaw is not known either.
    doubtful = read_result(write(vehicle_result(airframe=guessed, doubts=[of_drag, of_drag])))
    assert stds(doubtful)["Iz"] / iz == pytest.approx(np.sqrt(2) * 0.4)
    # A thrust that is 20 % off the airframe's, with coefficients that were not measured together.
    measured = {name: value for name, value in VALUES.items() if name != "rotor_lag"}
    found = read_result(write(vehicle_result(measured | {"thrust_gain": 1.2})))
    assert stds(found)["drag_coefficient"] == pytest.approx(0.2 * AIRFRAME["drag_coefficient"])
    # With commands, the full speed may be wrong instead, which changes thrust and drag alike.
    commanded = read_result(write(vehicle_result(VALUES | {"thrust_gain": 1.2})))
    assert "drag_coefficient" not in stds(commanded)
    # An Iz that is given does not vary, and is no guess.
    given = read_result(write(vehicle_result(airframe=guessed, doubts=[of_drag])), inertia_z=3e-5)
    assert [given.draw(number, seed=0)[0].inertia[2] for number in range(9)] == [pytest.approx(3e-5)] * 9
    assert "Iz" not in given.gaussian
    assert not any(note.startswith(("Iz: varies", "drag")) for note in given.notes_on_draws)


def test_a_guess_of_the_rotors_inertia_varies(write):
    values = {name: value for name, value in VALUES.items() if name != "rotor_reaction"}
    guessed = AIRFRAME | {"guessed": ["rotor_inertia"]}
    found = read_result(write(vehicle_result(values, airframe=guessed)))
    assert stds(found)["rotor_inertia"] == pytest.approx(0.4 * AIRFRAME["rotor_inertia"])
    assert np.ptp([found.draw(number, seed=0)[0].rotor_inertia for number in range(9)]) > 1e-9
    assert "rotor_inertia" not in stds(read_result(write(vehicle_result(airframe=guessed))))


@pytest.mark.parametrize(("deviations", "varies"), [(1.0, True), (-1.0, True), (-3.0, False)])
def test_a_damping_is_drawn_from_the_positive_part_of_its_gaussian(write, deviations, varies):
    """Unless it is clearly negative. The inertia of a vehicle is drawn with its damping, not apart from it."""
    std = 0.7
    result = vehicle_result(VALUES | {"yaw_damping": deviations * std})
    rows = list(VALUES)
    damping, alpha = rows.index("yaw_damping"), rows.index("alpha8")
    result["parameters"]["yaw_damping"]["std"] = std
    result["covariance"][damping][damping] = std**2
    both = -0.9 * std * SHARE * VALUES["alpha8"]
    result["covariance"][damping][alpha] = result["covariance"][alpha][damping] = both
    found, count = read_result(write(result)), 2000
    drawn, repeated = zip(*(found.draw(number, seed=0) for number in range(count)), strict=True)
    values = np.array([vehicle.damping[2] / vehicle.inertia[2] for vehicle in drawn])
    if not varies:
        assert (set(values), sum(repeated)) == ({0.0}, 0)
        return
    generator = np.random.default_rng(1)
    each = deviations * std + std * generator.standard_normal(100_000)
    positive, share = each[each > 0], np.mean(each > 0)
    error = np.sqrt(positive.var() / count + positive.var() / positive.size)
    assert values.min() > 0
    assert abs(values.mean() - positive.mean()) < 4 * error
    # The number of failures before the successes is negative binomial.
    assert abs(sum(repeated) - count * (1 - share) / share) < 4.2 * np.sqrt(count * (1 - share)) / share
    iz = np.array([vehicle.inertia[2] for vehicle in drawn])
    shift = 0.9 * SHARE * (positive.mean() / std - deviations)  # of Iz, with its damping
    assert iz.mean() / found.vehicle.inertia[2] - 1 == pytest.approx(shift, abs=4 * 0.02 / np.sqrt(count))


def test_vehicles_that_nobody_can_build_are_repeated_and_counted(write):
    result, below, draws = vehicle_result(), 0.1587, 1000  # the chance to be one standard deviation below the mean
    for name, place in (("alpha3", 0), ("alpha6", 1), ("thrust_gain", list(VALUES).index("thrust_gain"))):
        result["parameters"][name]["std"] = result["covariance"][place][place] = 0.0
    # At one standard deviation, Iz is the sum of Ix and Iy, whose common factor does not matter.
    ix, iy, iz = (1.05 / VALUES[name] for name in ALPHAS)
    result["covariance"][2][2] = ((ix + iy - iz) / iz * VALUES["alpha8"]) ** 2
    found = read_result(write(result))
    vehicles, repeated = zip(*(found.draw(number, seed=0) for number in range(draws)), strict=True)
    assert all(not vehicle.fault for vehicle in vehicles)
    outside = below + 0.0018  # and Iz below 0 or so small that Ix exceeds Iy + Iz
    assert abs(sum(repeated) - draws * outside / (1 - outside)) < 4 * np.sqrt(draws * outside) / (1 - outside)
    # A centre of mass that is uncertain by half an arm stays inside the arms, and weighs on no rotor too much.
    result = vehicle_result()
    place = list(VALUES).index("pitch_thrust")
    result["covariance"][place][place] = (0.014 * VALUES["alpha6"] * AIRFRAME["mass"]) ** 2
    found = read_result(write(result))
    vehicles, repeated = zip(*(found.draw(number, seed=0) for number in range(draws)), strict=True)
    assert sum(repeated) > 20
    for vehicle in vehicles:
        x = vehicle.rotor_positions[:, 0]
        assert x.min() < 0 < x.max()
    center = found.vehicle._replace(rotor_positions=found.vehicle.rotor_positions + [0.03, 0.0])
    assert center.fault == "the centre of mass lies outside the arms"
    assert "drag of the rotors" in found.vehicle._replace(drag_coefficient=-1e-10).fault
    result["covariance"][0][0] = 1e20  # alpha3
    with pytest.raises(jaxos4.InputError, match="too uncertain"):
        export_vehicle(read_result(write(result)), "mujoco", samples=1)


def test_a_sample_depends_on_its_number_and_on_the_seed_alone_and_has_its_own_notes(write):
    found = read_result(write(vehicle_result()))
    few, many = (export_vehicle(found, "rotorpy", samples=count, seed=5) for count in (2, 4))
    assert few.samples == many.samples[:2]
    assert len({few.text, *many.samples}) == 5
    assert export_vehicle(found, "rotorpy", samples=2, seed=6).samples[0] != few.samples[0]
    late = f"give commands {found.draw(0, seed=5)[0].delay:.4g} s late"
    assert late in few.samples[0]
    assert late not in few.text


def test_samples_in_python_are_arrays_for_vmap_and_those_of_the_command(write):
    path = write(vehicle_result())
    found = jaxos4.read_result(path)
    vehicles = found.sample(5, key=jax.random.key(7))
    assert {name: array.shape[0] for name, array in vehicles.items()} == dict.fromkeys(RigidVehicle._fields, 5)
    assert vehicles["rotor_positions"].shape == (5, 4, 2)
    for each, row in enumerate(export_vehicle(read_result(path), "urdf", samples=5, seed=7).manifest["vehicles"]):
        for name, array in vehicles.items():
            np.testing.assert_allclose(array[each], row[name], rtol=1e-12)
    more = found.sample(6, key=jax.random.key(7))
    np.testing.assert_array_equal(more["inertia"][:5], vehicles["inertia"])
    other = found.sample(5, key=jax.random.split(jax.random.key(7))[0])
    assert not np.array_equal(other["inertia"], vehicles["inertia"])

    def acceleration(vehicle, torque):
        return torque / vehicle["inertia"]

    turned = eqx.filter_vmap(acceleration, in_axes=(0, None))(vehicles, jnp.ones(3))
    np.testing.assert_allclose(turned, 1 / np.asarray(vehicles["inertia"]))
    with pytest.raises(jaxos4.InputError, match="`samples`: must be an integer of at least 1, got 0"):
        found.sample(0, key=jax.random.key(7))


def test_vehicles_are_written_into_a_folder_with_a_manifest(run, tmp_path, write):
    write(vehicle_result(doubts=[doubt("Ix", 0.06)]))
    for target, (label, suffix, _) in TARGETS.items():
        arguments = ("export", "found.json", "--to", target, "--out", f"{target}/", "--seed", "3")
        code, out, err = run(*arguments, "--samples", "3")
        assert (code, out) == (0, f"{target}: 3 vehicles, {label}, drawn with seed 3\n")
        assert "note: Ix: varies by " in err
        folder = tmp_path / target
        names = [f"00000{i}{suffix}" for i in (1, 2, 3)]
        assert sorted(path.name for path in folder.iterdir()) == [*names, "manifest.json"]
        manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
        assert (manifest["simulator"], manifest["seed"], manifest["impossible"]) == (target, 3, 0)
        assert [each["file"] for each in manifest["vehicles"]] == names
        assert manifest["gaussian"]["Ix"]["origin"] == "widened by the reservations of its verdict"
        assert manifest["gaussian"]["Iy"]["origin"] == "the estimate"
        assert [f"note: {note}" for note in manifest["notes"]] == err.splitlines()[1:]
        # Fewer vehicles replace them. Files that are not of the manifest stay, and nothing is written.
        assert run(*arguments, "--samples", "2")[0] == 0
        assert sorted(path.name for path in folder.iterdir()) == [*names[:2], "manifest.json"]
        (folder / "policy.onnx").touch()
        before = {path.name: path.read_bytes() for path in folder.iterdir()}
        refused(run(*arguments, "--samples", "3"), f"{target}: holds policy.onnx", "give another folder")
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    for text in ("{", "[]", '{"vehicles": 1}', '{"vehicles": [{"file": []}]}'):  # of another program
        (tmp_path / "others").mkdir(exist_ok=True)
        (tmp_path / "others/manifest.json").write_text(text)
        refused(run("export", "found.json", "--to", "sdf", "--samples", "1", "--out", "others"), "holds manifest.json")
