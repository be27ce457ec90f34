"""How far links are off, in their errors, where the model has mistakes in them.

    OMP_NUM_THREADS=1 python -m benchmarks.trust.link_mistakes MODELS [--logs 3] [--first-seed 100]
        [--arms ur5e panda ...] [--write]

Each log is of an arm that is as far off its model as real ones are (``real_arms``, "real", 20 s).
The model that it is identified with has a mistake in one or both of the two links before the last
with the largest first moments. Printed per mistake: in how many logs a mistake of these links alone
is named, in how many one of another link; then without and with the search for mistakes in how many
logs a number of a link before the last is more than three errors off, and the root mean square of
errors over stated errors of masses, centres of mass and inertias about these. The levels were set
with other seeds. ``--write`` puts the table into docs/evidence.md, five minutes on one core.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Mapping
from unittest.mock import patch

import numpy as np

from benchmarks.trust.real_arms import SENSOR_ARMS, arms_parser
from rigs.arms.wrong_arms import ARMS, draw_arm, write_link
from rigs.files.page_tables import PageTable
from rigs.files.places import ROOT
from robot_sysid import spatial
from robot_sysid.estimate import choose
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.levels import SURE
from robot_sysid.signals.process import low_pass_recordings

TABLE = PageTable(
    ROOT / "docs" / "evidence.md",
    "link_mistakes",
    "python -m benchmarks.trust.link_mistakes",
)
USUAL_ARMS = ("ur5e", "iiwa14", "panda", "gen3", "xarm7")
DURATION = 20.0
"""[s]"""
STEP = 1e-6
"""Step of a numerical derivative, as a share of a parameter or of 1e-3."""
Bodies = Mapping[int, Array]
"""Number of a link to its body (10,)."""


def mirrored(theta: Array) -> Array:
    """Return a body (10,) whose centre of mass has the wrong signs."""
    mass, centre, inertia = spatial.com_from_theta(theta)
    return spatial.theta_from_com(mass, -centre, inertia)


def turned(theta: Array) -> Array:
    """Return a body (10,) whose centre of mass is turned by 90 degrees about another axis."""
    mass, centre, inertia = spatial.com_from_theta(theta)
    axis = np.roll(np.eye(3), 1, axis=0)[np.argmax(np.abs(centre))]
    quarter = np.outer(axis, axis) + spatial.skew(axis)
    return spatial.theta_from_com(mass, quarter @ centre, inertia)


def about_origin(theta: Array) -> Array:
    """Return a body (10,) whose inertia about the centre of mass is that about the origin."""
    mass, centre, _ = spatial.com_from_theta(theta)
    return spatial.theta_from_com(mass, centre, spatial.symmetric_from_six(theta[4:]))


MISTAKES: Mapping[str, Callable[[Array, int, int], Bodies]] = {
    "none": lambda thetas, first, second: {},
    "centre of one mirrored": lambda thetas, first, second: {
        second: mirrored(thetas[second])
    },
    "centres of two mirrored": lambda thetas, first, second: {
        first: mirrored(thetas[first]),
        second: mirrored(thetas[second]),
    },
    "centre of one turned": lambda thetas, first, second: {
        second: turned(thetas[second])
    },
    "inertia about the origin": lambda thetas, first, second: {
        first: about_origin(thetas[first])
    },
    "numbers of two exchanged": lambda thetas, first, second: {
        first: thetas[second],
        second: thetas[first],
    },
    "mass of one twice": lambda thetas, first, second: {second: 2.0 * thetas[second]},
}
"""What is wrong, to the function that returns the wrong bodies of two links."""


def wrong_model(robot: RobotModel, bodies: Bodies) -> RobotModel:
    """Return an arm whose model has wrong bodies."""
    model = copy.copy(robot.mj_model)
    for number, body in bodies.items():
        write_link(model, robot.links[number], body)
    return load_robot_model(model, robot.joint_names[-1])


def numbers_of(theta: Array) -> Array:
    """Return the mass, the centre of mass and the inertia about it (10,) of a body (10,)."""
    mass, centre, inertia = spatial.com_from_theta(theta)
    return np.concatenate(([mass], centre, spatial.six_from_symmetric(inertia)))


def errors_over_stated(answer: Fit, true: Array) -> Array:
    """Return errors over stated errors (L, 10) of the numbers of links before the last."""
    rows = []
    for number in answer.arm.others:
        places = answer.at(answer.arm.links[number])
        theta = answer.values[places]
        steps = np.diag(STEP * np.maximum(np.abs(theta), 1e-3))
        slopes = [
            (numbers_of(theta + step) - numbers_of(theta - step)) / (2.0 * np.sum(step))
            for step in steps
        ]
        covariance = answer.covariance[np.ix_(places, places)]
        variances = np.diag(np.transpose(slopes) @ covariance @ slopes)
        off = numbers_of(theta) - numbers_of(true[number])
        rows.append(off / np.sqrt(np.maximum(variances, 1e-300)))
    return np.array(rows)


def row(
    name: str, count: int, named: list[bool], offs: Mapping[bool, list[Array]]
) -> str:
    """Return the row of a mistake.

    Args:
        name: of the mistake.
        count: of logs.
        named: of each log in which something is named, whether it is that mistake alone.
        offs: whether mistakes are looked for, to the errors over stated errors of each log.
    """
    cells = [name, str(sum(named)), str(len(named) - sum(named))]
    for is_asked in (False, True):
        far = [np.max(np.abs(off)) > SURE for off in offs[is_asked]]
        every = np.concatenate(offs[is_asked])
        spans = (every[:, :1], every[:, 1:4], every[:, 4:])
        rms = (f"{np.sqrt(np.mean(span**2)):.2f}" for span in spans)
        cells += [f"{sum(far)} of {count}", ", ".join(rms)]
    return f"| {' | '.join(cells)} |"


def main() -> int:
    """Print the table; write it where that is asked for."""
    parser = arms_parser(__doc__, USUAL_ARMS)
    parser.set_defaults(first_seed=100)
    parser.add_argument("--logs", type=int, default=3)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    lines = [
        "",
        "| Wrong in the model | named | something else named | more than 3 ± off, without | rms "
        "over stated: mass, centre, inertia | with | rms |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    robots = {arm: load_robot_model(options.models / ARMS[arm]) for arm in options.arms}
    seeds = range(options.first_seed, options.first_seed + options.logs)
    for name, change in MISTAKES.items():
        named: list[bool] = []
        offs: dict[bool, list[Array]] = {False: [], True: []}
        for arm, robot in robots.items():
            moments = [np.linalg.norm(link.theta[1:4]) for link in robot.links[:-1]]
            first, second = np.argsort(moments)[:-3:-1].tolist()
            bodies = change(robot.thetas, first, second)
            model = wrong_model(robot, bodies)
            for seed in seeds:
                has_sensors = arm in SENSOR_ARMS
                truth = draw_arm(
                    robot, "real", has_sensors, DURATION, seed % 2 == 0, seed
                )
                recordings, _ = low_pass_recordings(model, [truth.log], None)
                question = Question(EstimationOptions())
                fitted = choose.solve_question(model, recordings, question)
                for is_asked in offs:
                    if is_asked:
                        answer = choose.answer_of(fitted)
                    else:
                        with patch.object(choose, "shown_mistakes", lambda _: ((), ())):
                            answer = choose.answer_of(fitted)
                    offs[is_asked].append(errors_over_stated(answer, truth.arm.thetas))
                mistakes = answer.question.mistakes
                links = {number for mistake in mistakes for number in mistake.links}
                if mistakes:
                    named.append(links <= set(bodies))
        lines.append(row(name, len(offs[True]), named, offs))
        print(lines[-1], file=sys.stderr, flush=True)
    lines.append("")
    TABLE.show(lines, options.write)
    return 0


if __name__ == "__main__":
    sys.exit(main())
