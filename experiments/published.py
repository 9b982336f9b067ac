"""Published results: the tables that a script printed, in a file with the command that made them, and in the pages.

    python -m experiments sample_times.run --flights 40 --publish sample_times
    python -m experiments render

A page has a table between `<!-- result: NAME / TITLE -->` and `<!-- end -->`. `render` writes there what the file says.
"""

import datetime
import functools
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

import jaxos4

ROOT = Path(__file__).parents[1]
FOLDER = Path(__file__).with_name("results")
PAGES = ROOT / "README.md", ROOT / "experiments" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))
_MARKED = re.compile(r"(<!-- result: (\S+) / ([^\n]+) -->)\n(.*?)(<!-- end -->|(?=<!-- result: )|\Z)", re.DOTALL)


class Table(msgspec.Struct):
    """A table as it was printed."""

    title: str
    headings: list[str]
    rows: list[list[str]]


class Result(msgspec.Struct):
    """What one run of a script printed, and what is needed to print it again.

    - `command`: after `python -m experiments`.
    - `settings`: all arguments of the script, with those that have their default: trials, seed.
    - `commit`: of the code that computed the rows; several if a run was continued by other code.
    - `machine`: device, cores, precision, version of JAX.
    """

    command: str
    settings: dict[str, Any]
    version: str
    commit: str
    machine: dict[str, Any]
    date: str
    tables: list[Table]


@functools.cache
def commit() -> str:
    """The commit that is checked out, with a + if files differ from it; empty outside of a repository."""
    if shutil.which("git") is None:
        return ""
    git = functools.partial(subprocess.run, cwd=ROOT, capture_output=True, text=True, check=False)
    found = git(["git", "rev-parse", "--short=10", "HEAD"]).stdout.strip()
    code = "jaxos4", "experiments", ":!experiments/results", ":!experiments/*.md"
    return found + "+" * bool(found and git(["git", "status", "--porcelain", "--", *code]).stdout)


class Recorder:
    """The tables and the settings of the script that runs in this process."""

    def __init__(self) -> None:
        self.tables: list[Table] = []
        self.settings: dict[str, Any] = {}
        self.commit = ""

    def watching(self, main: Callable[..., None]) -> Callable[..., None]:
        """The `main` of a script, whose arguments are kept."""

        @functools.wraps(main)
        def run(**arguments: Any) -> None:
            commit()  # of the code that runs, although a later one may be checked out when it ends
            self.settings = msgspec.to_builtins(arguments, enc_hook=str)
            main(**arguments)

        return run

    def publish(self, name: str, command: list[str], machine: dict[str, Any], folder: Path = FOLDER) -> None:
        """Writes the result file of what was printed. Ends the script if that was nothing."""
        if not self.tables:
            raise SystemExit(f"--publish {name}: the script printed no table.")
        found = Result(
            command=shlex.join(command),
            settings=self.settings,
            version=jaxos4.__version__,
            commit=self.commit or commit(),
            machine=machine,
            date=datetime.datetime.now(datetime.UTC).date().isoformat(),
            tables=self.tables,
        )
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.json").write_bytes(msgspec.json.format(msgspec.json.encode(found), indent=1) + b"\n")


RECORDER = Recorder()


def read(name: str, folder: Path = FOLDER) -> Result:
    """The published result of this name. `InputError`: there is none."""
    path = folder / f"{name}.json"
    if not path.is_file():
        raise jaxos4.InputError(f"{name}: no such result in {folder}; run its script with --publish {name}.")
    return msgspec.json.decode(path.read_bytes(), type=Result)


def markdown(name: str, title: str, folder: Path = FOLDER) -> str:
    """A table of a result for a page, with the command that prints it."""
    found = read(name, folder)
    table = next((table for table in found.tables if table.title == title), None)
    if table is None:
        titles = ", ".join(table.title for table in found.tables)
        raise SystemExit(f"{name}: has no table {title!r}; it has {titles}.")
    lines = [table.headings, ["---"] * len(table.headings), *table.rows]
    drawn = "\n".join(f"| {' | '.join(cell.replace('|', '/').replace('+-', '±') for cell in line)} |" for line in lines)
    about = f"version {found.version}, commit `{found.commit}`, {found.date}"
    return f"\n{drawn}\n\n`python -m experiments {found.command}` ({about})\n\n"


def rendered(page: str, folder: Path = FOLDER) -> str:
    """The text of a page with its tables of results as the files say. Ends the script if a table has no end."""

    def table(mark: re.Match[str]) -> str:
        if not mark[5]:
            raise SystemExit(f"{mark[1]}: has no <!-- end -->; write one after its table.")
        return f"{mark[1]}\n{markdown(mark[2], mark[3], folder)}{mark[5]}"

    return _MARKED.sub(table, page)


def shown(pages: tuple[Path, ...] = PAGES) -> Iterator[tuple[Path, str, str]]:
    """Page, name of the result, and title of each table in the pages."""
    for page in pages:
        yield from ((page, mark[2], mark[3]) for mark in _MARKED.finditer(page.read_text(encoding="utf-8")))


def render() -> None:
    """Writes the tables of all pages."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        if (new := rendered(text)) != text:
            page.write_text(new, encoding="utf-8")
            print(f"{page.relative_to(ROOT)}: written")
