"""Every command of the documentation: its parser accepts it, and those in blocks run, page by page."""

import re
import shlex
import shutil
import tomllib

import pytest
import typer
from helpers import ROOT, blocks
from typer.main import get_command

from experiments.__main__ import again, main_of, published, render, scripts
from experiments.sample_times.run import VEHICLE as CINERAT
from jaxos4.airframe import airframe_table
from jaxos4.cli._app import app
from jaxos4.estimators import ESTIMATORS

COMMANDS = get_command(app).commands
COMMAND = rf"(?:^|`)(jaxos4 (?:{'|'.join(COMMANDS)})\b[^`\n]*|python -m experiments \w[^`\n]*)"
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for pattern in ("README.md", ".github/*.md", "experiments/*.md", "docs/**/*.md")
    for path in sorted(ROOT.glob(pattern))
}
EXAMPLES = {r"NAME(?=.*study\.toml|\.plot)": "frontier", "NAME": "coverage"}  # of an experiment
# Pages whose commands run, in one folder: those of a later page use the files of an earlier one.
STORIES = {
    "start": ("docs/index.md", "README.md"),
    "drone": ("docs/drone.md", "docs/logs.md", "docs/method/filter_error.md", "docs/into_your_simulator.md"),
}
# Other commands in blocks, and why they do not run here.
ELSEWHERE = {
    r"python |jaxos4 (compare$|study|report results)": "hours: smaller ones in test_study*.py, test_experiments*.py",
    r".* (design|--speeds|--references) ": "minutes: test_design.py designs and flies shorter inputs",
    r".* (train|--network) ": "half a minute for a network: test_cli.py trains smaller ones",
    r".* flight\.(bag|log|ulg) |.* --columns ": "logs of other programs: test_logs_*.py",
    r".*(gauss-newton|friction)\b": "what a reader adds: test_documentation.py",
}
EXIT_CODES = {"--estimator output-error": 2}  # which the page shows; else 0
SHORTER = r"(?<=--duration )[36]0"  # seconds of a flight: a shorter one is fitted sooner


def commands(text: str) -> list[str]:
    """The commands of a text, each once, without comments."""
    lines = re.findall(COMMAND, text.replace("\\\n", " ").replace(" && ", "\n"), flags=re.MULTILINE)
    return list(dict.fromkeys(" ".join(line.split("#")[0].split()) for line in lines))


def in_blocks(page: str) -> list[str]:
    return commands("\n".join(blocks(ROOT / page)))


def merged(lines: list[str]) -> list[str]:
    """Estimates that differ only in the files that they write are one, which writes all of them."""
    found: dict[str, dict[str, None]] = {}
    for line in lines:
        options = r" --(?:out|report) \S+" if " estimate " in line else "$^"
        found.setdefault(re.sub(options, "", line), {}).update(dict.fromkeys(re.findall(options, line)))
    return [line + "".join(files) for line, files in found.items()]


def parser(line: str):
    """The parser of a command, and its arguments."""
    program, *words = shlex.split(line.removeprefix("python -m "))
    if program == "jaxos4":
        return COMMANDS[words[0]], words[1:]
    own = {"render": render, "again": again}
    assert words[0] in (*scripts(), *own)
    published(words)
    script = typer.Typer()
    script.command()(own.get(words[0]) or main_of(words[0]))
    return get_command(script), words[1:]


def test_every_command_is_accepted_by_its_parser(monkeypatch):
    monkeypatch.setitem(ESTIMATORS.data, "gauss-newton", None)  # which a page adds
    every = {line for text in PAGES.values() for line in commands(text)}
    assert len(every) > 100
    for line in sorted(every):
        for name, example in EXAMPLES.items():
            line = re.sub(name, example, line)
        command, arguments = parser(line)
        try:
            command.make_context(line, arguments)
        except typer.BadParameter as error:
            if type(error).__name__ != "MissingParameter":  # a text may name a command with a single option
                raise


def test_every_command_in_a_block_runs_here_or_elsewhere():
    told = {line for pages in STORIES.values() for page in pages for line in in_blocks(page)}
    others = {line for page in PAGES for line in in_blocks(page)} - told
    assert {line for line in others if not any(re.match(pattern, line) for pattern in ELSEWHERE)} == set()


def filled_in(airframe: str, vehicle: dict) -> str:
    """An airframe that `inspect` began, with what the reader weighs and measures."""
    for name in ("mass", "rotor_positions"):
        airframe = re.sub(rf"^# {name} = .*$", f"{name} = {vehicle[name]}", airframe, flags=re.MULTILINE)
    return airframe


def in_words(text: str) -> str:
    """A text on one line, without its numbers, whose last digits depend on how a program was compiled."""
    return re.sub(r"[\d.]*\d", "#", " ".join(text.split()))


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("story", STORIES)
def test_the_commands_of_pages_run(story, run, tmp_path, request):
    complete, (own,) = blocks(ROOT / "docs/index.md", "toml"), blocks(ROOT / "docs/drone.md", "toml")[-1:]
    (tmp_path / "vehicle.toml").write_text(own)
    mine, vehicle = tmp_path / "mine.toml", tomllib.loads(own)
    if story == "start":
        mine.write_text(*complete)
        vehicle = airframe_table(CINERAT)
    every = dict.fromkeys(line for page in STORIES[story] for line in in_blocks(page))
    here = [re.sub(SHORTER, "20", line) for line in every if not any(re.match(each, line) for each in ELSEWHERE)]
    said = ""
    # A page shows what comes of a simulated flight before it says how to simulate one.
    for line in sorted(merged(here), key=lambda line: "simulate --closed-loop" not in line):
        if line.startswith("jaxos4 inspect mylog.bbl"):  # a test without real flights skips here
            shutil.copy(request.getfixturevalue("shared_flights") / "cinerat/cinerat_281.csv", tmp_path / "mylog.bbl")
            mine.unlink()
        code, out, err = run(*shlex.split(line)[1:])
        assert code == next((code for option, code in EXIT_CODES.items() if option in line), 0), (line, err)
        said += " ".join(out.split())
        if "--airframe-out" in line:
            mine.write_text(filled_in(mine.read_text(), vehicle))
    if story == "start":
        # Verdicts are those that the README shows, and reasons those of the page with the whole.
        (verdicts,) = re.findall(
            r"^[^\n]*: identified\..*?(?=^quantity)", PAGES["README.md"], flags=re.DOTALL | re.MULTILINE
        )
        assert " ".join(verdicts.split()) in said
        (whole,) = (block for block in blocks(ROOT / "docs/drone.md") if block.startswith(verdicts))
        assert in_words(whole[whole.index("predictions: better") : whole.index("note:")]) in in_words(said)
        # The Python of the README identifies the same flight.
        (code,) = blocks(ROOT / "README.md", "python")
        exec(code, {})  # noqa: S102
        printed = request.getfixturevalue("capsys").readouterr().out
        assert re.search(r"\nidentified \(0\.0\d+, 0\.0\d+\)\n$", printed)
