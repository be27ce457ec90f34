"""The match of a log's columns with quantities and joints, by titles, at two confidences.

Certain is a column whose title says nothing but its quantity and its joint, by the joint's name or
else by its number. What remains of a title beside its quantity is taken for the joint's name, and
``joint_names`` matches all of these with the model's. Where a quantity has no such names for all
joints, the numbers in its titles have to be exactly 0..n-1 or 1..n, or those of the model's names.
In a log that lists its joints, numbers stand for the names of the list. Where names and numbers
give different columns, the quantity cannot be told, and a log that needs it is refused.

Likely are columns with one title but for a number or a joint's name, of which a word beside others,
also one of another language, or a unit says what they are. A map of columns takes what is certain
(``column_map``); where that is too little, what is likely is suggested (``suggestion``).
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import chain
from typing import Any

from robot_sysid.errors import InputError
from robot_sysid.logs.declarations import is_plain_title
from robot_sysid.logs.joint_names import joint_note, match_joint_names, name_numbers
from robot_sysid.logs.titles import Title, token_set
from robot_sysid.records import RobotModel

MOST_SPARE = 2
"""Columns alike that a log may have beyond those of the arm's joints: those of a gripper."""
# Tokens that mark a measurement; those of the first kind outrank those of the second.
_MEASURED = (token_set("meas measured measurement msr"), token_set("actual act ist"))


class UnrecognisedError(InputError):
    """Titles do not say which column is what: there is none for a quantity, or several."""


class Confidence(IntEnum):
    """How sure it is what columns hold."""

    POSSIBLE = 1
    """No title says what they are; numbers may tell it."""
    LIKELY = 2
    """Titles say it beside other words."""
    CERTAIN = 3
    """Titles say nothing else, or the columns are declared."""


@dataclass(frozen=True)
class Match:
    """Columns that could hold a quantity, one per joint.

    Attributes:
        quantity: of ``Title.likely_quantity``; None where no title says it.
        columns: (n,) indices, base to terminal.
        text: what stands for them in a line of ``--columns``; "" where they need none.
        confidence: how sure the quantity is.
        spare: indices of further columns alike, such as that of a gripper.
    """

    quantity: str | None
    columns: tuple[int, ...]
    text: str
    confidence: Confidence
    spare: tuple[int, ...] = ()


def is_certain(matches: Sequence[Match]) -> bool:
    """Return whether there are matches, of the highest confidence."""
    return bool(matches) and matches[0].confidence == Confidence.CERTAIN


def match_of_title(title: Title, columns: tuple[int, ...], text: str) -> Match:
    """Return columns alike with the quantity that the title of the first one names, if any."""
    quantity = title.likely_quantity
    confidence = Confidence.LIKELY if quantity else Confidence.POSSIBLE
    return Match(quantity, columns, text, confidence)


def match_alike(titles: Sequence[Title], joint_names: Sequence[str]) -> Iterator[Match]:
    """Yield the columns with one title but for a number or a joint's name, as many as joints.

    The text of columns that a line cannot state by a pattern is "".
    """
    texts = [title.text for title in titles]
    alike: dict[tuple[int, ...], str] = {}
    for pattern in chain.from_iterable(_patterns(text, joint_names) for text in texts):
        with suppress(InputError):
            columns = tuple(fit_pattern(pattern, texts, joint_names)[0])
            alike.setdefault(columns, pattern if is_plain_title(pattern) else "")
    for columns, text in alike.items():
        if columns:
            yield match_of_title(titles[columns[0]], columns, text)


def match_with_spare(
    titles: Sequence[Title], joint_names: Sequence[str]
) -> Iterator[Match]:
    """Yield the first of columns that differ by a number alone and are a few more than joints.

    They are counted from 0 or 1; those of a gripper's fingers follow the arm's.
    """
    texts = [title.text for title in titles]
    n_joints = len(joint_names)
    alike: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for column, text in enumerate(texts):
        for number in re.finditer(r"\d+", text):
            pattern = f"{text[: number.start()]}*{text[number.end() :]}"
            alike[pattern].append((int(number[0]), column))
    for fits in alike.values():
        numbers, columns = zip(*sorted(fits))
        is_counted = numbers in (
            tuple(range(len(fits))),
            tuple(range(1, len(fits) + 1)),
        )
        if is_counted and 0 < len(fits) - n_joints <= MOST_SPARE:
            arm_columns = columns[:n_joints]
            match = match_of_title(titles[columns[0]], arm_columns, "")
            yield replace(match, spare=columns[n_joints:])


def _patterns(title: str, joint_names: Sequence[str]) -> list[str]:
    """Return a title with "*" for each of its numbers, or for a joint's name in it."""
    numbers = re.finditer(r"\d+", title)
    patterns = [f"{title[: m.start()]}*{title[m.end() :]}" for m in numbers]
    return patterns + [title.replace(n, "*") for n in joint_names if n in title]


def surest_matches(
    matches: Iterable[Match], quantity: str, titles: Sequence[Title]
) -> list[Match]:
    """Return those matches of a quantity that are surest; the measured ones, where some say so."""
    fitting = [match for match in matches if match.quantity == quantity]
    highest = max((match.confidence for match in fitting), default=None)
    surest = [match for match in fitting if match.confidence == highest]
    measured = measured_columns(titles, [match.columns[0] for match in surest])
    return [match for match in surest if match.columns[0] in measured]


def measured_columns(titles: Sequence[Title], columns: Sequence[int]) -> Sequence[int]:
    """Return those of some columns (indices) that a word marks as measured; all where none does."""
    for marks in _MEASURED:
        marked = [k for k in columns if marks & {*titles[k].translated.tokens}]
        if marked:
            return marked
    return columns


def fit_pattern(
    pattern: str,
    titles: Sequence[str],
    joint_names: Sequence[str],
    standing: Collection[str] = (),
) -> tuple[Sequence[int], str]:
    """Return the columns (n,) whose titles fit a pattern, base to terminal, and a note on names.

    "*" stands for the joint's number or name; of several, one does. Nothing is returned where no
    title fits. Joints that stand still have no column.

    Raises:
        InputError: as many titles fit as the arm has no joints, or another arm's.
    """
    for star in re.finditer(r"\*", pattern):
        front = pattern[: star.start()]
        back = pattern[star.end() :]
        # Compared as it is: a regular expression for each of many stars takes minutes.
        fits = [
            (title[len(front) : len(title) - len(back)], column)
            for column, title in enumerate(titles)
            if len(title) >= len(pattern)
            and title.startswith(front)
            and title.endswith(back)
        ]
        counted = [fit for fit in fits if fit[0].isdecimal()]
        fits = counted or fits
        if not fits:
            continue
        names = dict(fits)
        if counted:
            numbers = {int(text): column for text, column in fits}
            order = _order_of_numbers([*numbers], joint_names, standing, True)
            columns = [numbers[number] for number in order if number in numbers]
            note = ""
        else:
            moving = [name for name in joint_names if name not in standing]
            matched = match_joint_names([*names], moving)
            columns = [names[text] for text in matched]
            note = joint_note(matched, [*names])
        # Of two equal titles, one is lost.
        if columns and len(fits) == len(names):
            return columns, note
        listed = ", ".join(titles[column] for _, column in fits)
        raise InputError(
            f"{pattern!r} fits {len(fits)} columns ({listed}), and not one for each of the "
            f"{len(joint_names)} joints ({', '.join(joint_names)}): list the columns instead, "
            "base to last joint"
        )
    return (), ""


Candidates = Mapping[str, Sequence[Sequence[int]]]
"""Quantity to the indices of the columns that could be it: a list per joint, base to terminal."""


def match_joints(
    titles: Sequence[Title],
    robot: RobotModel,
    first_row: Sequence[str],
    quantities: Sequence[str],
    has_names: bool,
    absent: Mapping[str, Collection[str]],
) -> tuple[Candidates, str]:
    """Return the candidate columns of quantities, and a note on how joint names were matched.

    Joints have several candidates where titles name and count them, or occur twice; none where one
    of them would have none.

    Args:
        titles: of all columns, from left to right.
        robot: the arm.
        first_row: the cells of the first row as text, which may list joint names.
        quantities: of ``Title.joint_quantity``.
        has_names: whether positions are not declared, and their titles may name joints in other
            words than the model.
        absent: quantity to the names of joints that need no column of it.

    Raises:
        InputError: the joints' names are those of two arms, or of another arm.
    """
    joint_names = robot.joint_names
    listed_names = _listed_names(titles, first_row, robot.n_joints)
    # Quantity, and name or number of a joint, to indices of columns.
    named: Mapping[Any, list[int]] = defaultdict(list)
    counted: Mapping[Any, list[int]] = defaultdict(list)
    for column, title in enumerate(titles):
        name = title.joint
        numbers = title.numbers
        quantity = title.joint_quantity
        if quantity and len(numbers) == 1:
            name = listed_names.get(numbers[0], name)
        if name:
            named[quantity or title.quantity_beside_name, name].append(column)
        # A time without a number is the row's, not the single joint's own.
        if robot.n_joints == 1 and quantity != "joint_time":
            numbers = numbers or (0,)
        if len(numbers) == 1:
            counted[quantity, numbers[0]].append(column)
    names = [name for quantity, name in named if has_names and quantity == "position"]
    standing = absent.get("position", ())
    moving = [name for name in joint_names if name not in standing]
    matched = match_joint_names(names, joint_names)
    if standing and len({*names}) == len(moving):
        matched = matched or match_joint_names(names, moving)
    name_in_log = {joint: name for name, joint in matched.items()}
    candidates = {}
    order_of_positions: Sequence[int] = ()
    for quantity in quantities:
        without = absent.get(quantity, standing)
        own_names: Mapping[str, str] = name_in_log
        if quantity == "command":
            own_names = _names_of_commands(named, joint_names) or name_in_log
        by_name = [named[quantity, own_names.get(name, name)] for name in joint_names]
        # Names decide for all joints of a quantity or for none.
        if not all(c for c, j in zip(by_name, joint_names) if j not in without):
            by_name = [[]] * robot.n_joints
        taken = {*chain(*by_name)}
        by_number = {}
        for (its_quantity, number), columns in counted.items():
            others = [column for column in columns if column not in taken]
            if its_quantity == quantity and others:
                by_number[number] = others
        order: Sequence[int] = ()
        if not listed_names:
            order = _order_of_numbers([*by_number], joint_names)
            # Joints are counted as positions count them.
            places = [k for k, j in enumerate(joint_names) if j not in without]
            counting = [order_of_positions[k] for k in places if order_of_positions]
            if counting and sorted(by_number) == sorted(counting):
                order = order or order_of_positions
            elif not order_of_positions or without == standing:
                order = order or _order_of_numbers([*by_number], joint_names, without)
        if quantity == "position":
            order_of_positions = order
        numbered = [by_number.get(k, []) for k in order] or [[]] * robot.n_joints
        candidates[quantity] = [
            [*measured_columns(titles, columns), *measured_columns(titles, others)]
            for columns, others in zip(by_name, numbered)
        ]
    return candidates, joint_note(matched, names)


def _names_of_commands(
    named: Iterable[tuple[Any, str]], joint_names: Sequence[str]
) -> Mapping[str, str]:
    """Return joint to its name in titles of commands; empty where these do not name all.

    They come from another device than positions, and may have other words around them.

    Args:
        named: quantity, and name of a joint, of titles.
        joint_names: (n,) of the arm.
    """
    names = [name for quantity, name in named if quantity == "command"]
    with suppress(InputError):
        matched = match_joint_names(names, joint_names)
        return {joint: name for name, joint in matched.items()}
    return {}


def _order_of_numbers(
    numbers: Sequence[int],
    joint_names: Sequence[str],
    standing: Collection[str] = (),
    is_declared: bool = False,
) -> Sequence[int]:
    """Return which of the numbers in titles is each joint's, base to terminal; () for no answer.

    They are those of the joints' names, or count from 0 or 1; from any number where a user has
    declared the titles. Those of joints that stand still are not among them, but count.
    """
    places = [k for k, name in enumerate(joint_names) if name not in standing]
    order = sorted(numbers)
    own_numbers = name_numbers(joint_names)
    if own_numbers and order == sorted(own_numbers[k] for k in places):
        return own_numbers
    # Where the model's names are numbered in another order, counting contradicts them.
    if not order or own_numbers != sorted(own_numbers):
        return ()
    for start in [order[0] - places[0]] if is_declared else (0, 1):
        if order == [start + k for k in places]:
            return range(start, start + len(joint_names))
    return ()


def ambiguity_error(
    quantity: str, joint: str, titles: Sequence[Title], columns: Sequence[int]
) -> UnrecognisedError:
    """Return the error for a quantity that each of several columns (indices) could be.

    ``joint`` is "" for a quantity of no joint.
    """
    listed = " and ".join(repr(titles[column].text) for column in columns)
    of_joint = f" of joint {joint}" if joint else ""
    return UnrecognisedError(f"{listed} could both be the {quantity}{of_joint}")


def _listed_names(
    titles: Sequence[Title], first_row: Sequence[str], n_joints: int
) -> Mapping[int, str]:
    """Return the number of each joint in a log's own list of names; empty where it has none.

    ROS lists names in any order, such as that of the alphabet: in a column "name" with all names in
    its first row, or in columns "name[0]", "name[1]", ... with one each.
    """
    numbers = [t.numbers[0] for t in titles if t.quantity == "position" and t.numbers]
    first_number = min(numbers, default=0)
    names: dict[int, str] = {}
    for title, cell in zip(titles, first_row):
        if title.tokens and title.tokens[-1] in ("name", "names"):
            start = title.numbers[0] if title.numbers else first_number
            cell_names = re.findall(r"[^\s,'\"\[\]()]+", cell)
            names.update(enumerate(cell_names, start))
    # A shorter one is the name of something else, such as the robot.
    return names if len(names) >= max(2, n_joints) else {}
