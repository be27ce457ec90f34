"""More than a hundred files and words of strangers: each is refused in one sentence.

None goes on for long, none steers the terminal, puts in an option or a command, writes anything, or
is called a defect of this program. What its reader does with each is tested beside it; here, what
the whole command does.
"""

from __future__ import annotations

import json
import re
import signal
from typing import NamedTuple

import pytest

from rigs.files.command_line import ending_within, files_in
from rigs.files.reports import arm_text, link_result, saved
from rigs.logs.measured_logs import XML, log_of, true_arm
from robot_sysid.cli import main
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.records.messages import printable

pytestmark = pytest.mark.skipif(
    not hasattr(signal, "SIGALRM"), reason="ends what hangs by a signal"
)
LONGEST = 60
"""Seconds after which an input has hung; each takes a tenth of one on a quiet computer."""
ESCAPES = "\x1b[31m\u202e\x9b\x7f"
COMMAND = "\n  robot-sysid evil"
XACRO = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="r">{}</robot>'
BODY = '<body><joint axis="0 1 0"/><geom size=".1"/></body>'


class Hostile(NamedTuple):
    """One input.

    Attributes:
        name: of the case.
        words: of the command.
        files: name to content of the files that it reads.
    """

    name: str
    words: list[str]
    files: dict[str, str] = {}


def settings():
    """Files for --config."""
    texts = {
        "brackets": "a = " + "[" * 100_000,
        "closed brackets": "a = " + "[" * 300 + "]" * 300,
        "tables": "a = " + "{a = " * 100_000,
        "dotted key": "a." * 100_000 + "a = 1",
        "dotted heading": "[" + "a." * 100_000 + "a]",
        "dotted key in a table": "a = {" + "a." * 100_000 + "a = 1}",
        "zero in a path": 'path = "arm\\u0000.xml"',
        "zero in columns": 'columns = "time = a\\u0000"',
        "zero in a key": '"a\\u0000" = 1',
        "escapes in a key": '"a\\u001b[31m\\u202e" = 1',
        "command in a key": '"a\\n  robot-sysid evil" = 1',
        "command in a value": 'torque_from = "a\\n  robot-sysid evil"',
        "raw escape": 'path = "a\x1b[31m"',
        "digits": f"seed = {'9' * 5000}",
        "number that is none": "torque_scale = nan",
        "number without end": "torque_scale = inf",
        "numbers that are none": "torque_scale = [1.0, nan]",
        "negative without end": "mass_scale = -inf",
        "direction that is none": "gravity = [nan, 0.0, 0.0]",
        "date for a path": "output_dir = 2020-01-01",
        "table for a path": "output_dir = {a = 1}",
        "list for a path": "output_dir = [[[1]]]",
        "truth for a number": "torque_scale = true",
        "text for a truth": 'report = "yes"',
        "same key twice": "report = true\nreport = true",
        "folder for a file": 'priors = "/"',
    }
    for name, text in texts.items():
        words = ["identify", "arm.xml", "log.csv", "--config", "s.toml"]
        yield Hostile(f"settings: {name}", words, {"s.toml": text})


def numbers():
    """Numbers of options that no arm has."""
    for option in ("torque-scale", "torque-constants", "mass-scale"):
        for value in (
            "1e308",
            "-1e308",
            "1e-308",
            "nan",
            "inf",
            "0",
            "1e999",
            "9" * 5000,
        ):
            words = ["identify", "arm.xml", "log.csv", f"--{option}={value}"]
            yield Hostile(f"{option} {value:.9}", words)
    for value in ("nan 0 0", "inf 0 0", "0 0 0"):
        words = ["identify", "arm.xml", "log.csv", "--gravity", *value.split()]
        yield Hostile(f"gravity {value}", words)
    for option in (
        "duration",
        "sample-rate",
        "seed",
        "speed",
        "max-velocity",
        "max-torque",
    ):
        for value in ("nan", "inf", "-1e308", "9" * 5000):
            words = ["plan", "arm.xml", f"--{option}={value}"]
            yield Hostile(f"{option} {value:.9}", words)
    for value in ("nan", "-1", "0"):
        words = ["payload", "arm.xml", "--empty", "log.csv", "--loaded", "log.csv"]
        yield Hostile(f"known-mass {value}", [*words, f"--known-mass={value}"])


def columns():
    """Lines for --columns and --units."""
    lines = {
        "4000 stars": "position = " + "*" * 4000,
        "4000 stars and a title": "position = joint" + "*" * 4000 + "_position",
        "range without end": "position = #1..#999999999",
        "range of digits": "position = #1..#" + "9" * 5000,
        "number of digits": "position = #" + "9" * 5000,
        "factor of digits": f"position = {'9' * 5000} * a",
        "escapes": f"position = {ESCAPES}",
        "command": f"position = a{COMMAND}",
        "key with escapes": f"position.{ESCAPES} = a",
        "endless rate": "rate = inf",
        "10 000 keys": ", ".join(f"torque.j{k} = a" for k in range(10_000)),
        "100 000 minus": "position = " + "-" * 100_000 + "a",
        "zero that is none": "zero = nan",
    }
    for name, line in lines.items():
        yield Hostile(
            f"columns: {name}", ["log", "log.csv", "arm.xml", "--columns", line]
        )
    for unit in (f"{'9' * 5000}/rev", "1/rev," * 10_000, ESCAPES, f"deg{COMMAND}"):
        words = ["log", "log.csv", "arm.xml", "--units", unit]
        yield Hostile(f"units {printable(unit):.12}", words)


def logs():
    """Logs of text and of JSON."""
    texts = {
        "a.csv": f'"time{ESCAPES}","a{COMMAND}",b\n0,1,2\n1,2,3\n2,3,4\n',
        "b.csv": f"time,q{'9' * 5000},tau{'9' * 5000}\n0,1,2\n1,2,3\n2,3,4\n",
        "c.csv": f"time,{'q' * 1_000_000}\n0,1\n1,2\n2,3\n",
        "d.csv": "time,q\n" + "".join(f'{k},"{"[" * 100_000}"\n' for k in range(3)),
        "e.csv": "time,q\n" + "".join(f"{k},{'9' * 5000}\n" for k in range(3)),
        "f.csv": "time,q\0b\n0,1\n1,2\n2,3\n",
        "g.csv": '"' * 100_000,
        "h.csv": "," * 100_000 + "\n" + ("1" + "," * 100_000 + "\n") * 3,
        "i.json": "[" * 100_000,
        "j.json": '[{"time": 0, "a": ' + '{"a": ' * 500 + "1" + "}" * 501 + "]",
        "k.json": '[{"ti\\u0000me": 0, "q\\n  robot-sysid evil": 1},{"ti\\u0000me": 1}]',
        "l.json": ('{"time": 0, "a": ' + "[" * 900 + "1" + "]" * 900 + "}\n") * 3,
        "m.json": '{"time": [0, 1, NaN], "q\\u001b[31m": [1e999, 2, 3]}',
        "n.txt": "header:\n  stamp:\n" + "".join(" " * k + "a:\n" for k in range(2000)),
        "o.txt": "header: {stamp: " + "[" * 100_000,
    }
    for name, text in texts.items():
        yield Hostile(f"log {name}", ["log", name, "arm.xml"], {name: text})
    for words in ("l\udcff", "log.csv --columns c\udcff", "log.csv --mesh-dir m\udcff"):
        yield Hostile(f"no text: {words!r}", ["identify", "arm.xml", *words.split()])
    yield Hostile("log that is missing", ["log", f"a{ESCAPES}{COMMAND}.csv", "arm.xml"])


def models():
    """Model files that ask for much, or are called what they should not."""
    copies = '<replicate count="{}">{}</replicate>'
    attach = (
        '<mujoco><asset><model name="m" file="{}"/></asset><worldbody><body name="b">{}</body>'
        "</worldbody></mujoco>"
    )
    many = 10 * '<attach model="m" body="b" prefix="p"/>'
    chain = {f"{k}.xml": attach.format(f"{k + 1}.xml", many) for k in range(12)}
    references = "&#10;  robot-sysid evil&#x9b;&#x202e;"
    worlds = {
        "3000 bodies": BODY * 3000,
        "10^6 copies": copies.format(10**6, BODY),
        "copies of copies": copies.format(300, copies.format(300, BODY)),
        "copies in words": copies.format("1e6", BODY),
        "grid": '<body><composite type="grid" count="1000 1000 1"/></body>',
        "flexible grid": '<body><flexcomp count="100 100 100"/></body>',
        "same name": 2 * f'<body name="a{references}"/>',
        "odd number": f'<body pos="{references} 0 0"/>',
        "odd element": f'<body name="a"><geom type="a{references}"/></body>',
        "nan": '<body><joint/><geom size="nan"/></body>',
        "1e300": '<body><joint/><inertial pos="0 0 0" mass="1e300" diaginertia="1 1 1"/></body>',
        "deep": "<body>" * 300 + "</body>" * 300,
        "include that is missing": f'<include file="{references}"/>',
        "include of a device": '<include file="/dev/zero"/>',
        "include of itself": '<include file="m.xml"/>',
    }
    texts = {
        name: f"<mujoco><worldbody>{world}</worldbody></mujoco>"
        for name, world in worlds.items()
    }
    link = (
        '<link name="{0}"/><joint name="{0}" type="revolute"><parent link="a"/></joint>'
    )
    texts |= {
        "mesh that is a device": '<mujoco><asset><mesh name="m" file="/dev/zero"/></asset>'
        f"<worldbody>{BODY}</worldbody></mujoco>",
        "attaches itself": attach.format("m.xml", many),
        "attaches others": attach.format("0.xml", many),
        "entities": '<!DOCTYPE a [<!ENTITY b "cc">]><mujoco/>',
        "nothing": "",
        "no end": "<mujoco><worldbody><body " * 100,
        "3000 joints of a URDF": '<robot name="r"><link name="a"/>'
        + "".join(link.format(f"l{k}") for k in range(3000))
        + "</robot>",
        "names of a URDF": f'<robot name="r"><link name="a"/>{2 * link.format(references)}</robot>',
    }
    for name, text in texts.items():
        yield Hostile(
            f"model: {name}", ["log", "log.csv", "m.xml"], {"m.xml": text, **chain}
        )
    yield Hostile(
        "joint of odd name", ["log", "log.csv", "arm.xml", "--joint", ESCAPES + COMMAND]
    )


def results():
    """Folders of results that somebody changed; the words begin with what is changed."""
    changes = {
        "mass": "text",
        "body_name": None,
        "question": COMMAND,
        "status": f"a{ESCAPES}{COMMAND}",
        "verdict": COMMAND,
        "quantities": [7],
        "quantities ": [{"name": "Izz", "of": "link5"}],
        "remarks": [COMMAND],
        "file": COMMAND,
        "payload": 1,
        "logs": "a",
        "logs ": ["a\0.csv"],
        "model": {},
        "curves": [1],
        "validation": {"a": 1},
        "schema_version": 10**400,
        "schema_version ": COMMAND,
        "deep": None,
    }
    for key, value in changes.items():
        text = "" if key != "deep" else "[" * 100_000
        files = {"change.json": json.dumps([key.strip(), value]), "change.txt": text}
        yield Hostile(f"result: {key}", ["report", "run"], files)
        yield Hostile(
            f"two results: {key}", ["report", "run", "run", "--output-dir", "b"], files
        )


def small_files():
    """Files of factors, priors and motions."""
    odd = {
        "deep": "[" * 100_000,
        "nested": "[" * 200 + "]" * 200,
        "zero": '{"a\\u0000": 1}',
        "text": '{"torque_scale": "a"}',
        "names": '{"torque_scale": {"a\\n  robot-sysid evil\\u001b": 1}}',
        "huge": '{"torque_scale": {"joint0": 1e308, "joint1": 1, "joint2": 1}}',
        "none": '{"torque_scale": {"joint0": NaN, "joint1": 1, "joint2": 1}}',
    }
    for name, text in odd.items():
        for option in ("torque-scale", "priors"):
            words = ["identify", "arm.xml", "log.csv", f"--{option}", "f.json"]
            yield Hostile(f"{option}: {name}", words, {"f.json": text})
        words = ["plan", "arm.xml", "--trajectory", "f.json"]
        yield Hostile(f"trajectory: {name}", words, {"f.json": text})


def xacros():
    """Xacro files; each takes a process of its own."""
    texts = {
        "environment": '<link name="$(env HOME)"/>',
        "eval": '<link name="$(eval 1)"/>',
        "YAML from elsewhere": "<link name=\"${xacro.load_yaml('/etc/passwd')}\"/>",
        "subclasses": '<link name="${[k.__class__ for k in [1]]}"/>',
        "frames": '<link name="${(x for x in [1]).gi_frame}"/>',
        "package above": '<link name="$(find ..)"/>',
        "device": '<xacro:include filename="/dev/zero"/>',
        "memory": '<link name="${10**9 * [0]}"/>',
        "recursion": '<xacro:macro name="m"><xacro:m/><xacro:m/></xacro:macro><xacro:m/>',
        "names": f"<link name=\"${{'{COMMAND}'}}\"/>",
    }
    for name, text in texts.items():
        words = ["log", "log.csv", "m.xacro"]
        yield Hostile(f"xacro: {name}", words, {"m.xacro": XACRO.format(text)})


FAST = (settings, numbers, columns, logs, models, results, small_files)
"""What makes inputs that take a tenth of a second at most, but for their number."""
CASES = [case for make in FAST for case in make()]


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """A folder with an arm, a log of it, and a folder of results."""
    folder = tmp_path_factory.mktemp("strangers")
    (folder / "arm.xml").write_text(XML)
    arm = true_arm()
    log = log_of(arm, noise_torque=0.1)
    write_measurement_csv(folder / "log.csv", arm.joint_names, [log])
    model = folder / "two.xml"
    model.write_text(arm_text(), encoding="utf-8")
    saved(folder / "run", link_result(model))
    return folder


def changed_result(folder):
    """Change the result in a folder as two files beside it say."""
    params = folder / "run" / "params.json"
    key, value = json.loads((folder / "change.json").read_text())
    text = json.dumps({**json.loads(params.read_text()), key: value})
    params.write_text((folder / "change.txt").read_text() or text)


def check(case, folder, capsys):
    """Run a case, and look at all that it says and does."""
    params = folder / "run" / "params.json"
    whole = params.read_text()
    for name, text in case.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    try:
        if "change.json" in case.files:
            changed_result(folder)
        before = files_in(folder)
        with ending_within(LONGEST):
            code = main(case.words)
        assert files_in(folder) == before
    finally:
        params.write_text(whole)
        for name in case.files:
            (folder / name).unlink()
    out, err = capsys.readouterr()
    assert code == 2, (code, err)
    assert "Traceback" not in err and "defect" not in err
    odd = [
        letter for letter in out + err if printable(letter) != letter and letter != "\n"
    ]
    assert odd == []
    errors = [
        line for line in err.splitlines() if not line.startswith(("note: ", "  "))
    ]
    assert len(errors) == 1 and errors[0].startswith("robot-sysid: error: "), err
    assert len(errors[0]) < 2000
    assert not re.search("(?m)^  robot-sysid evil", out + err)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_what_a_stranger_gives_is_refused_in_one_sentence(
    case, workshop, monkeypatch, capsys
):
    monkeypatch.chdir(workshop)
    check(case, workshop, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("case", [*xacros()], ids=lambda case: case.name)
def test_a_xacro_is_refused_in_one_sentence(case, workshop, monkeypatch, capsys):
    pytest.importorskip("xacro")
    monkeypatch.chdir(workshop)
    check(case, workshop, capsys)


def test_there_are_more_than_a_hundred():
    names = [case.name for case in (*CASES, *xacros())]
    assert len(names) == len({*names}) > 100
