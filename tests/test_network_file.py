"""The file of a network gives back the same network, and a damaged or foreign one is refused in one line."""

import json

import equinox as eqx
import numpy as np
import pytest
from helpers import same
from hypothesis import given, settings, strategies as st
from small_network import BRACKET, PUBLISHED, SMALL, problem_of, trained

import jaxos4


def test_a_file_gives_back_the_same_network(tmp_path):
    for number, network in enumerate((trained(), trained(free=True), trained(features="raw", steps=1))):
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


def test_a_model_of_ones_own_cannot_be_saved(tmp_path):
    class Own(PUBLISHED):
        pass

    network = eqx.tree_at(lambda n: n.features.problem.model, trained(), Own())
    with pytest.raises(ValueError, match="model Own; only networks for published, corrected can be saved"):
        jaxos4.save_network(network, tmp_path / "own.net")
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def network_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "whole.net"
    jaxos4.save_network(trained(), path)
    return path


@settings(max_examples=30)
@given(st.data())
def test_a_file_that_was_cut_or_altered_is_refused_or_harmless(network_file, data):
    content = bytearray(network_file.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = network_file.with_name("altered.net")
    path.write_bytes(content)
    message = ""
    try:
        jaxos4.load_network(path)
    except jaxos4.InputError as error:
        message = str(error)
    assert "\n" not in message


class Trap:
    def __reduce__(self):
        return (pytest.fail, ("the file was executed",))


def test_a_file_of_another_version_or_with_objects_is_refused_and_not_run(tmp_path, network_file):
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
