import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxos4
from jaxos4.airframe import OS4, PRESETS, alpha_from_inertia, load_airframe
from jaxos4.errors import InputError

GOOD = """
mass = 0.65
inertia = [7.5e-3, 7.0e-3, 1.3e-2]
arm = 0.23
thrust_coefficient = 3.13e-5
drag_coefficient = 7.5e-7
rotor_inertia = 6e-5
"""


@pytest.mark.parametrize(
    ("name", "expected", "arm"),
    [
        ("os4", (-0.73333, 6.0e-9, 133.33, 0.73333, 6.0e-9, 133.33, 0, 76.923), 0.23),
        ("os4-simulator", (-0.79994, 7.2375e-9, 160.565, 0.79994, 7.2375e-9, 160.565, 0, 89.206), 0.232),
        ("voos", (-0.81649, 7.7592e-10, 206.186, 0.81649, 7.7592e-10, 206.186, 0, 113.507), 0.2),
    ],
)
def test_presets_have_the_published_alpha_and_the_printed_mixer(name, expected, arm):
    """The alphas for OS4 are published, those for the others follow from their constants. Mixer: Eqs. (10)-(13)."""
    airframe = PRESETS[name]
    assert load_airframe(name) is airframe
    alpha = alpha_from_inertia(airframe.inertia, airframe.rotor_inertia * airframe.drag_coefficient)
    np.testing.assert_allclose(alpha, expected, rtol=2e-4)
    b, d = float(airframe.thrust_coefficient), float(airframe.drag_coefficient)
    printed = [[0, -arm * b, 0, arm * b], [-arm * b, 0, arm * b, 0], [-d, d, -d, d], [b, b, b, b]]
    np.testing.assert_allclose(airframe.mixer, printed, rtol=1e-12, atol=1e-20)


def test_hover_and_derivatives():
    np.testing.assert_allclose(alpha_from_inertia(OS4.inertia, OS4.rotor_inertia)[np.array([1, 4])], 8.0e-3)
    np.testing.assert_allclose(OS4.hover_speed, 225.7, atol=0.05)
    slope = jax.jit(jax.grad(lambda mass: eqx.tree_at(lambda a: a.mass, OS4, mass).hover_speed))(jnp.asarray(0.65))
    np.testing.assert_allclose(slope, OS4.hover_speed / (2 * 0.65), rtol=1e-12)

    def roll_authority(positions):
        return eqx.tree_at(lambda a: a.rotor_positions, OS4, positions).mixer[0, 3]

    slope = jax.grad(roll_authority)(jnp.asarray(OS4.rotor_positions))
    np.testing.assert_allclose(slope, np.array([[0, 0], [0, 0], [0, 0], [0, OS4.thrust_coefficient]]))


def test_toml_with_an_arm_and_with_positions(tmp_path):
    path = tmp_path / "quad.toml"
    path.write_text(GOOD)
    plus = eqx.tree_at(lambda a: a.inertia, OS4, np.array([7.5e-3, 7.0e-3, 1.3e-2]))
    assert eqx.tree_equal(load_airframe(path), plus, typematch=True)
    positions = "[[0.1, -0.1], [-0.1, -0.1], [-0.1, 0.1], [0.1, 0.1]]"
    rest = "rotor_spins = [-1, 1, -1, 1]\ngravity = 9.8\nmax_rotor_speed = 900"
    path.write_text(GOOD.replace("arm = 0.23", f"rotor_positions = {positions}\n{rest}"))
    airframe = load_airframe(str(path))
    np.testing.assert_array_equal(airframe.rotor_positions, [[0.1, -0.1], [-0.1, -0.1], [-0.1, 0.1], [0.1, 0.1]])
    np.testing.assert_array_equal(airframe.rotor_spins, [-1, 1, -1, 1])
    assert (airframe.gravity, airframe.max_rotor_speed) == (9.8, 900.0)


def test_guesses_and_the_hover_speed(tmp_path):
    path = tmp_path / "quad.toml"
    guesses = 'inertia = "guess"\ndrag_coefficient = "guess"\nrotor_inertia = "guess"\n'
    path.write_text(f"mass = 0.65\narm = 0.23\nhover_speed = 225.7\n{guesses}")
    airframe = load_airframe(path)
    np.testing.assert_allclose(airframe.hover_speed, 225.7, rtol=1e-12)
    np.testing.assert_allclose(airframe.thrust_coefficient, 3.13e-5, rtol=1e-3)
    square = 0.65 * 0.23**2
    np.testing.assert_allclose(airframe.inertia, [0.3 * square, 0.3 * square, 0.5 * square])
    np.testing.assert_allclose(airframe.rotor_inertia, 1e-3 * square)
    np.testing.assert_allclose(airframe.drag_coefficient, 0.023 * airframe.thrust_coefficient)


@pytest.mark.parametrize("name", PRESETS)
def test_guessed_inertias_are_within_40_percent(tmp_path, name):
    preset, path = PRESETS[name], tmp_path / "quad.toml"
    keys = {key: np.asarray(getattr(preset, key)).tolist() for key in ("mass", "rotor_positions", "drag_coefficient")}
    keys |= {"hover_speed": float(preset.hover_speed), "inertia": "guess", "rotor_inertia": 1e-5}
    path.write_text("\n".join(f"{key} = {json.dumps(value)}" for key, value in keys.items()))
    ratio = np.asarray(load_airframe(path).inertia) / np.asarray(preset.inertia)
    assert (np.abs(ratio - 1) < 0.4).all(), ratio


def _replaced(key, line):
    return "\n".join(line if row.startswith(f"{key} ") else row for row in GOOD.splitlines())


BAD = {
    "neither file nor preset": ("os4-simulator, voos, crazyflie", None),
    "missing": ("mass", _replaced("mass", "")),
    "no layout": ("rotor_positions", _replaced("arm", "")),
    "two layouts": ("arm", GOOD + "rotor_positions = [[1, 0], [0, -1], [-1, 0], [0, 1]]"),
    "unknown": ("colour", GOOD + "colour = 1"),
    "text": ("mass", _replaced("mass", 'mass = "heavy"')),
    "boolean": ("mass", _replaced("mass", "mass = true")),
    "not a number": ("one finite number", _replaced("mass", "mass = nan")),
    "zero": ("thrust_coefficient", _replaced("thrust_coefficient", "thrust_coefficient = 0")),
    "negative": ("drag_coefficient", _replaced("drag_coefficient", "drag_coefficient = -1e-7")),
    "negative arm": ("arm", _replaced("arm", "arm = -0.23")),
    "list for an arm": ("arm", _replaced("arm", "arm = [0.2, 0.2]")),
    "two inertias": ("inertia", _replaced("inertia", "inertia = [1e-3, 1e-3]")),
    "no rigid body": ("inertia", _replaced("inertia", "inertia = [1e-3, 1e-3, 1e-2]")),
    "ragged": ("rotor_positions", _replaced("arm", "rotor_positions = [[1, 0], [0], [-1, 0], [0, 1]]")),
    "one line": ("rotor_positions", _replaced("arm", "rotor_positions = [[1, 0], [2, 0], [-1, 0], [-2, 0]]")),
    "spins of 2": ("rotor_spins", GOOD + "rotor_spins = [2, -2, 2, -2]"),
    "no yaw": ("rotor_spins", GOOD + "rotor_spins = [1, 1, 1, 1]"),
    "negative speed": ("max_rotor_speed", GOOD + "max_rotor_speed = -1"),
    "no TOML": ("TOML", "mass: 0.65"),
    "two thrusts": ("hover_speed", GOOD + "hover_speed = 200"),
    "hovers at rest": ("hover_speed", _replaced("thrust_coefficient", "hover_speed = 0")),
    "hovers without mass": ("mass", _replaced("mass", "").replace("thrust_coefficient = 3.13e-5", "hover_speed = 200")),
    "guessed mass": ("mass", _replaced("mass", 'mass = "guess"')),
    "guessed without arms": ("rotor_positions", _replaced("arm", "rotor_positions = [[0, 0], [0, 0], [0, 0], [0, 0]]")),
}


@pytest.mark.parametrize(("key", "text"), BAD.values(), ids=BAD)
def test_unusable_toml_is_refused_in_one_line(tmp_path, key, text):
    path = tmp_path / "quad.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_airframe(path)
    message = str(caught.value)
    assert str(path) in message
    assert key in message
    assert "\n" not in message


@pytest.mark.parametrize("name", ["crazyflie", "crazyflie-brushless", "x500"])
def test_a_vehicle_to_start_from_can_hover_and_names_its_sources(name):
    airframe = load_airframe(name)
    assert 0.3 < airframe.hover_speed / airframe.max_rotor_speed < 0.85
    assert np.linalg.matrix_rank(np.asarray(airframe.mixer)) == 4
    text = (Path(jaxos4.__file__).parent / "airframes" / f"{name}.toml").read_text(encoding="utf-8")
    assert all("#" in line or '"guess"' in line for line in text.splitlines())
