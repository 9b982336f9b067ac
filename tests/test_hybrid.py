"""The hybrid finds what IBSS finds, whatever its network answers; and the files of networks."""

import json

import equinox as eqx
import jax
import msgspec
import numpy as np
import pytest
from helpers import DT, same, standard_flight
from hypothesis import given, settings
from lanes import LANES
from recorded_logs import ACCIDENTS, damaged
from small_network import BRACKET, CMAC, OMEGA, PUBLISHED, SHORT, SMALL, flights, identify, names, problem_of, trained
from strange import in_one_line

import jaxos4
from jaxos4.identification import fit
from jaxos4.identification.prepare_os4 import prepare_os4
from jaxos4.recording import Recording


@pytest.mark.slow
@pytest.mark.parametrize("seed", ["good", "cmac", "misses", "outside", "mismatch"])
def test_the_hybrid_finds_what_ibss_finds(seed):
    """Misses: the network was trained in another bracket. Outside: one truth lies outside of the network's bracket.

    Mismatch: it was not trained for so much noise, and answers nothing.
    """
    noise = 20.0 if seed == "mismatch" else 1.0
    network, (alpha, states) = trained(**(CMAC if seed == "cmac" else {})), flights(LANES, seed=18, noise=noise)
    if seed == "misses":
        aside = jaxos4.Bracket.around(BRACKET.center + 0.5 * BRACKET.half_width, 0.3 * BRACKET.half_width)
        network = jaxos4.NetworkEstimator(**(SMALL | {"steps": 100})).fit(problem_of(), aside, key=jax.random.key(0))
    if seed == "outside":
        flight = jaxos4.simulate(PUBLISHED(), BRACKET.center + 1.3 * BRACKET.half_width, OMEGA, dt=DT)
        noisy = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(22)).states
        assert names(network(problem_of(noisy), BRACKET)) in ("at_bound", "unidentifiable")
        states = states.at[5].set(noisy)
    hybrid, alone = (identify(e, states, noise, channels="all") for e in (jaxos4.Hybrid(network), jaxos4.IBSS()))
    assert names(hybrid) == names(alone)
    assert seed == "mismatch" or set(names(alone)) == {"successful"}
    assert np.abs((hybrid.parameters - alone.parameters) / alone.std).max() < 0.1
    hit = ((alpha >= hybrid.seed.lower) & (alpha <= hybrid.seed.upper)).all(axis=1)
    if seed in ("good", "cmac"):
        assert hybrid.rollouts.mean() < 0.5 * alone.rollouts.mean()
        assert hit.mean() > 0.95
        np.testing.assert_allclose(hybrid.std, alone.std, rtol=0.05)
    if seed == "misses":
        assert hit.mean() < 0.5
    if seed == "mismatch":
        assert set(names(identify(network, states, noise))) == {"network_mismatch"}
        assert (hybrid.rollouts >= alone.rollouts).all()


@pytest.mark.parametrize(("name", "channels"), [("network", "rates"), ("hybrid", "all")])
def test_a_network_is_trained_for_the_flight_and_a_search_keeps_all_channels(monkeypatch, name, channels):
    stages, network = [], trained(free=True, **SHORT)
    monkeypatch.setattr(fit, "network_for", lambda problem, bracket, *rest, **options: network)
    recording, nothing = Recording.of(standard_flight(duration=3.0), "flight.csv"), {"bracket": None, "validate": None}
    data, *known = prepare_os4((recording,), PUBLISHED(), jaxos4.OS4Settings(), estimator=name, network=None, **nothing)
    assert [*known, data.provenance.network] == [name, name, msgspec.UNSET]
    data, estimator = fit.os4_estimator(data, name, data.problem.unknowns.bracket, seed=0, progress=stages.append)
    assert (data.problem.channels, data.provenance.channels) == (channels, channels)
    assert data.likelihood is data.problem
    assert (estimator if name == "network" else estimator.network) is network
    assert data.provenance.network["settings"]["steps"] == SHORT["steps"]
    assert stages == ["training a network for this flight"]


@pytest.mark.slow
def test_the_hybrid_begins_at_the_initial_state_that_the_network_saw():
    """From the first measurement it takes 1.75 sweeps."""
    _, states = flights(LANES, seed=18)
    hybrid = identify(jaxos4.Hybrid(trained(free=True)), states, free=True)
    assert names(hybrid) == ["successful"] * LANES
    assert hybrid.sweeps.mean() < 1.2


OTHERS = {"free": True}, {"features": "raw", "steps": 1}, CMAC
KINDS = [{}, *(pytest.param(each, marks=pytest.mark.slow) for each in OTHERS)]


@pytest.mark.parametrize("changes", KINDS, ids=str)
def test_a_file_gives_back_the_same_network(changes, tmp_path):
    network, path = trained(**changes), tmp_path / "some.net"
    jaxos4.save_network(network, path)
    loaded, problem = jaxos4.load_network(path), problem_of(free="free" in changes)
    assert same(loaded(problem, BRACKET), network(problem, BRACKET))
    assert same(loaded.history, network.history)
    with np.load(path) as file:
        header = json.loads(str(file["header"]))
    assert header["version"] == jaxos4.__version__
    assert header["model"] == "published"
    assert header["settings"]["steps"] == (SMALL | changes)["steps"]


@pytest.fixture(scope="module")
def network_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "whole.net"
    jaxos4.save_network(trained(), path)
    return path


@pytest.mark.slow
@settings(max_examples=30)
@given(accidents=ACCIDENTS)
def test_a_damaged_file_is_refused_in_one_line_or_harmless(network_file, accidents):
    path = network_file.with_name("damaged.net")
    path.write_bytes(damaged(network_file.read_bytes(), accidents))
    in_one_line(jaxos4.load_network, path)


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


@pytest.mark.slow
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
