"""`jaxos4 export`: files for each simulator, samples from the covariance, and wrong input."""

import json
import tomllib

import numpy as np
import pytest
from helpers import CRAZYFLIE, refused
from synthetic_results import AIRFRAME, VALUES, held, provenance, vehicle_result

import jaxos4
from jaxos4.airframe import airframe_from_table, airframe_table
from jaxos4.errors import InputError
from jaxos4.export import TARGETS, export_vehicle, found_loop, read_result
from jaxos4.export.vehicle import CARRIED, rigid_vehicle


def test_the_table_of_an_airframe_can_be_read_again():
    for airframe in (jaxos4.OS4, airframe_from_table(AIRFRAME)):
        table = airframe_table(airframe)
        assert json.loads(json.dumps(table, allow_nan=False)) == table
        assert airframe_table(airframe_from_table(table)) == table


def test_an_estimate_is_exported_to_each_simulator(run, tmp_path, write):
    write(vehicle_result())
    assert list(TARGETS) == list(CURVES)
    for target, (_, suffix, *_) in TARGETS.items():
        code, out, err = run("export", "found.json", "--to", target, "--out", f"vehicle{suffix}")
        assert code == 0, err
        assert out.startswith(f"vehicle{suffix}: ")
        text = (tmp_path / f"vehicle{suffix}").read_text(encoding="utf-8")
        assert text.isascii()
        assert "note: " in err
        assert all(line.replace("note", "Note", 1) in text for line in err.splitlines())
        # Without --out: the same text on standard output.
        assert run("export", "found.json", "--to", target)[:2] == (0, text)


def test_what_is_exported_of_a_vehicle(write):
    vehicle = read_result(write(vehicle_result())).vehicle
    np.testing.assert_allclose(vehicle.inertia, [1.1 / VALUES[name] for name in ("alpha3", "alpha6", "alpha8")])
    assert vehicle.thrust_coefficient == pytest.approx(1.1 * 2.4e-8)
    assert (vehicle.delay, vehicle.thrust_curve) == (0.01, 0.8)
    # The load of the propeller, 0.2 w^2, shortens the lag of small changes.
    assert vehicle.lag == pytest.approx(0.05 / (0.8 + 0.4 * vehicle.hover_speed / vehicle.max_rotor_speed))
    assert vehicle.rotor_inertia == pytest.approx(7e-4 * 1.1 / 3.5e4)
    np.testing.assert_allclose(vehicle.drag, 0.027 * np.array([0.3, 0.4, 0.6]))
    np.testing.assert_allclose(vehicle.flapping, vehicle.inertia[:2] * [0.2, -0.1])
    # What was not identified is the airframe's.
    result = vehicle_result({"alpha3": 6.1e4, "alpha6": 5.9e4, "rotor_reaction": 7e-4})
    result["parameters"]["rotor_reaction"]["std"] = 1e-3
    found = read_result(write(result))
    assert (found.vehicle.inertia[2], found.vehicle.rotor_inertia) == (pytest.approx(2.9e-5), pytest.approx(2e-8))
    assert (found.vehicle.lag, found.vehicle.thrust_curve) == (0, 1)
    assert any(note.startswith("Iz: not identified") for note in found.notes)
    assert any(note.startswith("rotor_lag: unknown, because the log has measured") for note in found.notes)


def test_a_design_flies_the_vehicle_that_was_found(run, write, tmp_path, monkeypatch):
    gust = {"strength": 3.0, "unit": "rad/s^2", "time_constant": 0.2, "sensor": 0.01, "correlation": 0.0}
    gusts = {name: gust | {"strength": strength} for name, strength in zip("pqr", (3.0, 4.0, 1.0), strict=True)}
    write(vehicle_result(disturbances=gusts))
    asked = []

    def stop(loop, **_):
        asked.append(loop)
        raise InputError("enough.")

    monkeypatch.setattr(jaxos4, "design_references", stop)
    refused(run("design", "found.json", "--out", "references.csv"), "enough.")
    refused(run("design", "found.json", "--gust", "1", "--lag", "0.1", "--out", "references.csv"), "enough.")
    found, changed = asked
    vehicle = read_result(tmp_path / "found.json").vehicle
    for name in ("inertia", "thrust_coefficient", "drag_coefficient", "rotor_inertia"):
        np.testing.assert_allclose(getattr(found.airframe, name), getattr(vehicle, name))
    np.testing.assert_allclose(found.gust, [3.0, 4.0, 1.0])
    np.testing.assert_allclose(found.damping, [0.4, 0.5, 0.7])
    assert [float(x) for x in (found.rotor_lag, found.rotor_delay, found.thrust_curve)] == [0.05, 0.01, 0.8]
    assert (found.logged, float(changed.rotor_lag)) == ("commands", 0.1)
    np.testing.assert_allclose(changed.gust, [1.0, 1.0, 1.0])
    refused(run("design", "found.json", "--airframe", "x500", "--out", "r.csv"), "--airframe: found.json has its own")


def test_an_estimate_beyond_what_a_motor_can_be_flies_at_the_limit(write):
    for braking, curve, flown in ((1.1, 1.3, (1.0, 1.2)), (0.0, 0.8, (0.0, 0.8))):
        loop = found_loop(write(vehicle_result(VALUES | {"motor_braking": braking, "thrust_curve": curve})))
        assert (float(loop.motor_braking), float(loop.thrust_curve)) == flown


def test_what_a_simulator_lacks_and_what_is_replaced_or_does_not_vary_is_noted(write):
    found = read_result(write(vehicle_result()))
    notes = {target: "\n".join(export_vehicle(found, target).notes) for target in TARGETS}
    assert "z_drag: not carried: SDF has no force against the velocity along z: 0.0162 N s/m" in notes["sdf"]
    torque = ", ".join(f"{x:.3g}" for x in found.vehicle.torque)
    assert f"offsets: not carried: SDF has no constant torque: {torque} N m" in notes["sdf"]
    for target in ("sdf", "mujoco"):
        assert f"{found.vehicle.flapping[0]:.3g} N m about x for each m/s along y" in notes[target]
    assert f"{found.vehicle.rotor_inertia:.3g} kg m^2" in notes["mujoco"]
    values = VALUES | {"alpha2": 1e-3, "alpha5": 1e-3, "alpha4": 0.5}
    del values["alpha8"], values["yaw_damping"]
    apart = {"alpha1": held(-0.7), "alpha8": held(3.5e4), "yaw_damping": held(0.0)}
    notes = export_vehicle(read_result(write(vehicle_result(values, held=apart))), "mujoco", samples=1).notes
    for name, width in (("Iz", "1.26e-05 kg m^2"), ("yaw_damping", "0.5")):  # 40 %, and the bracket of the term
        assert any(note.startswith(f"{name}: varies by {width} (std): a guess") for note in notes)
    assert "alpha4: replaced by the values that follow from Ix, Iy, Iz" in notes
    (of_rotors,) = [note for note in notes if "alpha2" in note]
    assert of_rotors.startswith("rotor inertia: not carried")


def test_recordings_share_the_mean_offset_and_negative_damping_is_0(write):
    values = {"roll_offset_1": 2.0, "roll_offset_2": 1.0, "roll_damping": -0.1, "roll_flapping": 0.2}
    values = {name: VALUES[name] for name in ("alpha3", "alpha6", "alpha8")} | values
    found = read_result(write(vehicle_result(values)))
    assert found.vehicle.torque[0] == pytest.approx(1.5 / 6.1e4)
    assert found.vehicle.damping[0] == 0
    assert "roll_damping" not in found.gaussian
    stranger = "roll_flapping: not carried: an exported vehicle of this version has no such parameters"
    for note in ("mean of the recordings", "roll_damping: came out negative", stranger):
        assert any(note in line for line in found.notes), note


def test_every_parameter_is_carried_or_noted(write):
    """That of a term with which nobody thought of simulators too."""
    airframe = airframe_from_table(AIRFRAME)
    vehicle = rigid_vehicle(airframe, VALUES)
    names = {parameter.name for term in jaxos4.TERMS.values() for parameter in term.parameters} | {"yaw_friction"}
    found = read_result(write(vehicle_result(VALUES | dict.fromkeys(names - {*VALUES}, 0.1))))
    notes = [name for note in found.notes for name in note.partition(":")[0].split(", ")]
    for name in names:
        moved = rigid_vehicle(airframe, VALUES | {name: 1.01 * VALUES.get(name, 0.1)})
        differs = any(not np.array_equal(*both) for both in zip(vehicle, moved, strict=True))
        assert differs == (name in CARRIED) == (name not in notes), name


CURVES = {
    "mujoco": "control = ctrlrange x ({})",
    "rotorpy": "rotor speed = rotor_speed_max x sqrt({})",
    "sdf": "rotor speed = maxRotVelocity x sqrt({})",
    "drone-models": "rotor speed = that of thrust_max x sqrt({})",
    "urdf": "thrust = the largest x ({})",
}


def test_the_thrust_curve_is_noted_in_the_words_of_the_file(write):
    curved = read_result(write(result := vehicle_result()))
    steep = read_result(write(vehicle_result(VALUES | {"thrust_curve": 1.2})))
    # It cannot be distinguished from 1: three standard deviations are 0.21.
    result["parameters"]["thrust_curve"]["std"] = 0.07
    found = read_result(write(result))
    for target, formula in CURVES.items():
        note = "thrust_curve: for the u-th part of a full command, " + formula
        assert note.format("(2 u / (0.8 + sqrt(0.64 + 0.8 u)))^2") in export_vehicle(curved, target).notes
        assert note.format("(2 u / (1.2 + sqrt(1.44 - 0.8 u)))^2") in export_vehicle(steep, target).notes
        assert "thrust_curve" not in " ".join(export_vehicle(found, target).notes)
    assert found.vehicle.thrust_curve == 1
    assert "thrust_curve" not in found.gaussian


def test_the_parameters_of_drone_models_make_the_forces_of_the_vehicle(write):
    """By the equations of `drone_models.first_principles`."""
    found = read_result(write(vehicle_result())).vehicle
    own = tomllib.loads(export_vehicle(read_result(write(vehicle_result())), "drone-models").text)["vehicle"]
    speed = np.array([1000.0, 1100.0, 1200.0, 1300.0])
    rpm, (x, y) = speed * 60 / (2 * np.pi), found.rotor_positions.T
    thrust = own["rpm2thrust"][2] * rpm**2
    torque = own["mixing_matrix"] @ thrust * [own["L"], own["L"], 0]
    torque[2] = own["mixing_matrix"][2] @ (own["rpm2torque"][2] * rpm**2)
    expected = found.thrust_coefficient * speed**2
    np.testing.assert_allclose(thrust, expected)
    yaw = -found.rotor_spins * found.drag_coefficient @ speed**2
    np.testing.assert_allclose(torque, [y @ expected, -x @ expected, yaw])
    np.testing.assert_allclose(own["J"], np.diag(found.inertia))
    np.testing.assert_allclose(np.diag(own["drag_matrix"]), -found.drag)
    assert own["rotor_dyn_coef"] == [1 / found.lag, 0, 1 / found.lag, 0]
    # Of a plain X, the matrix has the entries of the presets there.
    plain = read_result(
        write(
            vehicle_result(
                airframe=airframe_table(CRAZYFLIE), values={name: VALUES[name] for name in ("alpha3", "alpha6")}
            )
        )
    )
    own = tomllib.loads(export_vehicle(plain, "drone-models").text)["vehicle"]
    np.testing.assert_allclose(own["mixing_matrix"], [[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]])


def test_an_inertia_that_no_rigid_body_has_is_given_on_demand_and_clamped(run, write):
    values = {name: VALUES[name] for name in ("alpha3", "alpha6")}
    path = write(vehicle_result(values, held={"alpha8": held(1e4)}))  # Iz = 1e-4, and Ix + Iy = 3.3e-5
    refused(run("export", "found.json", "--to", "urdf"), "Iz was not identified and is a guess: give --inertia-z")
    refused(run("export", "found.json", "--to", "urdf", "--inertia-z", "-1"), "--inertia-z: must be positive")
    ix, iy = (1 / VALUES[name] for name in ("alpha3", "alpha6"))
    for given, used in ((3e-5, 3e-5), (1e-4, ix + iy), (1e-9, abs(ix - iy))):
        found = read_result(path, inertia_z=given)
        assert found.vehicle.inertia[2] == pytest.approx(used, rel=1e-6)
        assert not found.draw(1, seed=0)[0].fault
        (note,) = [note for note in found.notes if note.startswith("Iz: ")]
        assert note.startswith("Iz: given, not estimated")
        assert ("allows" in note) == (given != used)
        assert found.vehicle.drag_coefficient == pytest.approx(AIRFRAME["drag_coefficient"])
    # No other Iz makes the thrust positive, or mends an Iz that was given.
    falls = vehicle_result(values | {"thrust_curve": 2.5}, held={"alpha8": held(3.5e4)})
    write(falls)
    for option in ((), ("--inertia-z", "3e-5")):
        code, _, err = run("export", "found.json", "--to", "urdf", *option)
        assert (code, "thrust_curve" in err, "guess" in err) == (2, True, False)


def test_with_another_inertia_the_vehicle_yaws_as_the_flight_showed(write):
    """Flights show the yaw torque over Iz: the drag coefficient changes with Iz."""
    path = write(vehicle_result())
    estimated = read_result(path)
    found = read_result(path, inertia_z=2.8e-5)
    factor = 2.8e-5 * VALUES["alpha8"] / VALUES["thrust_gain"]
    assert factor != pytest.approx(1, rel=0.02)
    assert found.vehicle.inertia[2] == pytest.approx(2.8e-5)
    assert found.vehicle.drag_coefficient == pytest.approx(factor * estimated.vehicle.drag_coefficient)
    (note,) = [note for note in found.notes if note.startswith("Iz: ")]
    assert f"the drag coefficient is {factor:.4g} times the airframe's" in note
    # The yaw of samples is as uncertain as the estimate.
    ours, theirs = (each.draw(1, seed=0)[0] for each in (found, estimated))
    for name in ("drag_coefficient", "rotor_inertia"):
        assert getattr(ours, name) / ours.inertia[2] == pytest.approx(getattr(theirs, name) / theirs.inertia[2])


def test_an_estimate_that_is_not_to_be_trusted_is_written_with_a_warning(run, tmp_path, write):
    doubt = {"result": "no_skill", "cause": "yaw is not predicted", "remedy": "fly more yaw"}
    write(vehicle_result(result="no_skill", doubts=[doubt]))
    code, out, err = run("export", "found.json", "--to", "rotorpy", "--out", "vehicle.py")
    assert (code, out) == (1, "vehicle.py: parameters for RotorPy\n")
    first, *_, last = err.splitlines()
    assert first == "not to be trusted because yaw is not predicted; fly more yaw"
    assert last.startswith("jaxos4: no_skill: the fit predicts")
    # Each sentence once.
    assert err.count("not to be trusted") == err.count("the fit predicts") == 1
    text = (tmp_path / "vehicle.py").read_text(encoding="utf-8")
    assert all(words in text for words in ("# NOT TO BE TRUSTED: no_skill: ", f"\n# {first}\n", '"mass": 0.027,'))
    # A reservation is no refusal.
    write(vehicle_result(doubts=[doubt | {"result": "successful"}]))
    code, _, err = run("export", "found.json", "--to", "rotorpy", "--out", "vehicle.py")
    assert (code, err.splitlines()[0]) == (0, "use with care: yaw is not predicted; fly more yaw")


@pytest.mark.parametrize(
    ("result", "fragments"),
    [
        ("not JSON", ("found.json: not a JSON file", "jaxos4 estimate --out")),
        ({"log": "flight.csv"}, ("found.json: not a result", "estimator")),
        (
            {k: v for k, v in vehicle_result().items() if k != "airframe"},
            ("found.json: not a result", "this version's"),
        ),
        (vehicle_result(result="nonfinite_trajectory", covariance=None), ("nonfinite_trajectory", "no estimate")),
        (vehicle_result(result="unheard"), ("`result` unheard",)),
        (
            vehicle_result(model="corrected", provenance=provenance(channels="rates", windows=1)),
            ("`model` corrected", "--model flight"),
        ),
        (vehicle_result(covariance=8 * [[1.0], []]), ("`covariance`",)),
        (vehicle_result(covariance=(-np.eye(len(VALUES))).tolist()), ("`covariance`", "run `jaxos4 estimate` again")),
        (vehicle_result({}), ("holds no estimate",)),
        (vehicle_result(VALUES | {"alpha6": 0.0}), ("alpha6 is 0",)),
        (vehicle_result(airframe={"mass": 1.0}), ("found.json: `inertia`, `rotor_positions`", "are missing")),
        (vehicle_result(VALUES | {"alpha8": 1e4}), ("Iz = 0.00011 kg m^2 exceeds", "correct the airframe")),
        (vehicle_result(VALUES | {"alpha3": -6e4}), ("Ix", "not positive")),
        (vehicle_result(VALUES | {"thrust_gain": -1.0}), ("found.json: no vehicle is like this",)),
        (vehicle_result(VALUES | {"thrust_gain": 0.4}), ("rotor 1 can make 0 to 0.06 N", "correct the airframe")),
        (vehicle_result(VALUES | {"yaw_offset": 50.0}), ("hover needs -0.012 N",)),
        (vehicle_result(VALUES | {"thrust_curve": -1.1}), ("thrust_curve = -1.1",)),
    ],
)
def test_results_that_cannot_be_exported_are_refused(run, tmp_path, write, result, fragments):
    write(result)
    refused(run("export", "found.json", "--to", "mujoco", "--out", "vehicles", "--samples", "2"), *fragments)
    assert [path.name for path in tmp_path.iterdir()] == ["found.json"]


def test_another_simulator_is_named(write):
    with pytest.raises(jaxos4.InputError, match="`to`"):
        export_vehicle(read_result(write(vehicle_result())), "gazebo")
