"""What the data decides: shared motors that it clearly shows, and how wrong models' links are."""

from dataclasses import astuple, replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms import small_arms
from rigs.arms.core_fits import (
    BASIC,
    NO_PRIORS,
    NOISE_ONLY,
    filter_logs,
    fit_recordings,
)
from rigs.arms.small_arms import SEEDS, rigid_bodies
from rigs.arms.stepped_arm import stepped_log
from rigs.arms.wrong_arms import NOISE, draw_arm, noise_samples
from rigs.files.notes import NoteRecorder
from rigs.files.releases import since
from rigs.logs.measured_logs import XML, log_of, plan_of
from rigs.logs.payload_logs import (
    TrueArm,
    add_noise,
    add_torque,
    four_joint_arm,
    perturb_body,
    wide_motion,
)
from robot_sysid import spatial
from robot_sysid.estimate.choose import (
    SUMS_AT_ONCE,
    answer_of,
    dry_friction,
    link_evidence,
    memory_of,
    motors_of,
    solve_question,
)
from robot_sysid.estimate.links import (
    AS_STATED,
    CENTRE,
    MASS,
    LinkEvidence,
    LinkScales,
    OddNumber,
    average_scales,
    common_scale,
    deviations,
    link_directions,
    link_factor,
    odd_mass,
)
from robot_sysid.estimate.options import EstimationOptions, Priors
from robot_sysid.estimate.questions import Question, arm_question
from robot_sysid.estimate.restricted_fit import fit_file
from robot_sysid.estimate.terms import LINKS, PAYLOAD_NAMES, ArmTerms
from robot_sysid.model.bodies import write_body
from robot_sysid.records.parameters import ZERO
from robot_sysid.signals.process import TURN_TRAVELS, low_pass_recordings

ROBOT = four_joint_arm()


# ---- motors that turn several joints


def record(seed, torque=lambda motion: 0.0, model_error=0.1):
    """Return a noisy recording of an arm with an additional torque of the motion."""
    recording = TrueArm(ROBOT, seed, model_error).recording(wide_motion(seed), False)
    return add_noise(add_torque(recording, torque(recording.motion)), 0.1, seed)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_shared_motor_is_found_with_its_friction(sign):
    ratios = np.array([0.0, 0.0, 1.0, sign])

    def wrist(motion):
        speed = motion.qd @ ratios
        return np.outer(1.5 * np.sign(speed) + 0.4 * speed, ratios)

    fitted = fit_recordings(ROBOT, [record(1, wrist)])
    (motor,) = fitted.arm.motors
    assert motor.name == ("joint2+joint3" if sign > 0.0 else "joint2-joint3")
    for term, value in {"coulomb": 1.5, "viscous": 0.4}.items():
        name = f"{term}[{motor.name}]"
        error = fitted.errors[fitted.names.index(name)]
        assert abs(fitted.by_name[name] - value) < 3.0 * error < value


@since(3, 3)
def test_motors_of_the_model_are_estimated_and_no_candidates():
    wrist = small_arms.robot_of(small_arms.SHARED_MOTOR)
    stated, offered = motors_of(wrist, "chain")
    assert [motor.tendon for motor in stated] == [0]
    assert stated[0].name == "joint1-2*joint2"
    assert_array_equal(stated[0].model[:3], [1.5, 0.4, 0.03])
    assert len(offered) == 4 and motors_of(wrist, "terminal") == ((), ())
    spring = small_arms.TENDON_SPRING.replace('damping="3"', "")
    assert motors_of(small_arms.robot_of(spring), "chain")[0] == ()


def test_dry_friction_does_not_vanish_where_fading_terms_take_all_of_it():
    """With friction that fades slowly, Coulomb friction alone would be anything.

    No motor is found.
    """
    sizes = np.array([0.0, 1.0, 0.0, 0.0])

    def stribeck(motion):
        return sizes * np.sign(motion.qd) * np.exp(-((motion.qd / 0.3) ** 2))

    plain, faded = (
        fit_recordings(ROBOT, [record(2, torque)])
        for torque in (lambda motion: 0.0, stribeck)
    )
    before = dry_friction(plain)[1]
    assert before < dry_friction(faded)[1] < before + 1.5
    assert plain.arm.motors == faded.arm.motors == ()
    name = "armature[joint1]"
    error = faded.errors[faded.names.index(name)]
    assert error < 2.0 * plain.errors[plain.names.index(name)]


# ---- priors


def terms_of(loaded=False, known_mass=None, **options):
    """Return cause, or name of friction, to the terms of a question of the four-joint arm."""
    question = Question(
        EstimationOptions(**options), loaded, known_mass=known_mass, dry=(1.0,) * 4
    )
    terms = arm_question(ArmTerms(ROBOT, loaded=loaded), question, np.full(4, 10.0))
    return {term.names[0]: term for term in terms}


def spread(term):
    """Return the prior standard deviations of a term."""
    return np.sqrt(term.prior.variances)


def test_priors_are_of_the_stated_size():
    priors = Priors(link=8.0, scale=(1.0, 2.0, 3.0, 4.0), zero=1.5, gravity=0.5)
    terms = terms_of(priors=replace(priors, delay=4.0, friction=3.0))
    assert_allclose(spread(terms["scale[joint0]"]), [0.01, 0.02, 0.03, 0.04])
    assert_allclose(spread(terms["zero[joint0]"]), 1.5e-3)
    assert_allclose(spread(terms["tilt_1"]), np.radians(0.5))
    assert_allclose(spread(terms["delay"]), 4e-3)
    # Of dry friction of 1 N m, a tenth of the torque: the usual shapes of friction.
    assert_allclose(spread(terms["bend[joint0]"]), 0.6)
    assert_allclose(spread(terms["fading[joint0]"]), 0.45)
    assert_allclose(spread(terms["load[joint0]"]), 0.075)
    # By itself and with all other links: the root of twice the square.
    mass = ROBOT.links[0].theta[0]
    expected = np.sqrt(2.0) * 0.08 * mass
    assert spread(terms["m(link0)"])[0] == pytest.approx(expected, rel=1e-6)
    assert terms["coulomb[joint0]"].prior is None and terms["m"].prior is None
    # What is known exactly is no question.
    known = terms_of(priors=NO_PRIORS, friction_model="coulomb")
    assert [*known] == ["m", "coulomb[joint0]"]


def test_scales_of_a_payload_have_nothing_in_common_unless_its_mass_is_known():
    for mass, common in ((None, 0.0), (2.0, 0.2)):
        term = terms_of(loaded=True, known_mass=mass)["scale[joint0]"]
        mean = np.full(4, 0.25) @ term.prior.factor
        assert np.linalg.norm(mean) == pytest.approx(common, abs=1e-4)


@given(rigid_bodies(), rigid_bodies())
def test_links_share_an_error_in_mass(first, second):
    links = []
    for link, theta in zip(ROBOT.links, (first, second)):
        links.append(replace(link, theta=theta, reference=theta))
    arm = replace(ROBOT, links=(*links, *ROBOT.links[2:]))
    factor = link_factor(arm, (0, 1), 0.05, AS_STATED)
    covariance = factor @ factor.T
    shared = 0.05**2 * first[0] * second[0]
    assert covariance[0, 10] == pytest.approx(shared, rel=1e-6)
    # Each has an error of its own that is at least as large.
    for number, theta in ((0, first), (10, second)):
        assert covariance[number, number] > 1.999 * (0.05 * theta[0]) ** 2
    for start in (0, 10):
        block = covariance[start : start + 10, start : start + 10]
        sizes = np.sqrt(np.diag(block))
        assert np.linalg.eigvalsh(block / np.outer(sizes, sizes))[0] > 0.0


# ---- rows at turns


def test_rotors_of_joints_that_stand_at_their_turns_are_right():
    """MuJoCo's own dry friction holds them there; used, these rows read as 4 to 9 % more rotor."""
    armature = np.geomspace(0.5, 0.02, 7)
    damping = np.geomspace(3.0, 0.5, 7)
    option = 'timestep=".002" integrator="implicitfast"'
    xml = small_arms.serial_arm(small_arms.SEVEN_AXES, option=option, joint="")
    model = small_arms.compile_xml(xml)
    model.dof_armature[:] = armature
    model.dof_damping[:] = damping
    model.dof_frictionloss[:] = np.geomspace(4.0, 0.5, 7)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    robot = small_arms.robot_of(xml)
    log = stepped_log(model, robot, 1, 15.0)
    options = EstimationOptions(friction_model=BASIC, **NOISE_ONLY)
    recordings = filter_logs(robot, log, cutoff=None)
    values = fit_recordings(robot, recordings, options).by_name
    names = robot.joint_names
    # The last joint's rotor is a tenth of the link's inertia.
    rotors = np.array([values[f"armature[{name}]"] for name in names[:5]])
    viscous = np.array([values[f"viscous[{name}]"] for name in names])
    assert np.max(np.abs(rotors / armature[:5] - 1.0)) < 0.03
    assert np.max(np.abs(viscous / damping - 1.0)) < 0.03


def test_rows_at_turns_are_used_where_a_joint_does_not_stand(plant):
    """The dry friction of a plant that is no MuJoCo simulation turns with the speed."""
    log = log_of(plant, plan_of(plant, 3, 20.0), noise_torque=0.01)
    recordings = filter_logs(plant, log, cutoff=11.7)
    assert np.any(recordings[0].at_turns(TURN_TRAVELS[0]))
    is_used = fit_recordings(plant, recordings).recordings[0].is_used
    assert_array_equal(is_used, recordings[0].is_used)


@pytest.mark.slow
def test_rotors_are_within_their_errors_where_friction_takes_a_travel_to_turn_round():
    """Over 1 mrad. If only rows are left out at which a joint may stand, they are 1.8 errors off.

    Nor is a motor found that turns two joints, nor slow turns taken for something that touched it.
    """
    ratios = []
    for seed in range(2):
        drawn = draw_arm(
            ROBOT, "presliding", False, 150.0, seed == 0, seed, friction=0.2
        )
        fitted = fit_recordings(ROBOT, filter_logs(ROBOT, drawn.log))
        assert not fitted.arm.motors and not fitted.recordings[0].touched
        names = [f"armature[{joint}]" for joint in ROBOT.joint_names]
        errors = np.array([fitted.error_of(name) for name in names])
        assert np.all(errors < 0.15 * drawn.arm.rotor)
        values = np.array([fitted.by_name[name] for name in names])
        ratios.append((values - drawn.arm.rotor) / errors)
    assert np.sqrt(np.mean(np.square(ratios))) < 1.3


@pytest.mark.slow
def test_turns_of_weighings_are_judged_alike_where_friction_drifts():
    """By the fit that has the drift, and over all logs of a joint.

    A fit without it hides in the first and the last log what MuJoCo's dry friction leaves at turns.
    """
    xml = small_arms.serial_arm(small_arms.SEVEN_AXES, joint="")
    robot = small_arms.robot_of(xml)
    payload = spatial.theta_from_com(
        2.0, np.array([0.03, -0.02, 0.08]), 0.01 * np.eye(3)
    )
    logs = []
    for number, is_loaded in enumerate((False, True, True, False)):
        option = 'timestep=".002" integrator="implicitfast"'
        xml = small_arms.serial_arm(small_arms.SEVEN_AXES, option=option, joint="")
        model = small_arms.compile_xml(xml)
        model.dof_armature[:] = np.geomspace(0.5, 0.03, 7)
        model.dof_damping[:] = np.geomspace(3.0, 0.3, 7)
        model.dof_frictionloss[:] = 0.97**number * np.geomspace(6.0, 0.6, 7)
        if is_loaded:
            write_body(model, robot.links[-1].body_id, robot.links[-1].theta + payload)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        log = stepped_log(model, robot, 0, 15.0)
        name = f"log{number}"
        order = (2.0 * number - 3.0) / 3.0
        logs.append(replace(log, name=name, is_loaded=is_loaded, order=order))
    recordings, _ = low_pass_recordings(robot, logs)
    question = Question(EstimationOptions(), loaded=True, drifts=True)
    fitted = solve_question(robot, recordings, question)
    used = [np.mean(recording.is_used, axis=0) for recording in fitted.recordings]
    assert np.min(used) < 0.9 and np.max(np.ptp(used, axis=0)) < 0.03
    at = fitted.at(PAYLOAD_NAMES)
    ratios = (fitted.values[at] - payload) / fitted.errors[at]
    assert np.max(np.abs(ratios)) < 2.0
    assert not fitted.arm.motors


# ---- scales of the links' prior

N_LINKS = 4
STATED = np.ones((N_LINKS, 3), dtype=bool)
USUAL = LinkScales(4.0, 2.0, 2.0)


def deviations_of(stated, share, scales):
    """Return the standard deviations along the directions of links, of one set of factors."""
    (sizes,) = deviations(stated, share, np.array([astuple(scales)]))
    return sizes


def evidence_of(seed, scales, noise=0.01):
    """Return (evidence, rows, data) of all directions of links whose errors have these scales."""
    rng = np.random.default_rng(seed)
    scale = deviations_of(STATED, 1.0, scales)
    rows = rng.standard_normal((3 * len(scale), len(scale)))
    data = rows @ (scale * rng.standard_normal(len(scale)))
    data += noise * rng.standard_normal(len(data))
    gram = rows.T @ rows / noise**2
    return LinkEvidence(STATED, 1.0, gram, rows.T @ data / noise**2), rows, data


@given(SEEDS)
def test_the_likelihood_of_link_scales_is_that_of_the_data(seed):
    """Differences are those of a Gaussian of covariance noise^2 + Y S S Y'."""
    noise = 0.3
    evidence, rows, data = evidence_of(seed, USUAL, noise)
    likelihoods = []
    expected = []
    for scales in (USUAL, LinkScales(4.0, 3.0, 2.0)):
        scale = deviations_of(STATED, 1.0, scales)
        likelihoods.append(evidence.log_likelihood(scales))
        covariance = noise**2 * np.eye(len(rows)) + (rows * scale**2) @ rows.T
        log_determinant = np.linalg.slogdet(covariance)[1]
        exponent = data @ np.linalg.solve(covariance, data)
        expected.append(-0.5 * (exponent + log_determinant))
    difference = np.diff(likelihoods)[0] - np.diff(expected)[0]
    assert abs(difference) < 1e-6 * abs(expected[0])


@pytest.mark.parametrize(
    "scales", [LinkScales(2.0, 2.0, 4.0), LinkScales(8.0, 6.0, 1.0)]
)
def test_link_scales_that_the_data_shows_are_found(scales):
    average = average_scales(evidence_of(0, scales)[0])
    for aspect in ("centre_of_mass", "inertia"):
        assert 0.5 < getattr(average, aspect) / getattr(scales, aspect) < 2.1, aspect
    nothing = LinkEvidence(STATED, 1.0, np.zeros((42, 42)), np.zeros(42))
    usual = average_scales(nothing)
    assert 4.0 < usual.mass < 6.0 and 2.0 < usual.centre_of_mass < 4.0


def off_by(size, seed=0):
    """Return the evidence of links as usual, the mass of the third one off by a size."""
    evidence, _, _ = evidence_of(seed, USUAL)
    off = np.zeros(42)
    off[20] = size
    share = 0.05
    # As shares of the masses, and so on: the deviations of ``evidence_of`` are of a share of one.
    gradient = share * evidence.gradient + evidence.curvature @ off
    return replace(evidence, share=share, gradient=gradient)


def all_off_by(size, seed=0):
    """Return the evidence of links as usual, all masses off by a size."""
    evidence = off_by(0.0, seed)
    common = np.zeros(42)
    common[40] = size
    gradient = evidence.gradient + evidence.curvature @ common
    return replace(evidence, gradient=gradient)


@pytest.mark.parametrize("seed", range(5))
def test_one_mass_that_is_far_more_off_than_others_is_found(seed):
    assert odd_mass(off_by(0.0, seed)) is None
    assert odd_mass(off_by(3.0, seed)) == 2
    assert odd_mass(off_by(-3.0, seed)) == 2


def test_an_error_that_all_masses_share_is_none_of_one_link():
    assert odd_mass(all_off_by(0.5)) is None


@pytest.mark.parametrize("seed", range(5))
def test_one_mass_is_found_by_links_as_usual_where_all_seem_far_off(seed):
    """Scales that all links share may hold it: its error is as large as itself, and no larger."""
    evidence = off_by(-0.9, seed)
    assert average_scales(evidence).mass > average_scales(off_by(0.0, seed)).mass
    assert odd_mass(evidence) == 2


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("size", [-0.4, 0.5])
def test_all_torques_are_as_unsure_as_an_error_that_all_masses_share(seed, size):
    assert common_scale(off_by(0.0, seed)) == 0.0
    assert common_scale(all_off_by(size, seed)) > 0.15


def test_what_is_stated_of_all_masses_is_no_error_of_torques():
    evidence = all_off_by(-0.4)
    assert common_scale(evidence.with_common(0.4)) == 0.0


def test_the_mass_of_an_odd_link_has_an_error_as_large_as_itself():
    arm = small_arms.robot_of(XML)
    for odd in (None, OddNumber(1, MASS)):
        factor = link_factor(arm, (0, 1), 0.05, AS_STATED, odd)
        errors = np.sqrt(np.sum(factor**2, axis=1))[[0, 10]]
        masses = np.array([arm.links[link].theta[0] for link in (0, 1)])
        own = np.array([0.05, 0.05 if odd is None else 1.0])
        assert_allclose(errors / masses, np.hypot(own, 0.05))


def test_an_odd_centre_of_mass_counts_as_not_known_with_the_inertia_about_its_joint():
    arm = small_arms.robot_of(XML)
    usual, odd = (
        np.sqrt(np.sum(link_factor(arm, (0, 1), 0.05, AS_STATED, each) ** 2, axis=1))
        for each in (None, OddNumber(1, CENTRE))
    )
    link = arm.links[1]
    mass = link.theta[0]
    assert_allclose(odd[:11], usual[:11])
    assert np.all(odd[11:14] > mass * link.size)
    assert np.all(odd[14:] > mass * link.size**2)


def test_the_zero_of_a_joint_that_is_far_off_gets_a_prior_of_its_own(robot, noisy):
    """A right log has no such zero."""
    wrong = replace(noisy, q=noisy.q + [0.0, 0.2, 0.0])
    for log, odd in ((noisy, ()), (wrong, (ZERO.key_of(robot.joint_names[1]),))):
        answer = answer_of(fit_recordings(robot, filter_logs(robot, log)))
        assert answer.question.odd_zeros == odd
        for name in odd:
            assert abs(answer.by_name[name] - 0.2) < 3.0 * answer.error_of(name)


def test_the_evidence_of_a_fit_is_that_without_the_links_prior(noisy_fit):
    """The best deviation by evidence and prior together is the estimate."""
    evidence = link_evidence(noisy_fit)
    terms = noisy_fit.equations.spans
    ((term, span),) = [pair for pair in terms if pair[0].cause == LINKS]
    arm = noisy_fit.arm
    directions = link_directions(arm.robot, arm.others)
    scales = noisy_fit.question.link_scales
    scale = deviations_of(evidence.stated, evidence.share, scales)
    inner = np.eye(len(scale)) + scale[:, None] * evidence.curvature * scale
    found = directions @ (scale * np.linalg.solve(inner, scale * evidence.gradient))
    moved = noisy_fit.free[span] - term.prior.mean
    assert_allclose(found, moved, atol=1e-3 * np.max(np.abs(moved)))


def test_the_prior_of_links_widens_where_the_models_are_wrong(plant):
    model = small_arms.compile_xml(XML)
    rng = np.random.default_rng(7)
    for link in plant.links:
        small_arms.write_body(model, link.body_id, perturb_body(link.theta, 0.5, rng))
    log = log_of(plant, plan_of(plant, 1, 30.0), noise_torque=0.02)
    wide, narrow = (
        fit_recordings(robot, filter_logs(robot, log)).question.link_scales
        for robot in (small_arms.robot_of(model), plant)
    )
    assert wide.mass > narrow.mass
    assert wide.centre_of_mass > narrow.centre_of_mass
    assert wide.inertia > 1.5 * narrow.inertia


def test_progress_grows_to_its_end_whatever_is_asked(recordings):
    progress = NoteRecorder()
    question = Question(EstimationOptions(), loaded=True, drifts=True)
    solve_question(ROBOT, recordings[:2], question, progress)
    assert progress.shares[0] == 0.0 and progress.shares[-1] == 1.0
    assert np.all(np.diff(progress.shares) > 0.0)


# ---- the order of logs

# Most that two orders may differ by, as a share of each number's ±: rounding times the condition of
# what the data hardly shows, and the tolerance of the search for possible bodies.
_ROUNDING = 1e-3
# Length of logs so short that the memory of their noise reaches over a tenth of them [s].
_SHORT = 6.0


@pytest.mark.slow
@settings(max_examples=3)
@given(SEEDS)
def test_the_order_of_logs_changes_neither_estimate_nor_file(seed):
    first, other = (
        draw_arm(ROBOT, "real", False, _SHORT, False, seed + k) for k in (0, 1)
    )
    noise = (
        NOISE * first.arm.coulomb * noise_samples(other.rng, other.rigid.shape, False)
    )
    recordings = filter_logs(ROBOT, first.log, first.arm.log(other.motion, noise))
    fits = []
    for ordered in (recordings, recordings[::-1]):
        estimate = fit_recordings(ROBOT, ordered)
        fits.append((estimate, fit_file(estimate)))
    errors = dict(zip(fits[0][0].names, fits[0][0].errors))
    for fitted, turned in zip(*fits):
        assert fitted.names == turned.names
        assert_allclose(fitted.correlation, turned.correlation, rtol=1e-9)
        assert_allclose(fitted.errors, turned.errors, rtol=_ROUNDING)
        for name in fitted.names:
            off = abs(fitted.by_name[name] - turned.by_name[name])
            assert off < _ROUNDING * errors[name], name


def test_the_memory_of_a_question_is_that_of_its_sums(noisy_fit):
    """It is known from a few rows, before the sums are made."""
    needed = memory_of(noisy_fit.arm, noisy_fit.recordings[0])
    sums = sum(products.nbytes for products in noisy_fit.sums.products)
    assert 0.9 * needed < SUMS_AT_ONCE * sums < 1.1 * needed
