"""Inertias in model files: which body gets which part of a link, and their text, exact to the last
digit.

The terminal body gets what was identified of the link minus the bodies below it that the file
describes. Where that difference is no possible body, the terminal body gets the inertia of all that
is rigidly attached to it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid import spatial
from robot_sysid.errors import ExportError
from robot_sysid.records import Array, SubtreeBody
from robot_sysid.records.messages import Detail

SLACK = 1e-10
"""How far a body may be from possible, relative to its size, before it is refused."""
MARGIN = 1e-11
"""How far inside the possible a body is written, relative to its size: some 4e4 roundings, because
MuJoCo refuses what these put outside."""
URDF_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
"""Attributes of a URDF's <inertia> [kg m^2], in the order of ``spatial.six_from_symmetric``."""


@dataclass(frozen=True)
class WriteBack:
    """The inertia to write into the bodies of one link.

    Attributes:
        theta: (10,) inertial parameters of the terminal body alone, in its own frame.
        emptied: the other bodies of the link that lose their inertia.
        composite: (10,) inertial parameters of the whole link as written.
        notes: for the user, a sentence each on what was changed.
    """

    theta: Array
    emptied: Sequence[SubtreeBody]
    composite: Array
    notes: tuple[str, ...]


def plan_write_back(
    composite: Array, bodies: Sequence[SubtreeBody], least_moment: float = 0.0
) -> WriteBack:
    """Return how an identified composite is shared among the bodies of the terminal link.

    The terminal body gets the difference to the other bodies; where that is no possible body, those
    welded to it are emptied.

    Args:
        composite: (10,) identified theta of the terminal body and all below it together, in the
            terminal body's frame.
        bodies: the terminal body and all below it as the model has them, the terminal body first.
        least_moment: smallest principal moment the file's compiler leaves alone [kg m^2].

    Raises:
        ExportError: the composite is no possible body itself, or leaves no room for the bodies on
            joints of their own.
    """
    mass = composite[0]
    name = bodies[0].name
    # A body without mass and inertia takes nothing away.
    others = [body for body in bodies[1:] if np.any(body.theta)]
    emptied = []
    remainder = composite - sum_theta(others)
    if possible_body(remainder, mass, least_moment) is None:
        emptied = [body for body in others if body.welded]
        remainder += sum_theta(emptied)
    theta = possible_body(remainder, mass, least_moment)
    if theta is None:
        raise ExportError(
            f"the identified parameters of body '{name}' are not a possible rigid body, or leave "
            "none beside what hangs on it on joints of its own; use a "
            "longer motion, or a model without fingers that the arm did not have"
        )
    notes = []
    if emptied:
        listed = "', '".join(body.name for body in emptied)
        notes.append(
            Detail(
                f"body '{name}' now holds the inertia of all that is rigidly attached to it, and "
                f"'{listed}' none in the written model"
            )
        )
    added = theta - remainder
    # Equally much is added to each moment of inertia; element 4 is Ixx.
    inflation = added[4]
    moments = np.trace(spatial.com_from_theta(theta)[2])
    if inflation > SLACK * moments:  # by more than rounding
        # What it changes of the torques is in the error of the file.
        notes.append(
            Detail(
                f"the moments of inertia of '{name}' are smaller than the file's compiler admits "
                f"(boundinertia), so all three are written {inflation:.2g} kg·m² larger"
            )
        )
    return WriteBack(theta, emptied, composite + added, tuple(notes))


def sum_theta(bodies: Sequence[SubtreeBody]) -> Array:
    """Return the sum of the bodies' theta (10,), all in one frame; zeros for no bodies."""
    return sum((body.theta for body in bodies), np.zeros(10))


def possible_body(
    theta: Array, scale: float, least_moment: float = 0.0
) -> Array | None:
    """Return theta (10,) with all three moments of inertia raised until its body is possible.

    None where they would have to be raised too much, or where theta has no mass.

    A body is possible where its second moments about the centre of mass, tr(I)/2 1 - I, the upper
    left block of its pseudo-inertia there, are not negative. Rounding leaves a difference of two
    bodies on the edge; it is moved inside by adding one number to all three moments of inertia.
    Mass and centre of mass stay, unlike where eigenvalues of the pseudo-inertia are raised.

    Args:
        scale: mass of the larger of the two bodies [kg]; a millionth of it is only rounding.
        least_moment: smallest principal moment of inertia that the body must have [kg m^2].
    """
    mass, com, inertia = spatial.com_from_theta(theta)
    # The sum of the three second moments.
    size = np.trace(inertia) / 2.0
    if not np.all(np.isfinite(theta)) or mass <= 1e-6 * scale or size <= 0.0:
        return None
    moments = np.linalg.eigvalsh(inertia)
    smallest_share = 1.0 - moments[-1] / size
    # Adding s to each second moment adds 2 s to each moment of inertia.
    inflation = 2.0 * max(0.0, MARGIN - smallest_share) * size
    # Rounding alone explains second moments that are negative by SLACK, and a body of no mass, to
    # which the compiler gives its least one, those that are by its least moment.
    if inflation > 2.0 * ((SLACK + MARGIN) * size + least_moment):
        return None
    inflation = max(inflation, least_moment - moments[0])
    return spatial.theta_from_com(mass, com, inertia + inflation * np.eye(3))


def mjcf_inertial(theta: Array, principal: bool = False) -> str:
    """Return the MJCF ``<inertial>`` of theta (10,), exact to the last digit; all zero for zeros.

    Args:
        theta: in the body frame, with the inertia about the frame's origin.
        principal: whether to write principal moments and axes instead of the full matrix, whose
            axes MuJoCo before 3.14 finds to six digits only.
    """
    mass, com, inertia = spatial.com_from_theta(theta)
    head = f'<inertial pos="{format_numbers(com)}" mass="{float(mass)!r}"'
    if not np.any(theta):
        return f'{head} diaginertia="0 0 0"/>'
    if not principal:
        six = spatial.fullinertia_from_symmetric(inertia)
        return f'{head} fullinertia="{format_numbers(six)}"/>'
    moments, axes = np.linalg.eigh(inertia)
    # The columns of axes are the principal axes; MuJoCo takes the first two, one after the other.
    first_two = format_numbers(axes[:, :2].T.ravel())
    return f'{head} xyaxes="{first_two}" diaginertia="{format_numbers(moments)}"/>'


def urdf_inertial_about_com(mass: float, com: Array, inertia: Array) -> str:
    """Return the ``<inertial>`` of a URDF's link, with all digits.

    Args:
        mass: [kg].
        com: (3,) centre of mass in the link's frame [m].
        inertia: (3, 3) about the centre of mass, in the link's axes [kg m^2].
    """
    six = map(format_number, spatial.six_from_symmetric(inertia))
    moments = " ".join(f'{name}="{text}"' for name, text in zip(URDF_MOMENTS, six))
    return (
        f'<inertial><origin xyz="{format_numbers(com)}" rpy="0 0 0"/>'
        f'<mass value="{float(mass)!r}"/>'
        f"<inertia {moments}/></inertial>"
    )


def format_numbers(values: Array) -> str:
    """Return numbers (k,) with all their digits, separated by spaces."""
    return " ".join(map(format_number, values))


def format_number(value: float) -> str:
    """Return a number with all its digits."""
    # Also turns -0.0 into 0.0; MuJoCo 3.3 refuses to read denormal numbers.
    return repr(float(value)) if abs(value) >= sys.float_info.min else "0.0"
