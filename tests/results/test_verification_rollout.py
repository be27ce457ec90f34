"""The better model is found, what cannot be played is said; a file is judged by its own torques."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from robot_sysid.errors import ExportError, InputError
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement, Motion
from robot_sysid.results.verification import (
    LAST_FIFTH,
    compare,
    fitted_rows,
    play,
    rollout_refusal,
    split_time,
    torque_error,
)
from robot_sysid.signals.process import process
from robot_sysid.simulator import ArmTorque
from tests.simulation import test_playback
from tests.simulation.test_playback import JOINT, SECONDS, arm, recording
from tests.support import arms
from tests.support.arms import X, Y, Z, serial_arm
from tests.support.model_files import write_files
from tests.support.releases import since

TRUTH = serial_arm((Z, Y, X), joint=JOINT.format(0.2))


def test_the_model_that_is_the_arm_wins_whichever_comes_first():
    truth = arm()
    wrong = arm(0.5)
    pieces = [recording(truth)]
    good, bad = (
        compare(*pair, pieces, "a piece") for pair in ((wrong, truth), (truth, wrong))
    )
    assert good.is_better and rollout_refusal(good, ()) is None
    assert not bad.is_better and "not better" in rollout_refusal(bad, ())
    assert good.score == pytest.approx(1.0 / bad.score)
    # The piece is too short for the longest horizon.
    assert SECONDS < 3.0 and good.notes == ("no held-out piece is as long as 3 s",)
    assert {error.horizon for error in good.errors} == {0.1, 0.3, 1.0}


@pytest.fixture(scope="module")
def signals():
    """What the true arm does for a while, processed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(test_playback, "SECONDS", 8.0)
        piece = recording(arm())
    return process(
        Measurement(piece.time, piece.q, None, piece.tau), arm().joint_names, 20.0
    )


def writes(xml):
    return lambda target: target.files.write(target.path, xml)


def test_what_is_played_was_not_fitted_for_it(signals):
    """The written file is played, on the end of the log."""
    test = play(arm(0.5), [signals], writes(TRUTH), None, split_time, LAST_FIFTH)
    assert test.is_better and {error.horizon for error in test.errors} == {
        0.1,
        0.3,
        1.0,
    }
    rows = fitted_rows(signals)
    time = signals.decimated_time()
    reach = signals.low_pass.half_width / signals.rate
    assert 0.7 < np.mean(rows) < 0.8
    assert np.max(time[rows]) + reach < split_time(signals) - reach


def test_another_log_is_played_whole(signals):
    test = play(arm(0.5), [signals], writes(TRUTH), None)
    assert test.is_better and test.held_out == "the validation log"
    assert 3.0 in {error.horizon for error in test.errors}


@pytest.mark.parametrize("error", [InputError, ExportError])
def test_nothing_played_is_no_proof(signals, error):
    def fails(_):
        raise error("it cannot hold this")

    test = play(arm(), [signals], fails, None)
    assert test.score is None and not test.is_better
    assert "it cannot hold this" in rollout_refusal(test, ())
    assert rollout_refusal(test, ("rollout",)) is None
    assert rollout_refusal(None, ()) is None


OFFSETS = np.array([3.0, -2.0, 0.5])


def a_motion(joints=3, samples=40):
    return Motion(
        np.arange(samples),
        *arms.random_motion(np.random.default_rng(0), joints, samples),
    )


def error_on(model, robot, motion, tau, usable, source="a log"):
    """The error on samples as they are: nothing is filtered or decimated."""
    signals = SimpleNamespace(
        tau=tau,
        qd=motion.qd,
        low_pass=SimpleNamespace(decimate=np.asarray),
        filter_columns=lambda made, smooth: made(motion),
        usable=lambda: usable,
    )
    return torque_error(model, robot, signals, source)


def by_inverse_dynamics(xml, motion):
    """Torque of smooth damping and links by MuJoCo itself, and Coulomb's friction."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    tau = np.empty_like(motion.q)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    for k in range(len(tau)):
        data.qpos[:] = motion.q[k]
        data.qvel[:] = motion.qd[k]
        data.qacc[:] = motion.qdd[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    tau += model.dof_frictionloss * np.sign(motion.qd)
    for tendon, friction in enumerate(model.tendon_frictionloss):
        ratios = np.zeros(model.nv)
        first = model.tendon_adr[tendon]
        count = model.tendon_num[tendon]
        for wrap in range(first, first + count):
            ratios[model.jnt_dofadr[model.wrap_objid[wrap]]] = model.wrap_prm[wrap]
        tau += friction * np.sign(motion.qd @ ratios)[:, None] * ratios
    return tau


@pytest.mark.parametrize(
    "xml",
    [
        arms.ARMATURE,
        arms.TENDON_SPRING,
        pytest.param(arms.SHARED_MOTOR, marks=since(3, 3)),
        pytest.param(arms.NONLINEAR_DAMPING, marks=since(3, 7)),
    ],
)
def test_a_perfect_file_is_off_by_its_sensors_offsets_alone(tmp_path, xml):
    path = write_files(tmp_path, {"arm.xml": xml})
    motion = a_motion()
    robot = load_robot_model(path)
    tau = by_inverse_dynamics(xml, motion) + OFFSETS
    found = error_on(path, robot, motion, tau, np.ones(tau.shape, bool))
    assert found.relative_error < 1e-12 and found.rmse < 1e-11 and found.n_samples == 40
    assert max(found.relative_error_per_joint.values()) < 1e-10


@pytest.mark.parametrize(
    "attribute",
    ['damping="2.1"', 'frictionloss="1.6"', 'armature=".01"', 'stiffness="1"'],
)
def test_each_number_of_a_joint_counts(attribute):
    motion = a_motion()
    robot = arms.robot_of(arms.DRY_FRICTION)
    tau = ArmTorque(robot)(motion)
    name = attribute.split("=")[0]
    text = arms.DRY_FRICTION
    old = {"damping": 'damping="2"', "frictionloss": 'frictionloss="1.5"'}.get(name)
    text = (
        text.replace(old, attribute)
        if old
        else text.replace("<joint ", f"<joint {attribute} ")
    )
    found = error_on(
        arms.compile_xml(text), robot, motion, tau, np.ones(tau.shape, bool)
    )
    added = {
        "damping": 0.1 * motion.qd,
        "frictionloss": 0.1 * np.sign(motion.qd),
        "armature": 0.01 * motion.qdd,
        "stiffness": motion.q,
    }[name]
    errors = added - added.mean(axis=0)
    np.testing.assert_allclose(found.rmse, np.sqrt(np.mean(errors**2)), rtol=1e-9)
    sizes = np.linalg.norm(tau, axis=0)
    np.testing.assert_allclose(
        found.relative_error, np.linalg.norm(errors) / np.linalg.norm(sizes)
    )
    for k, joint in enumerate(robot.joint_names):
        error = np.linalg.norm(errors[:, k])
        assert found.relative_error_per_joint[joint] == pytest.approx(error / sizes[k])
        assert found.rmse_per_joint[joint] == pytest.approx(
            error / np.sqrt(len(errors))
        )


def test_what_is_not_usable_does_not_count():
    motion = a_motion()
    robot = arms.robot_of(arms.THREE)
    usable = np.random.default_rng(1).uniform(size=motion.q.shape) < 0.7
    usable[:, 0] = False
    tau = np.where(usable, ArmTorque(robot)(motion) + OFFSETS, np.nan)
    found = error_on(robot.mj_model, robot, motion, tau, usable, "a log")
    assert found.source == "a log" and found.relative_error < 1e-12
    assert found.relative_error_per_joint["joint0"] is None
    assert found.n_samples == np.max(np.count_nonzero(usable, axis=0))
    nothing = error_on(robot.mj_model, robot, motion, tau, np.zeros_like(usable))
    assert (nothing.relative_error, nothing.rmse, nothing.n_samples) == (None, 0.0, 0)
