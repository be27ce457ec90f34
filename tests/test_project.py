"""The project as a whole: the README tells the truth, and the files around the code agree."""

from __future__ import annotations

import ast
import importlib.metadata
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import robot_sysid
from rigs.files.places import ROOT
from robot_sysid.cli import main
from robot_sysid.regressor import derive_regressor
from tests.test_architecture import nodes_of, package_sources

EXAMPLE = "examples/kinova/model/kinova_fullinertia_guess.xml"


def read(path: str | Path) -> str:
    """Return the text of a file, whose path is relative to the checkout."""
    return (ROOT / path).read_text(encoding="utf-8")


README = read("README.md")
DOCS = {page.name for page in ROOT.glob("docs/*.md")}
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/**/*.md"),
        *ROOT.glob("examples/**/*.md"),
        *ROOT.glob("skills/**/*.md"),
    ]
)
SECTIONS = set(
    """Overview
System Identification Approach
Key Features
Installation
Prerequisites
Quick Start
Usage
Basic Command
Command-Line Options
Usage Examples
Identify Only Inertial Parameters (No Friction)
Custom Trajectory Duration and Sample Rate
Specify Output Directory
Export Trajectory for Damiao Motors
Reproducible Results
Output Formats
params.json: Identified Parameters
updated_model.xml: Updated MuJoCo Model
damiao_trajectory.csv: Motor Trajectory (Optional)
Understanding the System Identification Approach
Spatial Dynamics Regressor
Full Regressor Matrix Derivation
Excitation Trajectory Design
Least-Squares Solution
Base Parameters
Project Structure
Troubleshooting
High RMSE (> 0.1 N·m)
Low Matrix Rank (< 7 base parameters)
Simulation Divergence (NaN values)
Clamping Warnings (Damiao Export)
Development
Running Tests
Test Organization
Contributing
Examples
License
Citation""".splitlines()
)
QUICK_START = re.compile(r"<!-- quick start output -->\n```text\n(.*?)```", re.DOTALL)
KINOVA_OUTPUT = re.compile(r"<!-- kinova output -->\n```text\n(.*?)```", re.DOTALL)


def test_readme_has_every_section():
    assert set(re.findall(r"^##+ (.*)$", README, re.MULTILINE)) >= SECTIONS


def test_readme_is_short_and_leads_to_every_page():
    assert len(README.splitlines()) <= 200
    assert len(README.split()) <= 1500
    linked = set(re.findall(r"\]\(docs/([\w-]+\.md)", README))
    assert linked >= DOCS - {"index.md"}


def test_the_site_has_every_page():
    navigation = read("mkdocs.yml").partition("\nnav:")[2]
    assert set(re.findall(r"[\w-]+\.md", navigation)) == DOCS


def test_home_shows_before_it_tells():
    """A picture, what to type and what it prints, before the first sentence."""
    blocks = read("docs/index.md").split("\n\n")[1:4]
    assert len(blocks) == 3
    for block, beginning in zip(blocks, ("![Torque", "```bash", "<!-- printed")):
        assert block.startswith(beginning)


def mask_changing(text: str) -> list[str]:
    """Return lines with what changes from run to run replaced by #."""
    return re.sub(r"(Condition number: )[\d.]+", r"\1#", text).splitlines()


def test_printed_output_in_the_pages_is_real(tmp_path, monkeypatch, capsys):
    """The README shows its block, the example's page the table under it too."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    assert main([EXAMPLE]) == 0
    printed = mask_changing(capsys.readouterr().out)
    pages = {
        "README.md": (QUICK_START, 16),
        "examples/kinova/README.md": (KINOVA_OUTPUT, None),
    }
    for page, (pattern, lines) in pages.items():
        promised = pattern.search(read(page))
        assert promised is not None
        assert mask_changing(promised[1]) == printed[:lines]


def written_regressor() -> list[list[str]]:
    """Return the 60 entries of the regressor in docs/method.md as Python expressions."""
    body = re.search(
        r"\\mathbf\{Y\} = \\begin\{bmatrix\}\n(.*?)\\end",
        read("docs/method.md"),
        re.DOTALL,
    )
    assert body is not None
    rows = body[1].split(r"\\")[:6]
    return [list(map(expression, row.split("&"))) for row in rows]


def expression(latex: str) -> str:
    """Return an entry such as -\\dot{v}_z + \\omega_x v_y as -avz + wx*vy."""
    text = latex.replace(r"\dot{\omega}_", "aw").replace(r"\dot{v}_", "av")
    text = text.replace(r"\omega_", "w").replace("v_", "v").replace("^2", "**2")
    return re.sub(r"(?<=[xyz]) (?=[wv])", "*", text.strip())


def test_the_written_formula_is_the_derived_regressor():
    derived, symbols = derive_regressor()
    values = dict(zip(map(str, symbols), np.random.default_rng(0).normal(size=12)))
    written = [
        [eval(entry, {}, values) for entry in row] for row in written_regressor()
    ]
    numeric = np.array(derived.subs(dict(zip(symbols, values.values()))), dtype=float)
    np.testing.assert_allclose(written, numeric, rtol=1e-12)


def test_version_is_the_same_everywhere():
    version = robot_sysid.__version__
    assert importlib.metadata.version("robot-sysid") == version
    newest = re.search(r"^## \[(\d.*?)\]", read("CHANGELOG.md"), re.MULTILINE)
    assert newest is not None
    assert newest[1] == version
    assert version not in read("pyproject.toml").split("[project.optional")[0]


def test_links_to_files_and_headings_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\((?!https?://)([^)\s]+)\)", read(page)):
            path, _, anchor = target.partition("#")
            linked = page.parent / path if path else page
            assert linked.exists(), f"{page.name} links to {target}"
            assert not anchor or anchor in anchors(read(linked)), (page, target)


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, the way GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", text.lower(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title).replace(" ", "-") for title in titles}


def test_files_named_in_the_pages_exist():
    path = re.compile(r"`((?:robot_sysid|tests|docs|examples|\.ci)/[\w./-]*\w)`")
    for page in ("README.md", "CONTRIBUTING.md", "docs/architecture.md"):
        for name in path.findall(read(page)):
            assert (ROOT / name).exists(), f"{page} names {name}"


def tree_paths() -> list[str]:
    """Return the paths drawn in the project structure of docs/architecture.md."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    block = re.search(r"<!-- tree -->\n```text\n(.*?)```", page, re.DOTALL)
    assert block is not None
    paths = []
    folders = []
    for line in block[1].splitlines()[1:]:
        match = re.match(r"([│ ]*)[├└]── (\S+)", line)
        if match:
            depth = len(match[1]) // 4
            folders = [*folders[:depth], match[2]]
            paths.append("".join(folders))
    return paths


def test_every_path_of_the_project_structure_is_there():
    assert len(tree_paths()) > 12
    missing = [path for path in tree_paths() if not list(ROOT.glob(path.rstrip("/")))]
    assert missing == []


def test_conda_environment_has_the_core_dependencies():
    listed = set(re.findall(r"^\s+- ([\w-]+)", read("environment.yml"), re.MULTILINE))
    dependencies = read("pyproject.toml").partition("\ndependencies = [")[2]
    needed = re.findall(r'^  "([\w-]+)', dependencies.partition("\n]")[0], re.MULTILINE)
    assert needed and set(needed) == listed - {"python", "pip", "conda-forge"}


def test_a_run_starts_without_what_it_does_not_need_and_in_one_thread(tmp_path):
    """SciPy or SymPy take longer to import than the whole identification; threads of linear algebra
    that wait for each other cost half as much again.
    """
    names = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
    code = (
        "import os, sys, robot_sysid.cli, robot_sysid.commands.identify as _; "
        "early = 'numpy' in sys.modules; "
        f"code = robot_sysid.cli.main([{str(ROOT / EXAMPLE)!r}, '--duration', '1']); "
        f"told = [os.environ.get(name) for name in {names}]; "
        "slow = {'scipy', 'sympy', 'matplotlib', 'can', 'clarabel', 'robot_sysid.report.page', "
        "'robot_sysid.damiao', 'robot_sysid.motion.search', 'glfw'} & set(sys.modules); "
        "wrong = early or slow or told != ['1'] * 3; "
        "sys.exit(code or (f'{early}, {told}, {slow}' if wrong else 0))"
    )
    free = {**os.environ, **dict.fromkeys(names, "4")}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, env=free)
    assert (done.returncode, done.stderr) == (0, b"")


MUTABLE = {"ModelDocument", "SimulatedMotor"}
"""Records with a state: nodes of XML files and simulated motors."""


def test_records_cannot_be_changed():
    mutable = set()
    for source in package_sources().values():
        for node in nodes_of(source) if "dataclass" in source else ():
            for decorator in getattr(node, "decorator_list", ()):
                text = ast.unparse(decorator)
                if text.startswith("dataclass") and "frozen=True" not in text:
                    mutable.add(node.name)
    assert mutable == MUTABLE


_WRITTEN = re.compile(
    r"(?:robot-sysid example|--output-dir|--save-[\w-]+) ([a-z][\w./]*)"
)
"""A command's words that name a file or folder that it writes."""


def test_what_the_first_pages_write_leaves_a_clone_clean():
    """Git and ruff leave out what is ignored."""
    if not (ROOT / ".git").exists():
        pytest.skip("needs a clone")
    pages = (
        "README.md",
        "docs/index.md",
        "docs/tutorial.md",
        "examples/kinova/README.md",
    )
    written = _WRITTEN.findall(" ".join(map(read, pages)))
    assert {"kinova", "found", "plan.json"} <= {*written}
    for name in {*written, "weighed", "plan.csv"}:
        ignored = subprocess.run(["git", "check-ignore", "-q", name], cwd=ROOT)
        assert ignored.returncode == 0, name
