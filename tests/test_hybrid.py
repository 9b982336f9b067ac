"""The hybrid finds what IBSS finds, whatever its network answers; and the files of networks."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DT, same
from hypothesis import given, settings, strategies as st
from lanes import LANES
from small_network import BRACKET, CMAC, OMEGA, PUBLISHED, SMALL, flights, identify, names, problem_of, trained

import jaxos4
from jaxos4.estimators.hybrid import search_from_seed

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", ["good", "misses", "outside"])
def test_the_hybrid_finds_what_ibss_finds(seed):
    """Misses: the network was trained in another bracket. Outside: one truth lies outside of the network's bracket."""
    network, (alpha, states) = trained(), flights(LANES, seed=18)
    if seed == "misses":
        aside = jaxos4.Bracket.around(BRACKET.center + 0.5 * BRACKET.half_width, 0.3 * BRACKET.half_width)
        network = jaxos4.NetworkEstimator(**(SMALL | {"steps": 100})).fit(problem_of(), aside, key=jax.random.key(0))
    if seed == "outside":
        flight = jaxos4.simulate(PUBLISHED(), BRACKET.center + 1.3 * BRACKET.half_width, OMEGA, dt=DT)
        noisy = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(22)).states
        assert names(network(problem_of(noisy), BRACKET)) in ("at_bound", "unidentifiable")
        states = states.at[5].set(noisy)
    hybrid, alone = (identify(e, states, channels="all") for e in (jaxos4.Hybrid(network), jaxos4.IBSS()))
    assert names(hybrid) == names(alone) == ["successful"] * LANES
    assert np.abs((hybrid.parameters - alone.parameters) / alone.std).max() < 0.1
    hit = ((alpha >= hybrid.seed.lower) & (alpha <= hybrid.seed.upper)).all(axis=1)
    if seed == "good":
        assert hybrid.rollouts.mean() < 0.5 * alone.rollouts.mean()
        assert hit.mean() > 0.95
    if seed == "misses":
        assert hit.mean() < 0.5


def test_the_hybrid_begins_at_the_initial_state_that_the_network_saw():
    """From the first measurement it takes 1.75 sweeps."""
    _, states = flights(LANES, seed=18)
    hybrid = identify(jaxos4.Hybrid(trained(free=True)), states, free=True)
    assert names(hybrid) == ["successful"] * LANES
    assert hybrid.sweeps.mean() < 1.2


def seed_of(result, parameters=BRACKET.center, std=np.inf):
    covariance = np.full((8, 8), np.inf) if np.isinf(std).all() else np.diag(np.square(std))
    numbers = {"parameters": parameters, "covariance": covariance, "initial_state": np.zeros(3)}
    numbers |= {"cost": np.asarray(np.inf), "rollouts": np.asarray(1), "sweeps": np.asarray(0)}
    return jaxos4.Estimate(result=result, **{name: jnp.asarray(value) for name, value in numbers.items()})


@eqx.filter_jit
def seeded(states, seeds):
    @jax.vmap
    def searched(states, seed):
        return search_from_seed(jaxos4.IBSS(), problem_of(states, channels="all").within(BRACKET), seed)

    return searched(states, seeds)


def test_a_seed_without_an_answer_is_never_passed_on():
    """A seed with a small error that is wrong is not believed either."""
    (alpha, states), half_width, nothing = flights(LANES, seed=21), np.asarray(BRACKET.half_width), np.full(8, np.inf)
    wrong = ("network_mismatch", "nonfinite_trajectory", "unidentifiable", "at_bound")
    seeds = [seed_of(getattr(jaxos4.RESULTS, name), std=nothing) for name in wrong[:3]]
    seeds += [seed_of(jaxos4.RESULTS.at_bound, std=1e-3 * half_width)]
    near_the_truth = seed_of(jaxos4.RESULTS.successful, alpha[4], 1e-2 * half_width)
    stack = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *seeds, near_the_truth)
    found, best = seeded(states[:5], stack), identify(jaxos4.IBSS(), states, channels="all")
    assert names(found) == ["successful"] * 5
    assert best.calibration is None
    assert np.abs((found.parameters[:4] - best.parameters[:4]) / best.std[:4]).max() < 0.1
    assert (found.rollouts[:4] > found.rollouts[4]).all()


def test_half_widths_are_gaussian_unless_calibrated():
    estimate = seed_of(jaxos4.RESULTS.successful, std=np.asarray(BRACKET.half_width))
    np.testing.assert_allclose(estimate.half_width(0.95), 1.959963985 * estimate.std, rtol=1e-8)
    assert (estimate.half_width(0.95, simultaneous=True) > estimate.half_width(0.95)).all()
    for level in (0.0, 1.0, -1.0, 95.0):
        with pytest.raises(ValueError, match="`level` must lie between 0 and 1"):
            estimate.half_width(level)


def test_a_file_gives_back_the_same_network(tmp_path):
    others = trained(features="raw", steps=1), trained(**CMAC)
    for number, network in enumerate((trained(), trained(free=True), *others)):
        path = tmp_path / f"{number}.net"
        jaxos4.save_network(network, path)
        loaded, problem = jaxos4.load_network(path), problem_of(free=number == 1)
        assert same(loaded(problem, BRACKET), network(problem, BRACKET))
        assert same(loaded.history, network.history)
    with np.load(tmp_path / "0.net") as file:
        header = json.loads(str(file["header"]))
    assert header["version"] == jaxos4.__version__
    assert header["model"] == "published"
    assert header["settings"]["steps"] == SMALL["steps"]


@pytest.fixture(scope="module")
def network_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "whole.net"
    jaxos4.save_network(trained(), path)
    return path


@settings(max_examples=30)
@given(st.data())
def test_a_file_that_was_cut_or_altered_is_refused_or_harmless(network_file, data):
    content, path = bytearray(network_file.read_bytes()), network_file.with_name("altered.net")
    place = st.integers(0, len(content) - 1)
    if data.draw(st.booleans()):
        content = content[: data.draw(place)]
    else:
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(place)] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    message = ""
    try:
        jaxos4.load_network(path)
    except jaxos4.InputError as error:
        message = str(error)
    assert "\n" not in message


def test_a_file_from_before_there_were_architectures_opens(tmp_path, network_file):
    with np.load(network_file) as file:
        arrays = {name.replace("correction", "perceptron"): array for name, array in file.items()}
    header = json.loads(str(arrays["header"])) | {"format": 4}
    for name in ("architecture", "tilings", "cells"):
        del header["settings"][name]
    np.savez(tmp_path / "old.npz", **(arrays | {"header": np.asarray(json.dumps(header))}))
    assert same(jaxos4.load_network(tmp_path / "old.npz"), trained())


class Trap:
    def __reduce__(self):
        return (pytest.fail, ("the file was executed",))


def test_a_file_of_another_version_or_with_objects_or_a_model_of_ones_own_is_refused(tmp_path, network_file):
    path = tmp_path / "made.npz"
    with np.load(network_file) as file:
        arrays = dict(file)
    old = np.asarray(json.dumps(json.loads(str(arrays["header"])) | {"format": 2}))
    for content, words in (
        (arrays | {"header": old}, "trained by another version of jaxos4"),
        ({"header": np.array([Trap()], dtype=object)}, "not a whole network file"),
    ):
        np.savez(path, **content)
        with pytest.raises(jaxos4.InputError, match=words):
            jaxos4.load_network(path)
    own = type("Own", (PUBLISHED,), {})
    network = eqx.tree_at(lambda n: n.features.problem.model, trained(), own())
    with pytest.raises(ValueError, match="model Own; only networks for published, corrected can be saved"):
        jaxos4.save_network(network, tmp_path / "own.net")
    assert [each.name for each in tmp_path.iterdir()] == ["made.npz"]
