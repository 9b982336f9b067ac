"""A trained network as one file: a zip of NumPy arrays and a header in JSON. Reading it runs no code from it."""

import dataclasses
import io
import json
import os
import zipfile
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._custom_types import as_float
from .._files import at_once, check_plain, reading, write_file
from .._version import __version__
from ..airframe import airframe_from_table, airframe_table
from ..bracket import Bracket
from ..errors import InputError, named
from ..flight import Flight
from ..models import MODELS
from ..shooting import ShootingProblem
from .architecture import LEVELS, ErrorTable, Regressor, Scaling, calibrated_scales
from .estimator import NetworkEstimator, TrainedNetwork
from .features import Coordinates, Features

_REMEDY = "train it again with `jaxos4 train`"
_FORMAT = 5
_BEFORE = 4  # without architectures: all networks are perceptrons


def save_network(network: TrainedNetwork, path: str | os.PathLike[str]) -> None:
    """Writes the file of a network. Raises as `encode_network` does; `OSError` if the file cannot be written."""
    write_file(path, encode_network(network))


def encode_network(network: TrainedNetwork) -> bytes:
    """The bytes of a network's file, with its problem of training. Raises `ValueError` for a model not in `MODELS`."""
    problem = network.problem
    kinds = {kind: name for name, kind in MODELS.items()}
    if type(problem.model) not in kinds:
        name, known = type(problem.model).__name__, ", ".join(MODELS)
        raise ValueError(f"`network` is for the model {name}; only networks for {known} can be saved.")
    header = {
        "format": _FORMAT,
        "version": __version__,
        "settings": dataclasses.asdict(network.settings),
        "model": kinds[type(problem.model)],
        "method": problem.method,
        "windows": problem.windows,
        "checks": network.history.shape[0],
    }
    constants = airframe_table(problem.model.airframe)
    header["guessed"] = constants.pop("guessed", [])
    arrays = {f"airframe.{name}": value for name, value in constants.items()}
    arrays |= {name: getattr(problem.flight, name) for name in ("time", "omega", "states")}
    arrays["sigma"] = problem.sigma
    if problem.initial_state is not None:
        arrays["initial_state"] = problem.initial_state
    without_problem = eqx.tree_at(lambda n: n.features.problem, network, None)
    leaves = jax.tree_util.tree_leaves_with_path(eqx.filter(without_problem, eqx.is_array))
    arrays |= {_name(leaf_path): leaf for leaf_path, leaf in leaves}
    file = io.BytesIO()
    np.savez(file, header=np.asarray(json.dumps(header)), **jax.tree.map(np.asarray, arrays))  # pyright: ignore[reportArgumentType]
    return file.getvalue()


def load_network(path: str | os.PathLike[str] | io.BytesIO) -> TrainedNetwork:
    """Reads a file of `save_network`, by its path or open. Raises `InputError` for any other file, or `OSError`."""
    if isinstance(path, io.BytesIO):
        content = path
    else:
        with open(path, "rb", opener=at_once) as file:
            content = io.BytesIO(file.read())
    place = "the network" if isinstance(path, io.BytesIO) else path
    with reading(place, "not a whole network file", _REMEDY):
        with zipfile.ZipFile(content) as archive:
            if sum(each.file_size for each in archive.infolist()) > content.getbuffer().nbytes:
                raise ValueError("it announces more than it holds")
        with np.load(content, allow_pickle=False) as file:
            return _restore(place, {name: file[name] for name in file.files})


def _restore(place: object, arrays: dict[str, np.ndarray]) -> TrainedNetwork:
    header = json.loads(str(arrays["header"]))
    if header["format"] == _BEFORE:
        arrays = {name.replace(".perceptron", ".correction"): array for name, array in arrays.items()}
    elif header["format"] != _FORMAT:
        raise InputError(f"{place}: trained by another version of jaxos4; {_REMEDY}.")
    check_plain(place, header, _REMEDY)
    settings = NetworkEstimator(**header["settings"] | {"noise": tuple(header["settings"]["noise"])})
    if any(array.dtype.kind not in "fiu" for name, array in arrays.items() if name != "header"):
        raise ValueError("an array holds no numbers")
    largest = max(settings.shape.values())
    if settings.depth > len(arrays) or largest > max(map(np.size, arrays.values())):
        raise ValueError("its layers are not those of its settings")
    with named(place):
        # Files of earlier versions lack what has a default.
        constants = {name.removeprefix("airframe."): value for name, value in arrays.items() if "airframe." in name}
        airframe = airframe_from_table(constants | {"guessed": header.get("guessed", [])})
    problem = ShootingProblem(
        MODELS[header["model"]](airframe),
        Flight(arrays["time"], arrays["omega"], arrays["states"]),
        sigma=arrays["sigma"],
        initial_state=arrays.get("initial_state"),
        channels=settings.channels,
        method=header["method"],
        windows=header["windows"],
    )
    blank = eqx.filter_eval_shape(lambda p: _blank(settings, p, header["checks"]), problem)
    given = problem, jnp.asarray(arrays["network.key"], dtype=jnp.uint32)  # the size of a key depends on its kind
    blank = eqx.tree_at(lambda n: (n.features.problem, n.key), blank, given)

    def fill(place: tuple, leaf: Any) -> Any:
        if not isinstance(leaf, jax.ShapeDtypeStruct):
            return leaf
        value = arrays[_name(place)]
        if value.shape != leaf.shape:
            raise ValueError(f"{_name(place)} has shape {value.shape}, expected {leaf.shape}")
        return as_float(value) if jnp.issubdtype(leaf.dtype, jnp.floating) else jnp.asarray(value, leaf.dtype)

    return jax.tree_util.tree_map_with_path(fill, blank)


def _blank(settings: NetworkEstimator, problem: ShootingProblem, checks: int) -> TrainedNetwork:
    """A network with the shapes of a trained one and no values."""
    parameters, scales = len(problem.model.parameter_names), calibrated_scales(settings.noise)
    coordinates = Coordinates.of(problem, Bracket.default(problem.model), as_float(1.0))
    features = Features.blank(settings.features, problem, coordinates)
    key, unknowns = jax.random.key(0), coordinates.center
    linear_map = jnp.zeros((unknowns.size, features.size))
    regressor = Regressor(linear_map, settings.architecture, settings.shape, key=key)
    shapes = ((parameters,), (parameters, parameters), (len(LEVELS), parameters), (len(LEVELS),))
    errors = ErrorTable(scales, *(jnp.zeros((scales.size, *shape)) for shape in shapes))
    scaling = Scaling(linear_map[0], unknowns, unknowns, scales[0])
    history = jnp.zeros((checks, 2))
    return TrainedNetwork(settings, features, scaling, regressor, errors, history, jax.random.key_data(key))


def _name(path: tuple) -> str:
    return "network" + jax.tree_util.keystr(path)
