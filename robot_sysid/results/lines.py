"""What the console prints of a result, a view of the content of params.json, and of a plan.

The verdict says in three lines which file to use and how far off it is, what the arm weighs, and
what to watch. It is printed last, with the next step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np

from robot_sysid.expected.recording import Prediction
from robot_sysid.expected.unrecorded_arm import ExpectedFile
from robot_sysid.records import ITSELF
from robot_sysid.records.controllers import DRIVERS, SIMULATORS
from robot_sysid.records.file_access import (
    CARD_NAME,
    SIMULATOR_CARD_NAMES,
    curved_file_in,
    models_in,
)
from robot_sysid.records.messages import (
    Detail,
    NextStep,
    percent,
    quoted_text,
    size_text,
)
from robot_sysid.results.cards import NOT_KNOWN
from robot_sysid.results.content import Content
from robot_sysid.results.record import PAYLOAD
from robot_sysid.results.table import (
    KNOWN,
    all_rows,
    beyond_lines,
    body_rows,
    cells,
    centre_text,
    friction_rows,
    label,
    largest_changes,
    legend_lines,
    number_with_error,
    quantity_lines,
    rows_of,
    table_lines,
)
from robot_sysid.results.verdicts import Verdict
from robot_sysid.spatial import PARAMETER_NAMES
from robot_sysid.wording import option_name, option_setting

SMALL = 0.01
"""Size below which all numbers of a line have two digits of the largest in place of three decimals.
"""
LEAST_MASS = 1e-4
"""Smallest mass that is written as a number [kg]: no arm shows a tenth of a gram."""
LEAST_MILLIMETRES = 0.01
"""Smallest length that is written as a number [mm]."""
LARGE_SHARE = 0.2
"""Predicted standard error over the parameter's size above which the parameter is named."""
RECORDED_FOR_PAYLOAD = "Recorded empty, loaded, loaded, empty"
"""``PAYLOAD_ORDER`` in words, as a sentence begins."""


def result_lines(content: Content, links: bool) -> list[str]:
    """Return the lines of a result without those of files and without --verbose."""
    lines = (
        *block_lines(content, links),
        *more_lines(content),
        *verdict_lines(content),
    )
    return [line for line in lines if not isinstance(line, Detail)]


def block_lines(content: Content, links: bool) -> list[str]:
    """Return the identified numbers line by line: a table, or the block of a self-test.

    Args:
        content: of params.json.
        links: whether the table shows every link and every joint in place of the last ones.
    """
    if content["source"] == ITSELF:
        return _self_test_lines(content)
    if links:
        named = [cells(row, title) for title, row in all_rows(content)]
        lines = table_lines(named, "Before -> after")
        return [*beyond_lines(content), *lines, *legend_lines(lines)]
    if content["question"] == PAYLOAD:
        rows = body_rows(content, PAYLOAD)
        title = f"payload, in the frame of {content['payload']['flange']['name']}"
        lines = [*quantity_lines(rows, title)]
        if 1 < len(rows) < 10:
            lines.append(f"  {NOT_KNOWN}")
        return lines
    link, joint = content["body_name"], content["joint_name"]
    rows = body_rows(content, link) + friction_rows(content, joint)
    lines = [*beyond_lines(content), *quantity_lines(rows, f"{link} and {joint}")]
    if rows and len(content["joint_names"]) > 1:
        lines[-1] += "; all links and joints are in params.json"
    return lines


def _self_test_lines(content: Content) -> list[str]:
    """Return the block "Identified parameters: ..." of the model's own simulation."""
    rows = {row["name"]: row for row in content["quantities"]}
    lines = ["Identified parameters:"]
    for title, names in (
        ("Mass", ("mass",)),
        ("CoM moment", PARAMETER_NAMES[1:4]),
        ("Inertia", PARAMETER_NAMES[4:]),
    ):
        numbers = _decimals_text([rows[name]["value"] for name in names])
        numbers = numbers if title == "Mass" else f"[{numbers}]"
        lines.append(f"  {title}: {numbers} {rows[names[0]]['unit']}")
    for term in ("coulomb", "viscous"):
        if term in rows:
            value = rows[term]["value"]
            # Adding zero turns the -0.00 that rounding leaves into 0.00.
            rounded = round(value, 2) + 0.0
            number = f"{value:.1g}" if value and not rounded else f"{rounded:.2f}"
            name = label(rows[term]).capitalize()
            lines.append(f"  {name}: {number} {rows[term]['unit']}")
    return [*lines, *_quality_lines(content)]


def _quality_lines(content: Content) -> list[str]:
    """Return the lines on residual, condition number and base parameters of the regressor."""
    return [
        f"  RMSE: {content['rmse']:.4f} N·m",
        f"  Condition number: {content['condition_number'] or math.inf:.1f}",
        f"  Base parameters: {content['n_base_params']}",
    ]


def _decimals_text(values: Sequence[float]) -> str:
    """Return numbers with three decimals; if all are below 0.01, with two digits of the largest."""
    largest = np.max(np.abs(values))
    is_small = 0.0 < largest < SMALL
    decimals = 1 - math.floor(math.log10(largest)) if is_small else 3
    return ", ".join(f"{value:.{decimals}f}" for value in values)


def more_lines(content: Content) -> list[str]:
    """Return the lines below the block; those for --verbose only are ``Detail``."""
    lines: list[str] = []
    if content["question"] == PAYLOAD:
        lines += _payload_lines(content)
    elif content["failure"] is None:
        lines += largest_changes(content)
    lines += _validation_lines(content)
    if content["file"] is not None and content["file"]["kept"]:
        lines.append(Detail(f"As in the model: {', '.join(content['file']['kept'])}"))
    if content["source"] != ITSELF:
        lines += map(Detail, _quality_lines(content))
    lines.append(Detail("  RMSE per joint [N·m; N of a slide]:"))
    for joint, rmse in content["rmse_per_joint"].items():
        noise = content["noise_per_joint"].get(joint)
        noise_text = "" if noise is None else f", noise {noise:.2g}"
        lines.append(Detail(f"    {joint}: {rmse:.2e}{noise_text}"))
    return lines


def _payload_lines(content: Content) -> Iterator[str]:
    """Yield lines on the link without and with a payload, and on torque scales."""
    link = content["body_name"]
    for preposition, body in (("without", link), ("with", f"{link} with payload")):
        mass, *com = body_rows(content, body)[:4]
        text = f"{number_with_error(mass)}, {centre_text(com)}"
        yield Detail(f"Terminal link {preposition} it: {text}")
    scales = [row for row in content["quantities"] if row["name"] == "torque_scale"]
    if scales:
        known = content["payload"]["known_mass"]
        yield (
            f"Torque scales by the known mass of {known:g} kg (what the log reads over what is "
            "there):"
        )
    for row in scales:
        yield f"  {row['of']}: {number_with_error(row)}"


def _validation_lines(content: Content) -> Iterator[str]:
    """Yield lines on torque errors of data that was not fitted.

    They are errors of the written file on other logs; where there is no file, errors of the fit.
    The verdict states the error of the file on held-out data.
    """
    tests = content["validation"]
    file = content["file"]
    if file is not None:
        for test in file["others"]:
            shares = _errors_text_of(test)
            yield f"Torque error of the model on {test['before']['source']}: {shares}"
        sources = [test["before"]["source"] for test in file["others"]]
        tests = [test for test in tests[1:] if test["source"] not in sources]
    for test in tests:
        share = test["relative_error"]
        relative = "" if share is None else f" ({percent(share)})"
        yield f"Validation on {test['source']}: {test['rmse']:.4f} N·m{relative}"


def folder_text(folder: Path) -> str:
    """Return a folder as the user would type it, with a trailing slash: ./sysid_output/."""
    text = folder.as_posix()
    prefix = "" if folder.is_absolute() or text.startswith(".") else "./"
    return f"{prefix}{text}/" if text != "." else "./"


def folder_line(folder: Path, is_detail: bool) -> str:
    """Return where the results are, a detail where a file of them is named anyway."""
    line = f"Results saved to {folder_text(folder)}"
    return Detail(line) if is_detail else line


def verdict_lines(content: Content, files: Sequence[Path] = ()) -> Iterator[str]:
    """Yield whether to use a result: the file and its errors, the number, and what to watch.

    Args:
        content: of params.json.
        files: the written files; without them no file is named.
    """
    if content["failure"] is not None:
        yield f"Not usable: {content['failure']}"
        return
    unseen = ", ".join(content["unidentifiable"])
    if content["source"] == ITSELF:
        use = (
            "Self-test passed: the model's own numbers came back from its own simulation, which "
            "says nothing of the real arm"
        )
        yield use + (f" (not identifiable: {unseen})" if unseen else "")
        return
    file = content["file"]
    elsewhere = file and file_to_use(file)["elsewhere"]
    usable = "Usable"
    if elsewhere and elsewhere["for_like_motions"]:
        usable = "Usable for motions like this log"
    use = Verdict[content["status"]].use.format(usable=usable, unseen=unseen)
    payload = content["payload"]
    path = _first_file(files)
    parts = [f"{path}, the arm with its payload" if path and payload else path]
    parts.append(_errors_text(content) if file else "")
    if payload and payload["known_mass"]:
        parts.append("torque scales follow from the known mass")
    said = "; ".join(filter(None, parts))
    yield f"{use}: {said}" if said else use
    if not payload or not payload["known_mass"]:
        yield _mass_text_of(content)
    if lacking := [*_what_to_watch(content, elsewhere)]:
        yield f"Watch: {'; '.join(lacking)}"


def _first_file(files: Sequence[Path]) -> str:
    """Return the written model file to use first; "" where there is none."""
    first = curved_file_in(files) or next(iter(models_in(files)), None)
    return str(first or "")


def file_to_use(file: Content) -> Content:
    """Return what is said of the file that is named first: that with curves, if it is written."""
    curved: Content | None = file["curved"]
    return curved if curved and curved["name"] else file


def _what_to_watch(content: Content, elsewhere: Content | None) -> Iterator[str]:
    """Yield phrases on what the errors of a result do not cover, or come from."""
    if elsewhere and elsewhere["faster"]:
        # The speed of the fastest joint says nothing of the one that was too slow.
        of_log = percent(elsewhere["at_log_speeds"]["relative_error"])
        yield (
            f"motions faster than the log's (at its speeds {of_log}): record faster, mostly "
            f"{elsewhere['faster']}"
        )
    if elsewhere and elsewhere["still"]:
        yield f"{', '.join(elsewhere['still'])} stood still, or had no torque"
    scales = content["unshown_scales"]
    if scales:
        owner, largest = max(scales.items(), key=lambda item: item[1])
        yield (
            f"if torques of {owner} read up to {largest:.2f} times too much or too little, this "
            "log would not show it (a known weight does)"
        )


def before_after_text(tests: Content, kind: str = "") -> str:
    """Return the relative errors "before" and "after" as text, such as "27 % -> 0.3 %".

    An error that is not known is left out, "not known" stands for both. The errors are those
    without offsets of sensors, or with ``kind`` "_as_used" those with them.
    """
    errors = [
        tests[f"{model}{kind}"]["relative_error"] for model in ("before", "after")
    ]
    texts = [percent(error) for error in errors if error is not None]
    return " -> ".join(texts) or "not known"


def _errors_text_of(tests: Content, where: str = "", is_by_aside: bool = False) -> str:
    """Return the relative errors "before" and "after" of a file as it is used, and behind ``where``
    those with offsets aside, if they are others or the verdict follows from them.
    """
    text = f"{before_after_text(tests, '_as_used')}{where}"
    used, aside = (
        percent(tests[after]["relative_error"] or 0.0)
        for after in ("after_as_used", "after")
    )
    if aside != used or is_by_aside:
        text += f" ({before_after_text(tests)} torque offsets aside)"
    return text


def _errors_text(content: Content) -> str:
    """Return a phrase on the torque errors of the file to use, here and on other motions."""
    # A payload is part of both models: the change is that of links and friction.
    load = " with the payload" if content["payload"] else ""
    first = file_to_use(content["file"])
    # What is as good as before with offsets aside may look much better as it is used.
    is_by_aside = Verdict[content["status"]] is Verdict.AS_GOOD
    text = f"torque error{load} {_errors_text_of(first, ' here', is_by_aside)}"
    elsewhere = first["elsewhere"]
    if elsewhere:
        shares = [
            percent(elsewhere[model]["relative_error"]) for model in ("before", "after")
        ]
        speed = f"{elsewhere['speed']:.2g} {elsewhere['speed_unit']}"
        text += f", {' -> '.join(shares)} expected on other motions up to {speed}"
    return text


def _mass_text_of(content: Content) -> str:
    """Return a sentence on the mass that was asked for, with what makes most of its error."""
    of = PAYLOAD if content["payload"] else content["body_name"]
    row = next((row for row in rows_of(content, of) if row["name"] == "mass"), None)
    if row is None or row["error"] is None or row["value"] <= 0.0:
        return f"The mass of {of} alone is not identifiable"
    mass = number_with_error(row)
    text = f"{'The payload' if of == PAYLOAD else of} weighs {mass}"
    if row["error"] >= KNOWN * row["value"]:
        text = f"The mass of {of} alone is not known: {mass}"
    return f"{text}, ± mostly from {row['reason']}" if row["reason"] else text


def load_lines(path: Path) -> Iterator[str]:
    """Yield how Python loads a written model, and which MuJoCo does."""
    yield Detail(f"  mujoco.MjModel.from_xml_path({quoted_text(str(path))})")
    yield Detail(
        f"It loads in MuJoCo {mujoco.__version__} (tested); others from 3.0 on load it if they "
        "load your model"
    )


def file_lines(content: Content, files: Sequence[Path]) -> Iterator[str]:
    """Yield lines on the written model files beside the first: where friction bends, the straight.

    Args:
        content: of params.json.
        files: the written files.
    """
    curved = curved_file_in(files)
    for path in models_in(files)[:1]:
        if curved:
            error = percent(content["file"]["after"]["relative_error"] or 0.0)
            yield (
                f"With MuJoCo before 3.7, or another simulator: {path} (friction linear in speed; "
                f"torque error {error})"
            )
        yield from load_lines(curved or path)


def card_lines(files: Iterable[Path]) -> list[str]:
    """Return a line for each card of a simulator, or of an arm's software, among written files."""
    names = {SIMULATOR_CARD_NAMES[key]: name for key, name in SIMULATORS.items()}
    names |= {file_name: name for name, file_name in DRIVERS.values()}
    return [f"For {names[path.name]}: {path}" for path in files if path.name in names]


def last_lines(
    content: Content, files: Sequence[Path], step: NextStep | None
) -> list[str]:
    """Return the last lines of the console: the verdict, which files to use, and the next step.

    Args:
        content: of params.json.
        files: the written files, among them the model and a payload's card.
        step: the next step, or None.
    """
    lines = [*verdict_lines(content, files)]
    if content["failure"] is not None:
        return lines
    # A self-test writes back what its model says already.
    if content["source"] != ITSELF:
        lines += file_lines(content, files)
    lines += card_lines(files)
    if content["payload"] is not None:
        flange = content["payload"]["flange"]["name"]
        start = f"Copy into the controller, in the frame of {flange}"
        lines += [f"{start}: {path}" for path in files if path.name == CARD_NAME]
    lines += step.lines() if step else ()
    return lines


# ---- what a plan expects


def file_line(file: ExpectedFile, mass_error: float) -> str:
    """Return how far off a file is expected to be, as a sentence.

    ``mass_error`` is the standard error of the mass of what the last link carries [kg].
    """
    details = []
    if file.friction is not None:
        details.append(f"friction to {percent(file.friction)}")
    if np.isfinite(mass_error):
        details.append(f"a load to ± {_mass_text(mass_error)}")
    sentence = (
        f"Expected of its log: a model whose torques are {percent(file.least)} (little friction) "
        f"to {percent(file.after)} (much) off on any motion up to {file.speed:.2g} "
        f"{file.speed_unit}"
    )
    return "; ".join([sentence, ", ".join(details)]) if details else sentence


def error_lines(prediction: Prediction) -> Iterator[str]:
    """Yield the errors to expect of the written file, those that an identification will state, and
    the largest causes of these.
    """
    if prediction.file is not None:
        yield file_line(prediction.file, float(prediction.errors[0]))
    recorded = "Recorded once"
    note = "; the torques that these numbers make together are known better"
    if prediction.load is not None:
        recorded = RECORDED_FOR_PAYLOAD
        note = ""
    subject = subject_text(prediction)
    # What a file is expected to be says more than the numbers in it.
    line = str if prediction.file is None else Detail
    yield line(f"{recorded}, it determines {subject} with these errors{note}:")
    mass = prediction.errors[0]
    centre = prediction.centre_error
    # The causes, the one with the largest error of the mass first.
    causes = sorted(prediction.by_cause.items(), key=lambda cause: -cause[1][0])
    if np.isfinite(mass):
        share = percent(prediction.relative_mass_error)
        yield line(f"  mass ± {_mass_text(mass)} ({share}), limited by {causes[0][0]}")
    if np.isfinite(centre):
        cause = max(causes, key=lambda cause: cause[1][1])[0]
        yield line(f"  centre of mass ± {_length_text(centre)}, limited by {cause}")
    if prediction.link_mass_errors:
        listed = ", ".join(
            f"{name} {percent(error)}"
            for name, error in prediction.link_mass_errors.items()
        )
        yield Detail(f"  mass of the other links: {listed}")
    uncertain = []
    relative_errors = prediction.errors / prediction.size
    for name, error in zip(PARAMETER_NAMES, relative_errors):
        if error > LARGE_SHARE:
            known = percent(error) if np.isfinite(error) else "not identified"
            uncertain.append(f"{name} {known}")
    if uncertain:
        yield Detail(
            f"  above {percent(LARGE_SHARE)} of their size: {', '.join(uncertain)}"
        )
    for combination in prediction.invisible:
        yield (
            f"No motion of these joints identifies {combination}: use "
            f"{option_setting('torques', 'chain')} if only the last joint is used now, or "
            "mount the base at another angle"
        )
    for cause, (mass_error, centre_error) in causes:
        yield Detail(
            f"  by {cause}: mass {_mass_text(mass_error)}, centre of mass "
            f"{_length_text(centre_error)}"
        )


def subject_text(prediction: Prediction) -> str:
    """Return which body errors are expected of, in words."""
    if prediction.load is None:
        return prediction.body
    reserve = option_name("payload_reserve")
    return f"a load of {prediction.load:.3g} kg ({reserve} states another one)"


def _mass_text(kilograms: float) -> str:
    """Return a mass with two digits."""
    return size_text(kilograms, LEAST_MASS, "kg")


def _length_text(metres: float) -> str:
    """Return a length in millimetres with two digits."""
    return size_text(1e3 * metres, LEAST_MILLIMETRES, "mm")
