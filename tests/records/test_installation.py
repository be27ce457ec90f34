"""The command that installs an optional part names what this package was installed from."""

from __future__ import annotations

from pathlib import Path

import robot_sysid
from rigs.files.places import ROOT
from robot_sysid.records import installation

WHEEL = f"robot_sysid-{robot_sysid.__version__}-py3-none-any.whl"


def test_a_checkout_is_installed_again_from_wherever_the_user_stands(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(ROOT)
    assert installation.install_command("report") == 'pip install -e ".[report]"'
    monkeypatch.chdir(tmp_path)
    assert installation.install_command("logs") == f'pip install -e "{ROOT}[logs]"'


def test_without_a_checkout_the_wheel_is_named(tmp_path):
    package = tmp_path / "site" / "robot_sysid"
    command = installation.install_command("can", package)
    assert command == f'pip install "{WHEEL}[can]"'


def test_a_wheel_is_installed_again_from_where_it_lies(tmp_path):
    wheel = tmp_path / "a folder" / WHEEL
    record = tmp_path / f"robot_sysid-{robot_sysid.__version__}.dist-info"
    record.mkdir()
    (record / "direct_url.json").write_text(f'{{"url": "{wheel.as_uri()}"}}')
    command = installation.install_command("can", tmp_path / "robot_sysid")
    assert command == f'pip install "{wheel}[can]"'


def test_no_message_or_page_installs_from_an_index_that_does_not_have_it():
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.rglob("examples/*.md")]
    for path in [*pages, *Path(robot_sysid.__file__).parent.rglob("*.py")]:
        text = path.read_text(encoding="utf-8").replace("'", '"')
        assert 'pip install "robot-sysid' not in text, path
        assert "pip install robot-sysid" not in text, path
