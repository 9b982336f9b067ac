"""An estimator in one file and one line of the registry: every command offers it, and figures draw it in its style."""

import json

from small_study import finish, start

from jaxos4.estimators import ESTIMATORS
from jaxos4.report.style import styles

TOY = """
import sys
import equinox as eqx, jax.numpy as jnp
from jaxos4.bracket import GAUSSIAN_PRIOR
from jaxos4.estimate import AbstractEstimator, as_estimate, fit_start
from jaxos4.estimators import ESTIMATORS
from jaxos4.linalg import invert


class OneStep(AbstractEstimator):
    '''One Gauss-Newton step from the center of the bracket, which is a Gaussian prior.'''

    looks_at = "rates"
    shoots = False
    prior = GAUSSIAN_PRIOR
    needs_network = False

    @eqx.filter_jit
    def __call__(self, problem, bracket=None):
        problem = problem.within(bracket)
        box, count = problem.unknowns.usable, problem.unknowns.count
        view = problem.curvatures(box.center, problem.first_state()[0])
        information = view.information.sum(axis=0)[:count, :count] + jnp.diag(1 / box.half_width**2)
        covariance = invert(information)
        parameters = box.center - covariance @ view.gradient.sum(axis=0)[:count]
        initial_state, cost, sound, rollouts = fit_start(problem, parameters)
        return as_estimate(
            problem, parameters=parameters, covariance=covariance, initial_state=initial_state, cost=cost,
            rollouts=rollouts + count, sweeps=1, sound=sound, done=jnp.asarray(True), prior=self.prior,
        )


ESTIMATORS["toy"] = OneStep  # the line in the registry

from jaxos4.cli import main
from jaxos4.cli.studies import comparison

assert comparison(quick=False).estimators[-1] == "toy"
for line in open(sys.argv[1]):
    sys.argv = ["jaxos4", *line.split()]
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise
"""
STUDY = """
title = "A study with a new estimator"
durations = [1.0]
scales = [0.1]
channels = ["rates"]
estimators = ["toy"]
flights = 2
batch = 2
"""
COMMANDS = """study study.toml --out study --dry-run
study study.toml --out study
report study
simulate --duration 1 --out flight.csv
study study.toml --out study --dry-run
estimate flight.csv --estimator toy --channels rates --initial-state known --out toy.json
"""


def test_a_new_estimator_is_offered_everywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "commands").write_text(COMMANDS)
    said = finish(start("commands", code=TOY))
    assert said.count("toy") >= 3  # in both plans and in the table of the study
    assert "2 estimates: 2 successful" in said
    assert ["toy", "0", "0"] in [line.split() for line in said.splitlines()]  # nothing remains
    found = json.loads((tmp_path / "toy.json").read_text())
    assert (found["estimator"], found["result"]) == ("toy", "successful")
    assert "toy" in (tmp_path / "study/report.html").read_text()


def test_every_estimator_has_a_style_of_its_own_and_the_known_ones_keep_theirs():
    known = styles(list(ESTIMATORS))
    assert styles(["svsf"])["svsf"] == known["svsf"]
    toys = [f"toy {i}" for i in range(12)]
    for names in (["new", "newest"], ["new", "newer", "newest"], [*ESTIMATORS, "newest"], [*ESTIMATORS, *toys]):
        found = styles(names)
        assert len(set(found.values())) == len(found)
        assert all(found[name] == known[name] for name in names if name in known)
