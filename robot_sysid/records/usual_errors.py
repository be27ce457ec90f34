"""How wrong arms, their models and their sensors usually are, and where each figure was seen.

The one table: priors of the estimate, the torque that a plan reserves, and the checks of motors
read it. All are standard deviations unless a line says otherwise; users replace those of
``estimate.options.Priors`` with ``--priors``.
"""

from __future__ import annotations

import math

# ---- links

LINK = 5.0
"""Error of a link's mass, of its centre of mass as part of its size, and half of that of its
inertia, as models are taken to state them [%]; the scales below widen it."""
MASS_SCALES = (2.0, 4.0, 8.0)
"""Factors on ``LINK`` for masses that evidence chooses from: 10, 20, 40 %, as far as a maker's own
table of links was off."""
CENTRE_SCALES = (2.0, 4.0, 8.0)
"""The same for centres of mass: the upper arm of a UR10e is 73 mm off, a ninth of its size."""
INERTIA_SCALES = (2.0, 4.0, 8.0)
"""The same for inertias, whose error is twice as large: with 10 % as the least, a link whose mass
is 40 % off and whose inertia is not leaves its mass to the last link."""
USUAL_SCALES = (3.5, 1.5, 2.0)
"""Medians of the log-normal priors of these scales; their spread is one octave."""
EXPECTED_SCALES = (4.0, 2.0, 2.0)
"""Scales that are expected without any recording."""
LEAST_SIZE_SHARE = 0.15
"""Least size of a link in its prior, as a share of the distances between the arm's joints: a wrist
whose joints meet in a point is no smaller than its housing, as of a UR10e."""
LEAST_SIZE = 0.02
"""Least size of a link in its prior [m]."""
LEAST_MASS_SHARE = 0.07
"""Least mass that a link's errors are taken of, as a share of the arm's mass: that of the wrists of
a UR10e, UR5e and iiwa14."""

WEIGHT = 0.2
"""Error of the torque that carries an arm, as a share of it, where no model tells the links: their
masses are 10 to 20 % off."""
ROTOR = 15.0
"""Error of a rotor's inertia [%]: makers' lists are nearly right, while published models of arms
have several times as much; a judgement between."""

# ---- friction

DRY_FRICTION = 2.5
"""Median dry friction of a joint, as a share of its motor's rated torque [%], as of the joints of
an OpenArm, with motors of three sizes."""
VISCOUS_FRICTION = 1.7
"""Median viscous friction of a joint at 1 rad/s, as a share of its motor's rated torque [%], as of
the same joints."""
FRICTION_SPREAD = 0.7
"""Standard deviation of the logarithm of both, an octave, between those of the same joints."""
LOAD_LOSS = 2.0
"""Share of its load that a gear loses where the friction model has no term for it [%]."""
CURVATURE = 20.0
"""Bend of friction, over dry friction times ``LOAD_LOSS``: with it Coulomb friction of simulated
joints whose gears bend as much as they rub is within its stated error, with half as much not."""
FADING = 15.0
"""Each term that fades with speed, over dry friction times ``LOAD_LOSS``: Stribeck of 30 %."""
LARGEST_USUAL_LOSS = 2.5
"""Largest share of its load that a gear loses, over ``LOAD_LOSS``; where dry friction is large."""
LOADED_LOSS = 0.1
"""Share of its load that a gear loses, in weighing a payload: more than a UR10e's shoulder
loses."""
UNKNOWN_LAST_LINK = 0.2
"""How far off the last link may be of which nothing is known, over a link of this arm, where an
error on other motions is expected: with a whole link, files of logs in which joints stood still are
far better than is expected."""
UNKNOWN_JOINT = 0.3
"""Coulomb friction, viscous friction and rotor of a joint of an arm of which nothing is known, each
as a share of its torque. Without a bound on what a short log lets free, the error to expect on
other motions is beyond all measure."""
LARGE_OFFSET = 2.0
"""Offset of a torque sensor that an error on other motions allows for where none is found, over
``OFFSET``: sensors of real logs have up to several times that."""
FRICTION_CHANGE = 0.1
"""Relative change of friction from one log to another one, of another day or of a warmer gear: logs
of a UR10e differ by more than the errors of a single one."""
FRICTION_IN_A_DAY = 0.03
"""The same from one log to another one of the same day, with the gears as warm: as joints change
from the first to the second half of logs of real arms, beyond errors."""
FRICTION_DRIFT = 2.0 * FRICTION_CHANGE
"""Relative drift of friction from the middle of several logs to an end."""

LEFT_OF_TORQUE = 0.02
"""Torque that the terms of a real arm leave at a joint, as a share of the joint's torque. Most
joints of real arms leave less than the largest of this and the two below."""
LEFT_OF_FRICTION = 0.2
"""The same as a share of the joint's dry friction, where that is most of its torque."""
LEFT_OF_ALL = 0.001
"""The same as a share of the root mean square torque of all joints: of one that carries nothing."""

LARGEST_FRICTION = 1.5
"""Largest friction of a joint with a small motor that nobody knows, as it breaks loose [N m]: above
what elbows and wrists of small arms of several makers need."""
LARGEST_FRICTION_SHARES = (0.1, 0.25)
"""Least and greatest share of a motor's peak torque that this is: a motor that makes twice what its
joint needs turns a gear that loses a tenth of that, and more at rest; a motor of 3 N m is not used
for a joint that takes half of it."""

# Before any log, as shares of a joint's torque on motions all over the arm's range.

PLANNED_FRICTION = 0.3
"""Coulomb and viscous friction, each, less the model's; most models state none, or a guess. With
it, models are as far off on any motion as those of real arms are as they came, in the geometric
mean."""
PLANNED_ROTOR = 0.05
"""Torque that accelerates rotors, less the model's."""
PLANNED_DRY = 0.1
"""Dry friction that sizes what a model file does not hold: friction that fades, bends or grows with
the load. With a fifth of it files of slow motions are much worse than expected, with twice as much
much better: friction of arms lies between next to nothing, where their sensors sit behind the
gears, and a third of the torque."""
LITTLE_FRICTION = 0.1
"""Friction of an arm whose torque sensors sit behind its gears, over ``PLANNED_FRICTION`` and
``PLANNED_DRY``."""
PLANNED_LEAST = 0.03
"""Least torque of a joint of which these are shares, as a share of the strongest joint's: a wrist
that carries nothing has friction all the same."""

# ---- sensors and base

SCALE = 2.0
"""A joint's torque scale [%]."""
LOADED_SCALE = 3.0
"""A joint's torque scale where a payload is weighed, whose mass depends on it alone [%]: between
the errors of motor currents of a UR10e."""
SCALE_DRIFT = 0.25
"""Drift of a torque scale from the middle of several logs to an end [%]: without it, logs of a KUKA
LWR4+ differ at the last link by many standard errors. Of logs that are compared, scale and offset
by this share of the strongest joint's torque: weak joints of this arm change by more of their
own."""
ZERO = 2.0
"""Zero of a joint's encoder [mrad]."""
ZERO_DRIFT = 1.0
"""Drift of a zero from the middle of the logs that are compared to an end [mrad]."""
GRAVITY = 0.3
"""Tilt of the base [degrees]."""
GRAVITY_IN_FILE = 2.0
"""Gravity's direction in a model file [degrees]: more than a KUKA LWR4+ stands off."""
DELAY = 5.0
"""Delay of the torque beside the position [ms]."""
OFFSET = 0.01
"""Offset of a torque sensor, as a share of the strongest joint's torque; of one that is not
significant, of its own joint's: offsets of a KUKA LWR4+ are not known better."""
OFFSET_ALONE = 0.3
"""The same where the last joint's torque alone is used, as a share of that: the strongest joint of
an arm has ten to fifty times as much."""
LARGEST_DRIFT = 50.0
"""A drift of a zero, torque scale or offset that is a change of the arm, over the usual one: 50
mrad, 12 % of the torque."""

# ---- an arm that is compared with its model

WRONG_SCALE = 40.0
"""A torque scale that is wrong: another torque constant, or a gear of another ratio [%]."""
WRONG_ZERO = 100.0
"""A zero that is wrong [mrad]."""
WRONG_GRAVITY = 10.0
"""Tilt of a base that does not stand as the model says, about each axis [degrees]."""
WRONG_DELAY = 40.0
"""A delay that is wrong [ms]."""
WRONG_OFFSET = 50.0
"""A torque that pulls at a joint, such as a cable's, over the usual ``OFFSET``: half of what the
strongest joint has."""

# What links that are as far off as usual, and friction, look like in a fit that looks for something
# else: as large as the scales, zeros, tilts and offsets that short runs of sound simulated arms
# show.
LINKS_AS_SCALE = 10.0
"""Links as a joint's torque scale [%]: half of ``WEIGHT``."""
LINKS_AS_ZERO = 0.5
"""Links as a joint's zero [degrees]."""
LINKS_AS_TILT = 1.0
"""Links as a tilt of the base [degrees]."""
LINKS_AS_OFFSET = 0.1
"""Links as a torque that pulls at a joint, over the joint's torque: half of ``WEIGHT``."""

# ---- servos

SERVO_GAIN = 1.5
"""All gains of an arm's servos together over the model's, and one over the others' where the model
has none: standard deviation of the logarithm. Models of one arm, the SO-101, differ in their gains
by more than an order of magnitude, which is less than three of it."""
SERVO_GAIN_SPREAD = 0.5
"""Gain of one servo over the model's, beside what all have in common: standard deviation of the
logarithm. Servos of one arm are of one kind, and set alike."""
SERVO_BANDWIDTH = 20.0
"""Frequency of a servo's oscillation without damping where the model has no servo [rad/s]."""
SERVO_REACH = 0.5
"""Position error at which a servo reaches its torque limit [rad]: median of small servos, of which
the logarithm has a standard deviation of one, as those of the next two have."""
SERVO_LAG = 0.05
"""Damping of joint and servo together over the gain [s]."""
SERVO_LIMITED_DAMPING = 0.3
"""Share of this damping that a servo commands within its torque limit, less the model's: a small
servo's back-EMF is beside its limit, the kd of a motor with a current loop within it."""
SERVO_STICKING = 0.02
"""Dry friction over the gain: the position error that does not move a servo [rad]."""
SERVO_LOAD_SHARE = 0.15
"""Share of the torque of motor and links by which friction grows: mean of several types of servos.
A motion to one side alone does not tell it from the gain."""
SERVO_LOAD_SHARE_SPREAD = 0.08
"""Its standard deviation."""
SERVO_LOAD_STICKING = 0.1
"""What this share is more at rest: mean of several types of servos, and that of an XL330."""
SERVO_LOAD_STICKING_SPREAD = 0.1
"""Its standard deviation."""
SERVO_PLAY = math.radians(0.5)
"""Dead zone of a servo where none is seen [rad]: the play that the makers of an SO-101 state."""
SERVO_DELAY = 0.1
"""Time by which commands act late [s]: the way over a bus takes a hundredth, over a network a
tenth."""
SERVO_LOOP_LAG = 0.01
"""Time by which a servo smooths its commands [s]."""
SERVO_ZERO = math.radians(2.0)
"""What a joint's link is turned by where its servo reads zero [rad]: its horn is set by hand."""
TORQUE_FROM_CURRENT = 0.1
"""Relative error of a motor's torque that was estimated from its current: makers' torque constants
are off by about as much, and the currents of small servos are coarse."""

# ---- what is printed

ERRORS_AS_THEY_ARE = 0.7
"""Errors of arms as they are over those that are printed, which have to hold one by one: between
the root mean squares of the last link's mass and of friction in simulated logs."""
