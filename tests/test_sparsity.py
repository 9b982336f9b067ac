"""What the structure of a model leaves out of the information is zero, and all else is summed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import standard_flight

import jaxos4
from jaxos4.models.state import unstack
from jaxos4.shooting.sparsity import dependence, panels_of

PUBLISHED, FED_BACK = jaxos4.PublishedOS4(), jaxos4.FlightModel(jaxos4.OS4, terms=("velocity",))


def problem_of(model, method="euler"):
    return jaxos4.ShootingProblem(model, standard_flight(duration=0.3), sigma=jaxos4.SENSOR_SIGMA, method=method)


def structure_of(problem):
    """The number of unknowns that act on more than the translation, and the outputs of each unknown."""
    forcing = jax.tree.map(lambda leaf: leaf[0, 0], problem.rows().forcing)
    at = unstack(jnp.zeros(12)), forcing, tuple(problem.model.alpha)
    cut, panels = panels_of(problem._advance, at, problem.model.forcing_parameters, free=True)
    return cut, [set(outputs) for top, end, outputs in panels for _ in range(top, end)]


def test_results_depend_on_what_their_operations_read():
    inner = jax.jit(lambda a, b: (a + 1, b))
    found = dependence(lambda a, b, c: (a * b, 2.0, c, *inner(a, c)), 1.0, 1.0, 1.0)
    assert found.astype(int).tolist() == [[1, 1, 0], [0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 0, 1]]


def test_levels_of_the_cascade_do_not_feed_back_unless_the_velocity_makes_torque():
    cut, outputs = structure_of(problem_of(PUBLISHED))
    assert cut == 14
    assert sum(len(on) * (row + 1) for row, on in enumerate(outputs)) == 1246  # of 12 * 210 products
    assert outputs[:11] == [set(range(12))] * 11
    assert outputs[11:] == [{*range(3, 12)}] * 2 + [{5, 6, 7, 8, 9}, {6}, {6, 7}, {8}, {8, 9}, {10}, {10, 11}]
    cut, outputs = structure_of(problem_of(FED_BACK))
    assert cut == len(outputs)


@pytest.mark.parametrize(
    ("model", "method"), [(PUBLISHED, "euler"), (jaxos4.CorrectedOS4(), "rk4"), (FED_BACK, "euler")]
)
def test_gradient_and_information_of_a_batch_are_those_of_the_dense_derivative(model, method):
    problem, count = problem_of(model, method), len(model.parameter_names)
    one = np.concatenate([1.03 * model.alpha + 1e-3, problem.first_state()[0] + 0.01])
    points = jnp.asarray([one, 1.01 * one])

    def residuals(u):
        found = problem.residuals(u[:count], u[count:])
        return found, found

    jacobian, errors = map(np.asarray, jax.jit(jax.vmap(jax.jacfwd(residuals, has_aux=True)))(points))
    found = jax.jit(jax.vmap(lambda u: problem.local_model(problem.join(u[:count], u[count:]))))(points)
    scale = np.linalg.norm(jacobian, axis=1)[:, None]
    scale = np.where(scale > 0, scale, 1.0)
    unit, size = jacobian / scale, np.linalg.norm(errors, axis=1)[:, None]
    np.testing.assert_allclose(
        found.information[:, 0] / (scale.swapaxes(1, 2) * scale), unit.swapaxes(1, 2) @ unit, atol=1e-12
    )
    slopes = np.einsum("lrn,lr->ln", unit, errors / size)
    np.testing.assert_allclose(found.gradient[:, 0] / scale[:, 0] / size, slopes, atol=1e-12)
    acting = np.abs(jacobian).reshape(-1, 12, points.shape[1]).max(axis=0) > 0
    for unknown, outputs in enumerate(structure_of(problem)[1]):
        assert set(np.flatnonzero(acting[:, unknown])) <= outputs
