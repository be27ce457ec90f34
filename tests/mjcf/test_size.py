"""Models that ask for more bodies than any arm has are refused before MuJoCo makes them."""

from __future__ import annotations

import pytest

from rigs.files.model_files import write_files
from rigs.files.refusals import refused
from robot_sysid.errors import ModelError
from robot_sysid.mjcf.documents import read_document

BODY = '<body><joint/><geom size=".1"/></body>'
NESTED = 6 * "<replicate count='20'>" + BODY + 6 * "</replicate>"
LINK = '<link name="a"/><joint name="b"/>'
ATTACHING = """<mujoco><asset><model name="m" file="{file}"/></asset><worldbody><body name="b">
{attached}</body></worldbody></mujoco>"""
ATTACHED = 10 * '<attach model="m" body="b" prefix="p"/>'


def scene(text):
    """An MJCF of what is in the world."""
    return f"<mujoco><worldbody>{text}</worldbody></mujoco>"


def attaching(file):
    """An MJCF that has a file ten times."""
    return ATTACHING.format(file=file, attached=ATTACHED)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (scene(2001 * BODY), "2000 times a <body>"),
        (scene(f"<body>{2001 * '<joint/>'}</body>"), "2000 times a <joint>"),
        (
            scene(f'<replicate count="1000000">{BODY}</replicate>'),
            "500 times a <replicate>",
        ),
        (
            scene(f'<replicate count="1e6">{BODY}</replicate>'),
            "500 times a <replicate>",
        ),
        (scene(NESTED), "500 times a <replicate>"),
        (
            scene(f'<replicate count="400">{6 * BODY}</replicate>'),
            "2000 times a <body>",
        ),
        (scene('<composite type="grid" count="1000 1000 1"/>'), "2000 times a <body>"),
        (scene('<body><flexcomp count="100 100 1"/></body>'), "2000 times a <body>"),
        (f'<robot name="r">{2001 * LINK}</robot>', "2000 times a <(link|joint)>"),
        (attaching("m.xml"), "m.xml attaches itself"),
        (attaching("0.xml"), "2000 times a <body>"),
    ],
)
def test_what_no_arm_has_is_refused_by_its_size(tmp_path, text, message):
    """Files that attach a file ten times, which attaches one ten times, and so on, too."""
    files = {f"{k}.xml": attaching(f"{k + 1}.xml") for k in range(9)}
    files["9.xml"] = scene('<body name="b"/>')
    write_files(tmp_path, {**files, "m.xml": text})
    with refused(f"m.xml.* {message}|{message}", ModelError):
        read_document(tmp_path / "m.xml")


def test_a_file_that_is_larger_than_a_model_is_not_read(tmp_path):
    path = tmp_path / "m.xml"
    with open(path, "wb") as file:
        file.truncate(10**9)
    with refused("m.xml has 1e.09 bytes with what it includes", ModelError):
        read_document(path)


def test_some_copies_are_a_model(tmp_path):
    text = scene(f'<replicate count="30">{BODY}</replicate>')
    path = write_files(tmp_path, {"m.xml": text, "n.xml": attaching("0.xml")})
    write_files(tmp_path, {"0.xml": scene('<body name="b"/>')})
    assert read_document(path).root.find("worldbody/replicate") is not None
    assert read_document(tmp_path / "n.xml").root.find("worldbody/body") is not None
