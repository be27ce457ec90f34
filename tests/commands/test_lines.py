"""Each line that a command prints by default answers a question; all else is for --verbose."""

from __future__ import annotations

import re

import pytest

from rigs.files import transcripts

MOST_LINES = {
    "log": 6,
    "log_with_a_wrong_sign": 6,
    "identify": 20,
    "payload": 20,
    "check": 6,
    "check_of_a_changed_arm": 12,
    "plan": 15,
    "report": 6,
}
"""Transcript to the number of lines that its command may print at most."""
NEXT = (
    (r"Next, |If ", "What do I do next?"),
    (r"  robot-sysid ", "By which command?"),
    (r"Record it as ", "And then?"),
)
VERDICT = (
    (r"(Usable|Only) [^:]*: |Usable: ", "Which file do I use, and how far off is it?"),
    (r"\S+ weighs |The (payload weighs|mass of )", "What does it weigh?"),
    (r"Watch: ", "What do the errors not cover?"),
    (r"With MuJoCo before ", "Which file is for everything else?"),
    (r"Copy into the controller", "What do I give the controller?"),
)
TABLE = (
    (r"note: ", "What should I do otherwise next time?"),
    (r"On the flange, ", "What is bolted on that the model lacks?"),
    (r"  .* identified  ", "Of which link and joint?"),
    (r"  (mass|centre of mass|inertia|dry|Coulomb|viscous) ", "Which numbers changed?"),
    (r"  (torque offset|rotor inertia|friction at) ", "Which numbers changed?"),
    (r"  (zero and unchanged|not identif)", "Which numbers does the log not show?"),
    (r"  ±: ", "What is the ±?"),
    (r"  Inertia not known: ", "Can I use the inertia?"),
)
LOG = (
    (r"\S+: \d+ samples in ", "Which log is it, and how fast?"),
    (r"\d+ columns ", "What was each column taken for?"),
    (r"(refuses|doubts|says): ", "What is wrong with it?"),
    (r"Log is fine: ", "May I identify from it?"),
    (r"robot-sysid: error: ", "Why not, and what mends it?"),
)
CHECK = (
    (r"note: the model's friction ", "Is the friction another one?"),
    (r"(As the model says|Unchanged|Changed|Differs ).*: ", "Is it the same arm?"),
    (r"(differs from the model|\S+ .* differs$)", "By how much does it differ?"),
    (r"not shown by these logs: ", "What could have changed unseen?"),
    (r"What to do: ", "What do I do next?"),
)
PLAN = (
    (r"(Loading|Generating) .*\.\.\.", "What is it doing?"),
    (r"Identified terminal joint: ", "Of which joint?"),
    (r"Keeps all limits for ", "Is the motion possible?"),
    (r"(Nothing keeps|No torque limit) ", "What is not limited?"),
    (r"Limits of this program ", "Which limits are assumed?"),
    (r"The way from where ", "What is not checked?"),
    (r"Expected of its log: ", "What is it good for?"),
    (r"Trajectory saved to ", "Where is it?"),
    (r"Usable once ", "May I play it?"),
)
QUESTIONS = {
    "log": (*LOG, *NEXT),
    "log_with_a_wrong_sign": (*LOG, *NEXT),
    "identify": (*TABLE, *VERDICT, *NEXT),
    "payload": (*TABLE, *VERDICT, *NEXT),
    "check": CHECK,
    "check_of_a_changed_arm": CHECK,
    "plan": (*PLAN, *NEXT),
    "report": ((r"Written: ", "Where is the page?"), *VERDICT),
}
"""Transcript to beginnings of lines and the questions that they answer."""


@pytest.mark.parametrize("name", QUESTIONS)
def test_each_line_answers_a_question(name):
    _, *lines, _ = transcripts.recorded_text(name).splitlines()
    assert len(lines) <= MOST_LINES[name]
    beginnings = [beginning for beginning, _ in QUESTIONS[name]]
    for line in lines:
        assert any(re.match(each, line) for each in beginnings), line
