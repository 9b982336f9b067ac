"""Exported descriptions: mass, inertia and rotors in XML (SDF, URDF, MuJoCo), and names that are no code or markup."""

import xml.etree.ElementTree as ElementTree

import msgspec
import numpy as np
import pytest
from flight_csvs import write_log
from hypothesis import given, settings, strategies as st
from strange import parsed
from synthetic_results import vehicle_result

from jaxos4.export import TARGETS, export_vehicle, read_result
from jaxos4.identification.verdict import Issue
from jaxos4.recording import read_recording
from jaxos4.recording.inspection import airframe_draft


def described(write, target):
    """A vehicle, and the root element of its description."""
    found = read_result(write(vehicle_result()))
    return found, ElementTree.fromstring(export_vehicle(found, target).text)


def test_a_model_of_mujoco_has_four_controls(write):
    actuators = described(write, "mujoco")[1].findall("actuator/general")
    assert [each.get("name") for each in actuators] == ["thrust1", "thrust2", "thrust3", "thrust4"]


def test_an_urdf_has_the_mass_the_inertia_and_the_rotors(write):
    found, robot = described(write, "urdf")
    inertia = robot.find("link/inertial/inertia")
    np.testing.assert_allclose([float(inertia.get(name)) for name in ("ixx", "iyy", "izz")], found.vehicle.inertia)
    assert float(robot.find("link/inertial/mass").get("value")) == found.vehicle.mass
    places = [[float(x) for x in joint.find("origin").get("xyz").split()] for joint in robot.findall("joint")]
    np.testing.assert_allclose(np.array(places)[:, :2], found.vehicle.rotor_positions)
    links = {link.get("name") for link in robot.findall("link")}
    assert {joint.find("child").get("link") for joint in robot.findall("joint")} == links - {"base_link"}


def test_an_sdf_is_valid_and_has_the_inertia(write):
    """The rules of the SDF 1.9 schema for the elements that are written."""
    found, root = described(write, "sdf")
    (model,) = root
    links, joints, plugins = (model.findall(tag) for tag in ("link", "joint", "plugin"))
    assert (root.tag, len(links) + len(joints) + len(plugins)) == ("sdf", len(model))
    assert len({element.get("name") for element in (*links, *joints)}) == 9
    masses, centers, tensors = zip(*map(inertial, links), strict=True)
    for number, (plugin, joint, link) in enumerate(zip(plugins, joints, links[1:], strict=True)):
        parts = (joint.get("type"), *(joint.findtext(part) for part in ("parent", "child", "axis/xyz")))
        assert parts == ("revolute", "body", link.get("name"), "0 0 1")
        assert plugin.get("filename") == "gz-sim-multicopter-motor-model-system"
        assert plugin.get("name") == "gz::sim::systems::MulticopterMotorModel"
        tags = ("jointName", "linkName", "turningDirection", "motorNumber")
        names = (joint.get("name"), link.get("name"), ("ccw", "cw")[number % 2], str(number))
        assert tuple(map(plugin.findtext, tags)) == names
        moment = vector(plugin, "momentConstant") * vector(plugin, "motorConstant")
        assert moment == pytest.approx(1.1 * 1.2e-10)
        lags = [vector(plugin, f"timeConstant{way}") for way in ("Up", "Down")]
        np.testing.assert_allclose(lags, found.vehicle.lag, rtol=1e-3)
    assert vector(links[0], "collision/geometry/box/size").min() > 0  # it can stand on the ground
    # All links together are the vehicle.
    mass = np.array(masses)
    np.testing.assert_allclose(mass.sum(), found.vehicle.mass, rtol=1e-12)
    np.testing.assert_allclose(mass @ np.array(centers), 0, atol=1e-15)
    apart = [m * (c @ c * np.eye(3) - np.outer(c, c)) for m, c in zip(masses, centers, strict=True)]
    np.testing.assert_allclose(sum(tensors) + sum(apart), np.diag(found.vehicle.inertia), rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(np.array(centers)[1:, :2], found.vehicle.rotor_positions, rtol=1e-15)


def vector(element, path):
    """The numbers in an element; a number if it is one."""
    found = np.array((element.findtext(path) or "").split(), dtype=float)
    return found if found.size > 1 else found[0]


def inertial(link):
    """Mass, centre of mass in the frame of the model, and inertia of a link that a rigid body can be."""
    mass, center = vector(link, "inertial/mass"), vector(link, "inertial/pose")
    pose = np.zeros(6) if link.find("pose") is None else vector(link, "pose")
    assert not np.concatenate([pose[3:], center[3:]]).any()
    terms = {name: vector(link, f"inertial/inertia/{name}") for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")}
    tensor = np.array([[terms["".join(("i", *sorted((a, b))))] for a in "xyz"] for b in "xyz"])
    moments = np.linalg.eigvalsh(tensor)
    assert min(mass, *moments) > 0
    assert 2 * moments.max() <= moments.sum() * (1 + 1e-12)
    return mass, (pose + center)[:3], tensor


# Texts in exported files and drafts

HOSTILE = ['"""', "'''", "-->", "--->", "]]>", "<!--", "</mujoco>", "&", "&lt;", "<", '"', "\\", "\\u000a", "#", "--"]
HOSTILE += ["coding: unicode_escape", "-*- coding: utf-7 -*-", "\nimport os", "\r", "\x0c", "\x85", "\u2028", "\x1b[2J"]
HOSTILE += ["\udcff", "\ufffe", "{{ 1 }}", "{% raw %}", "é", "\u202e", "mass = 1", "{}", "%s", " ", "'", "b" * 40]
NAMES = st.lists(st.sampled_from(HOSTILE), min_size=1, max_size=4).map("".join)


@pytest.mark.slow
def test_hostile_names_are_in_comments_alone(tmp_path, write):
    found = read_result(write(vehicle_result()))
    usual = {target: parsed(export_vehicle(found, target).text, target) for target in TARGETS}

    @given(name=NAMES)
    @settings(max_examples=200)
    def law(name):
        refused = msgspec.structs.replace(
            found.identification, result="no_skill", issues=(Issue("no_skill", name, name),)
        )
        hostile = found._replace(source=name, identification=refused, notes=(name, f"Note: {name}"))
        for target in TARGETS:
            written = export_vehicle(hostile, target)
            assert parsed(written.text, target) == usual[target]
            assert all(note.isprintable() for note in written.notes[2:])

    law()
    log = read_recording(write_log(tmp_path / "flight.csv"))
    usual = airframe_draft(log)[0].splitlines()
    for name in HOSTILE:
        first, *others = airframe_draft(log._replace(name=name))[0].splitlines()
        assert first.isprintable()
        assert others == usual[1:]
