"""The effects of real flights are flown, identified and drawn in a small configuration."""

import numpy as np
import pytest
from small_experiments import load


@pytest.mark.usefixtures("quickly_compiled")
def test_effects(tmp_path):
    effects, plots = load("closed_loop", "effects"), load("closed_loop", "plot_effects")
    out, cases = tmp_path / "out.json", {"flights": 1, "duration": 10.0, "effects": ["gusts", "clock"]}
    effects.main(**cases, out=out)
    plots.main(out, tmp_path / "figures")
    assert {path.suffix for path in (tmp_path / "figures").iterdir()} == {".svg", ".pdf"}
    report = plots.json.loads(out.read_text())
    for case in report["cases"]:
        assert [row["result"] for row in case["flights"]] == ["successful"]
        assert abs(case["summary"]["thrust"]["mean"]) < 0.05


def test_all_effects_are_drawn_at_random():
    effects = load("closed_loop", "effects")
    first, same, other = (effects.effect_of(effects.ALL, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first == same != other
    every = [effect._asdict() for effect in effects.EFFECTS.values()]
    for part in ("air", "sensors", "loop"):
        sizes = {name: size for effect in every for name, size in effect[part].items()}
        drawn = getattr(first, part)
        assert drawn.keys() == sizes.keys()
        assert all(value is None or abs(value) <= max(sizes[name], 0.02) for name, value in drawn.items())
