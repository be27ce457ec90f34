"""More of a log makes no stated error larger: pieces of a log, and its repetitions.

A longer log also tells better how wrong the model's links are, and which prior it contradicts. What
it finds may widen the priors, and errors with them. With the priors and choices of the whole log in
all of its pieces, nothing may grow.
"""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest

from benchmarks.real_arms import ARMS, SENSOR_ARMS, draw_arm
from robot_sysid.estimation import errors
from robot_sysid.estimation.algebra.consistent_bodies import project_errors
from robot_sysid.estimation.choices import choose
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.identify import Piece, low_pass_recordings
from robot_sysid.estimation.question import EstimationOptions, Question
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import open_log
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement
from robot_sysid.records.messages import Progress
from tests.support.core_fits import fitter_of
from tests.support.places import DATA, MODELS

GROWTH = 1.05
"""Largest ratio of a stated error to that of a part of the same data; noise is estimated anew."""
PARTS = (0.25, 0.5, 1.0)
QUESTION = Question(EstimationOptions())

pytestmark = pytest.mark.slow


def first_part(log, share):
    """The beginning of a log."""
    end = int(share * len(log.time))
    return Measurement(log.time[:end], log.q[:end], None, log.tau[:end])


def pieces_of_a_real_log(run):
    """(robot, a list of logs per part) of a KUKA LWR4+."""
    if not DATA.exists():
        pytest.skip("the logs of real arms are not here")
    folder = DATA / "kuka_lwr4"
    robot = load_robot_model(folder / "kuka_lwr4.urdf")
    path = folder / f"lwr4_hw{run}_200Hz.csv"
    log = open_log(robot, path, LogOptions(measurements=(path,)), Progress()).samples
    return robot, [[first_part(log, share)] for share in PARTS]


def pieces_of_a_wrong_model(arm_name, seed):
    """The same of an arm whose links are as wrong as real ones."""
    if not MODELS.exists():
        pytest.skip("public models are not here")
    robot = load_robot_model(MODELS / ARMS[arm_name])
    log = draw_arm(
        robot, "real", arm_name in SENSOR_ARMS, 24.0, seed % 2 == 0, seed
    ).log
    return robot, [[first_part(log, share)] for share in PARTS]


def repetitions(arm_name, seed):
    """The same of half of such a log, one, two and four times with new noise."""
    robot, parts = pieces_of_a_wrong_model(arm_name, seed)
    log = parts[1][0]
    rng = np.random.default_rng(seed)
    size = 0.003 * np.max(np.abs(log.tau), axis=0)
    logs = [
        replace(log, tau=log.tau + size * rng.standard_normal(log.tau.shape))
        for _ in range(4)
    ]
    return robot, [logs[:count] for count in (1, 2, 4)]


CASES = [
    *(pytest.param(pieces_of_a_real_log, (run,), id=f"run {run}") for run in (2, 3)),
    pytest.param(pieces_of_a_wrong_model, ("ur5e", 2), id="ur5e 2"),
    pytest.param(pieces_of_a_wrong_model, ("ur5e", 3), id="ur5e 3"),
    pytest.param(pieces_of_a_wrong_model, ("iiwa14", 0), id="iiwa14"),
    pytest.param(repetitions, ("ur5e", 2), id="repeated ur5e"),
    pytest.param(repetitions, ("iiwa14", 0), id="repeated iiwa14"),
]


def fitter_of_logs(robot, logs):
    """What fits some logs."""
    pieces = [Piece(f"log{number}", log) for number, log in enumerate(logs)]
    return fitter_of(robot, low_pass_recordings(robot, pieces, QUESTION.options)[0])


def choice_and_start(fitter):
    """What a fitter's logs choose, and where the fit begins."""
    choice, _, start = choose(fitter, QUESTION, QUESTION.options.friction)
    return choice, start


def mass_errors(fit, found=None):
    """Stated errors (links,) of all masses [kg], of the errors of a fit that are known already."""
    found = found or fit_errors(fit)
    kept = fit.unknowns.estimated
    places = [np.searchsorted(kept, at[0]) for at, _ in fit.unknowns.bodies.values()]
    covariance, _, _ = found.of(np.eye(len(kept))[places], fit.values[kept[places]])
    return np.sqrt(np.diag(covariance))


def growths(table):
    """Ratios (parts - 1, links) of errors (parts, links) to the least of smaller parts."""
    return table[1:] / np.minimum.accumulate(table, axis=0)[:-1]


@pytest.mark.parametrize(("pieces", "given"), CASES)
def test_with_the_same_priors_more_data_makes_no_mass_less_certain(
    pieces, given, monkeypatch
):
    """A body at the edge of what is possible has less room to be off than one inside: errors of
    possible bodies are below those that may not grow, and not always in the same proportion.
    """
    robot, parts = pieces(*given)
    fitters = [fitter_of_logs(robot, logs) for logs in parts]
    choice, _ = choice_and_start(fitters[-1])
    before = []

    def noted(whole, *given):
        before.append(whole)
        return project_errors(whole, *given)

    monkeypatch.setattr(errors, "misfits", lambda *_: ())
    monkeypatch.setattr(errors, "project_errors", noted)
    stated = []
    unrestricted = []
    for fitter in fitters:
        fit = fitter.fit(QUESTION, choice)
        found = fit_errors(fit)
        stated.append(mass_errors(fit, found))
        unrestricted.append(mass_errors(fit, replace(found, total=before.pop())))
    stated = np.array(stated)
    unrestricted = np.array(unrestricted)
    print(np.round(stated, 3), np.round(unrestricted, 3), sep="\n")
    assert np.max(growths(unrestricted)) < GROWTH
    assert np.max(stated / unrestricted) < 1.01


@pytest.mark.parametrize(("pieces", "given"), [CASES[k] for k in (0, 2, 4)])
def test_errors_grow_no_more_than_the_links_prior(pieces, given):
    """By default, with everything chosen anew from each part."""
    robot, parts = pieces(*given)
    table = []
    scales = []
    for logs in parts:
        fitter = fitter_of_logs(robot, logs)
        choice, start = choice_and_start(fitter)
        table.append(mass_errors(fitter.fit(QUESTION, choice, start)))
        scales.append(astuple(choice.link_scales))
    print(np.round(table, 3), np.round(scales, 2), sep="\n")
    wider = np.max(growths(np.array(scales)), axis=1)
    assert np.all(growths(np.array(table)) < GROWTH * np.maximum(wider, 1.0)[:, None])
