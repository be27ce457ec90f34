"""``robot-sysid completion SHELL``: what a shell that has read it completes."""

from __future__ import annotations

import shutil
import subprocess

import pytest

ASKED = {
    "pa": {"payload"},
    "plan --excitation-t": {"--excitation-time-budget"},
    "plan --excitation ": {"sines", "optimal"},
    "motors ch": {"check"},
    "motors play t.csv --rec": {"--record"},
    "arm.xml --motor-t": {"--motor-type"},
    "arm": {"arm"},
    "identify arm.xml lo": set(),  # a file, which the shell completes
}


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_bash_completes_commands_options_and_values(command, tmp_path):
    (tmp_path / "it.sh").write_text(command.run("completion", "bash").out)
    script = [f"source {tmp_path / 'it.sh'}"]
    for words in ASKED:
        script.append(f"COMP_WORDS=(robot-sysid {words}{chr(34) * 2 if words[-1] == ' ' else ''})")
        script.append('COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); _robot_sysid; echo "${COMPREPLY[*]}"')
    done = subprocess.run(["bash", "-c", "\n".join(script)], capture_output=True, text=True)
    found = [set(line.split()) for line in done.stdout.splitlines()]
    assert (done.stderr, found) == ("", list(ASKED.values()))


def test_zsh_and_fish_are_told_the_same(command):
    assert command.run("completion", "zsh").out.startswith("autoload -U +X bashcompinit")
    lines = command.run("completion", "fish").out.splitlines()
    when = "'__fish_seen_subcommand_from plan'"
    assert f"complete -c robot-sysid -n {when} -l excitation -xa 'sines optimal'" in lines
    assert f"complete -c robot-sysid -n {when} -l seed -r" in lines
