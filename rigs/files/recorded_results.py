"""What is printed and written of made-up results, as it is recorded in tests/results/recorded.

    python -m rigs.files.recorded_results

records it anew, and what whole commands print (``rigs.files.transcripts``).
"""

import json
from dataclasses import replace

import numpy as np

from rigs.arms.bodies import body_estimate, card_of
from rigs.files import results as made
from rigs.files import transcripts
from rigs.files.places import ROOT
from robot_sysid import spatial
from robot_sysid.records.controllers import CHOICES
from robot_sysid.records.file_access import strict_json
from robot_sysid.records.messages import Detail
from robot_sysid.records.quantities import (
    BEYOND,
    BEYOND_INERTIA,
    BOUND,
    DATA,
    DIFFERENCE,
    LEAST_SEEN,
    MODEL,
    MOMENT,
    FrictionCurve,
    Quantity,
)
from robot_sysid.results.cards import number_groups
from robot_sysid.results.content import content_of
from robot_sysid.results.lines import block_lines, more_lines, verdict_lines
from robot_sysid.results.record import ModelFile, NextMotion
from robot_sysid.results.table import beyond_lines, cells, table_lines
from robot_sysid.results.verdicts import Verdict

FOLDER = ROOT / "tests" / "results" / "recorded"


def with_rows(*rows):
    """The usual result with further rows."""
    found = made.found()
    return replace(found, quantities=(*found.quantities, *rows))


def bolted_on(mass, error, inertia=0.0, ratio=None):
    """A result with a mass [kg] beyond the model, 0.1 m from the frame of the link.

    ``ratio`` is the difference of all numbers over what chance leaves; None: that of the mass.
    """
    source = DATA if np.isfinite(error) else MODEL
    least = 2.3 * error
    moments = BEYOND_INERTIA.values()
    return with_rows(
        Quantity(DIFFERENCE, BEYOND, "", None, ratio or (mass / least) ** 2, 0.0),
        Quantity(LEAST_SEEN, BEYOND, "kg", None, least, 0.0),
        *(Quantity(n, BEYOND, "kg·m²", None, inertia, 1e-3) for n in moments),
        Quantity(MOMENT, BEYOND, "kg·m", None, 0.1 * abs(mass), 0.1 * error),
        Quantity("mass", BEYOND, "kg", None, mass, error, source),
        *(Quantity(f"com_{x}", BEYOND, "m", None, 0.1, 0.01) for x in "xyz"),
    )


FILE = made.without_other_logs(made.model_file())
BENT = replace(
    FILE,
    curved=ModelFile(
        errors=(
            made.errors_from(
                *(
                    made.validation_of(e, "fifths of arm.csv", e)
                    for e in (0.27, 0.002) * 2
                )
            ),
        )
    ),
)
CURVE = FrictionCurve(
    of="j6",
    unit="N·m",
    speed_unit="rad/s",
    known_to=1.2,
    speeds=(0.12, 0.48, 1.2),
    model=(0.3, 0.33, 0.4),
    torque=(0.41, 0.55, 0.6),
    errors=(0.01, 0.012, 0.02),
)
SLOW = replace(
    FILE,
    elsewhere=made.elsewhere(
        0.2,
        faster="j6",
        still=("j5",),
        for_like_motions=True,
        next=NextMotion(("--duration", "60"), 0.1),
    ),
)
UNSEEN = made.found(made.without_mass(), verdict=Verdict.PARTLY_FROM_MODEL)
RESULTS = {
    "every link, with its file": made.whole(),
    "last link": made.found(validation=(made.validation_of(0.05),)),
    "mass not shown": UNSEEN,
    "mass not known": made.found(made.with_value("m", 2.0, 1.2), file=FILE),
    "slow log": made.found(file=SLOW),
    "no promise": made.found(file=replace(FILE, elsewhere=None)),
    "friction that bends": made.found(
        file=BENT, curves=(CURVE,), tops={"j5": 1.0, "j6": 1.5}
    ),
    "as good before": made.found(verdict=Verdict.AS_GOOD, file=FILE),
    "torques only": made.found(verdict=Verdict.TORQUES_ONLY),
    "payload": made.payload(),
    "payload without inertia": made.payload(made.body(shown=False)),
    "impossible payload": made.payload(made.body(-1.0), verdict=Verdict.SWAPPED),
    "known mass": made.payload(known_mass=2.0, torque_scale=[("j5", 1.02)]),
    "self-test": made.itself(),
    "without friction, not finite": replace(
        made.found(
            quantities=(Quantity("zero", "j6", "rad", None, 0.0, np.nan, BOUND),)
        ),
        quality=replace(made.QUALITY, condition_number=np.inf),
    ),
}
"""Name of a case to its result."""
WRITTEN = (
    "every link, with its file",
    "mass not shown",
    "payload without inertia",
    "known mass",
    "self-test",
    "without friction, not finite",
)
"""Cases whose params.json is recorded."""
BOLTED_ON = (
    (0.5, 0.09),
    (0.5, 0.15),
    (0.1, 0.1),
    (-0.5, 0.1),
    (0.5, np.inf),
    (0.5, 0.3, 0.01, 1.7),
    (-0.2, 0.3, -0.01, 1.7),
)
"""Masses beyond the model and their errors: seen, not known, nothing, less, not shown [kg]. In the
last two the moments of inertia tell [kg m^2]."""
CHANGES = (
    (1.0, 1.5, 0.1, DATA),
    (1.0, 1.5, 0.1, MODEL),
    (1.0, 1.05, 0.1, DATA),
    (1.0, 1.05, 0.1, MODEL),
    (1.0, 1.0, 0.1, MODEL),
    (None, 1.0, 0.1, DATA),
    (None, 1.0, 0.1, MODEL),
    (1.0, 1.00001, 1e-9, DATA),
    (0.0, 0.5, 0.1, DATA),
    (1.0, 1.0, np.inf, MODEL),
    (1.0, 0.0, np.nan, BOUND),
    (1.0, 1.0, None, DATA),
    (1.0, 2.0, 0.002, DATA),
)
"""Rows of a table: the model's value, the identified one, its error and source."""


def console(result):
    """Return the printed lines of a result; those of --verbose begin with "-v"."""
    # Whatever friction this MuJoCo knows.
    content = content_of(result, written=())
    lines = [
        *block_lines(content, False),
        *more_lines(content),
        *verdict_lines(content),
    ]
    if "j5+j6" in {row.of for row in result.quantities}:
        lines = [*block_lines(content, True), "", *lines]
    return "\n".join(f"-v {x}" if isinstance(x, Detail) else x for x in lines)


def consoles():
    """Return the printed lines of all cases."""
    texts = [f"== {name}\n{console(result)}\n" for name, result in RESULTS.items()]
    lines = [
        line
        for numbers in BOLTED_ON
        for line in beyond_lines(content_of(bolted_on(*numbers)))
    ]
    changes = [strict_json(Quantity("mass", "it", "kg", *row)) for row in CHANGES]
    rows = [cells(row, "it") for row in changes]
    lines += ["", "== changes", *table_lines(rows)]
    return "\n".join([*texts, "== bolted on", *lines, ""])


def rounded(value):
    """Return JSON with numbers of nine digits, zero below 1e-12."""
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [*map(rounded, value)]
    return float(f"{round(value, 12):.9g}") if isinstance(value, float) else value


def params():
    """Return the params.json of some cases, a line per key or row, without versions."""
    lines = []
    for name in WRITTEN:
        payload = RESULTS[name].payload
        card = payload and number_groups(payload)
        content = {
            **content_of(RESULTS[name], card, ("another",), written=()),
            "versions": None,
        }
        lines.append(f"== {name}")
        for key, value in content.items():
            entries = value if key in ("quantities", "remarks") else [value]
            texts = [
                json.dumps(rounded(entry), ensure_ascii=False) for entry in entries
            ]
            lines += [f"{key}: {text}" for text in texts]
    return "\n".join([*lines, ""])


EXAMPLE = (1.517, [0.001, -0.02, 0.0453], np.diag([2e-3, 2.5e-3, 1e-3]))
"""Mass, centre of mass and inertia about it of the body whose cards are recorded."""


def cards():
    """Return cards of known bodies and of balls, and which cards each choice has."""
    known = body_estimate(*EXAMPLE)
    ball = spatial.com_from_theta(spatial.aluminium_ball(0.31, np.zeros(3)))
    texts = [
        card_of(known, "all", "kuka.xml"),
        card_of(body_estimate(*EXAMPLE, n_identified=4), "ur"),
        card_of(body_estimate(*ball, n_identified=4), "kuka"),
    ]
    for largest in (133.0, 133.001):
        inertia = np.diag([100.0, 120.0, largest])
        texts.append(card_of(body_estimate(50.0, np.zeros(3), inertia), "ur"))
    for choice in CHOICES:
        lines = card_of(known, choice, "panda_on_ur5e.xml").splitlines()
        texts.append("\n".join([choice, *(x for x in lines if x.startswith("=="))]))
    return "\n--------\n".join([*texts, ""])


RECORDED = {"cards.txt": cards, "consoles.txt": consoles, "params.txt": params}
"""Name of a recorded file to what makes its text."""


def main():
    """Record all cases."""
    FOLDER.mkdir(exist_ok=True)
    for name, text in RECORDED.items():
        (FOLDER / name).write_text(text(), encoding="utf-8")
    transcripts.record()


if __name__ == "__main__":
    main()
