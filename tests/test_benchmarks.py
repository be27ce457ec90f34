"""The page of benchmarks/ lists every script, and what pages say of scripts is so."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from rigs.files.page_tables import PageTable
from rigs.files.places import ROOT

FOLDER = ROOT / "benchmarks"
PAGE = (FOLDER / "README.md").read_text(encoding="utf-8")
DURATIONS = {"seconds", "a minute", "ten minutes", "an hour", "hours"}
"""How long a script takes, as the page says it."""
ROW = re.compile(
    r"^\| `((?:python -m|pytest) [^`]+)` \|([^|]+)\| ([^|]+) \|(.+)\|$", re.MULTILINE
)
HELPER = re.compile(r"^\| `([\w/]+\.py)` \|", re.MULTILINE)
LINK = re.compile(r"\]\(([^)]+)\)")
QUOTED = re.compile(r'"([^"]+)"')
SCRIPT_NAME = re.compile(r"(?<![\w.])(?:benchmarks|rigs)(?:[./](?!__)\w+)+")
TEXTS = sorted(
    [
        *ROOT.glob("*.md"),
        ROOT / "pyproject.toml",
        ROOT / ".ci" / "run",
        *(
            path
            for folder in ("docs", "benchmarks", "rigs", "robot_sysid", "tests")
            for kind in ("md", "py")
            for path in (ROOT / folder).rglob(f"*.{kind}")
        ),
    ]
)


def script_path(command: str) -> str:
    """Return the file that a command of the page runs, relative to benchmarks/."""
    words = command.split()
    if words[0] == "pytest":
        path = ROOT / words[1]
        path = path if path.is_file() else only_test(path)
    else:
        path = ROOT.joinpath(*words[2].split("."))
        path = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
    return path.relative_to(FOLDER).as_posix()


def only_test(folder: Path) -> Path:
    """Return the one file of tests in a folder."""
    (path,) = folder.glob("test_*.py")
    return path


ROWS = {script_path(row[0]): row for row in ROW.findall(PAGE)}
HELPERS = HELPER.findall(PAGE)


def source(script: str) -> str:
    """Return the text of a script."""
    return (FOLDER / script).read_text(encoding="utf-8")


def scripts() -> set[str]:
    """Return all scripts but modules of a package that is run as a whole."""
    paths = {path for path in FOLDER.rglob("*.py") if path.name != "__init__.py"}
    packages = {path.parent for path in paths if path.name == "__main__.py"}
    inner = {
        path
        for path in paths
        if path.parent in packages and not path.name.startswith(("__main__", "test_"))
    }
    return {path.relative_to(FOLDER).as_posix() for path in paths - inner}


def test_the_page_lists_every_script_once():
    assert len(ROWS) == len(ROW.findall(PAGE)) > 30
    assert sorted([*ROWS, *HELPERS]) == sorted(scripts())


def test_the_headings_are_the_folders():
    headings = re.findall(r"^## (\w+):", PAGE, re.MULTILINE)
    folders = {script.partition("/")[0] for script in scripts()}
    assert {heading.lower() for heading in headings} == folders
    sections = re.split(r"^## (\w+).*$", PAGE, flags=re.MULTILINE)
    for heading, section in zip(sections[1::2], sections[2::2]):
        listed = [script_path(row[0]) for row in ROW.findall(section)]
        assert all(script.startswith(f"{heading.lower()}/") for script in listed)


def mentions(text: str, script: str, command: str) -> bool:
    """Return whether a text names a script: by module, path or import, or pytest on its folder."""
    module = f"benchmarks/{script}".removesuffix(".py").removesuffix("/__main__")
    package, _, name = module.replace("/", ".").rpartition(".")
    imports = rf"from {package} import .*\b{name}\b"
    if re.search(rf"\b{package}\.{name}\b|\b{module}\b|{imports}", text):
        return True
    options = command.partition(".py ")[2].replace(" -s", "")
    folders = [folder.as_posix() for folder in Path(module).parents if folder.name]
    is_test = command.startswith("pytest")
    return is_test and any(f"pytest {f} {options}" in text for f in folders)


@pytest.mark.parametrize("script", ROWS)
def test_a_row_says_where_the_figures_of_its_script_are(script):
    """Where no page has them, the script judges a bound or others import it."""
    command, shows, duration, use = ROWS[script]
    assert shows.strip()
    assert duration in DURATIONS
    is_test = script.rpartition("/")[2].startswith("test_")
    assert is_test == command.startswith("pytest")
    assert is_test or "__main__" in script or "__main__" in source(script)
    links = LINK.findall(use)
    for link in links:
        text = (FOLDER / link).read_text(encoding="utf-8")
        assert mentions(text, script, command), f"{link} does not name {script}"
    linked = "".join((FOLDER / link).read_text(encoding="utf-8") for link in links)
    assert [words for words in QUOTED.findall(use) if words not in linked] == []
    if not links:
        assert "exit code 1" in use
        assert "exit code is 1" in source(script)


@pytest.mark.parametrize("helper", HELPERS)
def test_a_helper_is_imported_and_not_run(helper):
    name = helper.rpartition("/")[2].removesuffix(".py")
    imports = re.compile(rf"^(?:from|import) benchmarks\..*\b{name}\b", re.MULTILINE)
    users = [script for script in scripts() if imports.search(source(script))]
    assert [script for script in users if script != helper]
    assert "__main__" not in source(helper)


def page_tables(script: str) -> list[PageTable]:
    """Return the tables that a script writes; of their page only the script knows the path."""
    tables = []
    for node in ast.walk(ast.parse(source(script))):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "PageTable":
            name, command = (ast.literal_eval(argument) for argument in node.args[1:])
            tables.append(PageTable(FOLDER, name, command))
    return tables


def test_tables_of_scripts_and_marks_of_pages_are_the_same():
    """And the row of a script leads to the page that has its table."""
    pages = [path for path in TEXTS if path.suffix == ".md"]
    marks = []
    for page in pages:
        text = page.read_text(encoding="utf-8")
        marks += re.findall(r"^<!-- \w+: python -m .* -->$", text, re.MULTILINE)
    begins = []
    for script, (_, _, _, use) in ROWS.items():
        linked = [(FOLDER / link).resolve() for link in LINK.findall(use)]
        for table in page_tables(script):
            texts = [path.read_text(encoding="utf-8") for path in linked]
            assert any(table.begin in text and table.end in text for text in texts)
            assert script_path(table.command) == script
            begins.append(table.begin)
    assert len(begins) > 5
    assert sorted(begins) == sorted(marks)


def is_there(name: str) -> bool:
    """Return whether a file, folder, module or name in a module is there."""
    if "/" in name:
        return (ROOT / name).exists()
    path = ROOT.joinpath(*name.split("."))
    if path.is_dir() or path.with_suffix(".py").exists():
        return True
    module = path.parent.with_suffix(".py")
    return module.exists() and path.name in module.read_text(encoding="utf-8")


def test_scripts_that_texts_name_are_there():
    named = [
        (path.relative_to(ROOT).as_posix(), name)
        for path in TEXTS
        for name in SCRIPT_NAME.findall(path.read_text(encoding="utf-8"))
    ]
    assert len({name for _, name in named if name.startswith("benchmarks")}) > 40
    assert [(page, name) for page, name in named if not is_there(name)] == []


@pytest.mark.parametrize("is_written", [False, True])
def test_a_table_is_printed_and_where_asked_for_in_its_page(
    is_written, tmp_path, capsys
):
    page = tmp_path / "page.md"
    table = PageTable(page, "table", "python -m made")
    page.write_text(f"above\n{table.begin}\nold\n{table.end}\nbelow\n")
    table.show(["new", "rows"], is_written)
    assert capsys.readouterr().out == "new\nrows\n"
    assert table.read().split() == (["new", "rows"] if is_written else ["old"])
    assert page.read_text().startswith("above\n") and "below" in page.read_text()
