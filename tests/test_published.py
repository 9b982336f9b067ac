"""Published results: the tables of the pages are those of the result files, which are of this version."""

import pytest

import jaxos4
from experiments.__main__ import commands
from experiments.monte_carlo import machine, print_table
from experiments.published import FOLDER, PAGES, Recorder, read, rendered, shown
from jaxos4.errors import InputError

MINOR = jaxos4.__version__.split(".")[:2]


def test_every_table_of_a_page_is_that_of_its_result():
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert rendered(text) == text, f"{page}: python -m experiments render"


def test_every_result_is_shown_is_of_this_version_and_says_how_it_was_made():
    files = sorted(FOLDER.glob("*.json"))
    assert files
    assert {path.stem for path in files} == {name for _, name, _ in shown()}
    for path in files:
        found = read(path.stem)
        assert found.version.split(".")[:2] == MINOR
        assert all((found.command, found.commit, found.date, found.machine["cores"]))
    assert sum(path.stat().st_size for path in files) < 2e6


def test_what_a_script_prints_is_published_and_a_page_that_differs_is_seen(tmp_path):
    recorder = Recorder()

    def main(flights: int = 3, seed: int = 0) -> None:
        print_table("errors", ["flights", "error"], iter([(str(flights), "0.1 +- 0.2 %")]), tables=recorder.tables)

    recorder.watching(main)(flights=5, seed=1)
    recorder.publish("small", ["small.run", "--flights", "5"], machine(), tmp_path)
    found = read("small", tmp_path)
    assert (found.command, found.settings) == ("small.run --flights 5", {"flights": 5, "seed": 1})
    page = rendered("before\n<!-- result: small / errors -->\nold\n<!-- end -->\nafter\n", tmp_path)
    assert "| 5 | 0.1 ± 0.2 % |" in page
    assert "`python -m experiments small.run --flights 5`" in page
    assert rendered(page, tmp_path) == page
    changed = page.replace("0.2 %", "0.3 %")
    assert rendered(changed, tmp_path) != changed


def test_results_are_computed_again_by_their_own_commands(tmp_path):
    for name, flights in (("one", 1), ("two", 2)):
        recorder = Recorder()
        print_table("errors", ["flights"], [[str(flights)]], tables=recorder.tables)
        recorder.publish(name, ["small.run", "--cases", "two words", "--flights", str(flights)], machine(), tmp_path)
    one = ["small.run", "--cases", "two words", "--flights", "1", "--publish", "one"]
    assert commands(["one"], tmp_path) == {"one": one}
    assert list(commands(["all"], tmp_path)) == ["one", "two"]
    with pytest.raises(InputError, match="three: no such result"):
        commands(["three"], tmp_path)


def test_a_table_without_an_end_is_named_and_eats_no_text():
    page = "<!-- result: one / errors -->\ntext\n<!-- result: two / errors -->\n<!-- end -->\n"
    with pytest.raises(SystemExit, match="<!-- result: one / errors -->: has no <!-- end -->; write one"):
        rendered(page)
