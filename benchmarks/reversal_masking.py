"""Errors of friction with and without the rows near reversals of a joint.

Run from the checkout:  python -m benchmarks.reversal_masking

Closed loop in MuJoCo with its own dry friction (Kinova example, other links known, encoder step
1e-4 rad), and the same trajectories by inverse dynamics with Coulomb's law, where leaving rows out
only costs information. "centre" leaves out rows whose own instant is slow; the others leave out
rows with more than that share of the filter weight on slow samples. Errors are the worst joint's;
median and worst over the trajectories.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.closed_loop import ClosedLoop
from benchmarks.example_study import Noise, NoiseStudy, friction_errors, noise_study
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import Dataset
from robot_sysid.signals.process import LARGEST_SLOW_SHARE, process
from robot_sysid.signals.resampling import join_measurements
from robot_sysid.simulation.plant import round_to_multiples

SEEDS = range(61, 73)
SHARES = (0.2, 0.1, LARGEST_SLOW_SHARE, 0.035, 0.02)
DRAWS = 20


def main() -> None:
    """Print one table per simulation."""
    for simulation, friction in (
        ("closed loop", ClosedLoopStudy),
        ("inverse dynamics", NoiseStudy),
    ):
        studies = [UnmaskedStudy(friction(seed=seed)) for seed in SEEDS]
        print(
            f"{simulation}: mass %, Coulomb %, viscous %, each median and worst; rows used"
        )
        for name, rule in rules().items():
            print(
                f"  {name:<12}{table_line([study.errors_of_rule(rule) for study in studies])}",
                flush=True,
            )


def rules():
    """Return predicates of rows by name: of (slow share, speed at the centre over deadband)."""
    predicates = {"centre": lambda share, speed: speed >= 1.0}
    for share in SHARES:
        predicates[f"share {share:g}"] = lambda slow_share, speed, limit=share: (
            slow_share <= limit
        )
    return predicates


class ClosedLoopStudy(NoiseStudy):
    """The motion of an arm under a controller, with MuJoCo's own dry friction.

    Speeds at which that friction is not complete count as standing still.
    """

    def record(self):
        """Return what sensors report of the closed loop."""
        loop = ClosedLoop(self.plant, self.plan, noise_study.SAMPLE_RATE)
        log = join_measurements(loop.run())
        log = replace(
            log,
            q=round_to_multiples(log.q, noise_study.ENCODER_STEP),
            qd=None,
            qdd=None,
        )
        signals = process(log, self.robot.joint_names)
        slow = np.maximum(signals.deadband, 1.005 * loop.ramp_use.ramp_speed)
        return replace(signals, deadband=slow)


class UnmaskedStudy:
    """One trajectory with all its rows, and what is needed to mask them."""

    def __init__(self, study) -> None:
        self.study = study
        signals = study.signals
        every = replace(signals, deadband=np.zeros_like(signals.deadband))
        columns = Columns(study.robot, [Dataset("log", every)])
        (study.samples,) = columns.samples(columns.start())
        centres = signals.low_pass.centres(len(signals))
        self.share = signals.slow_share()
        self.speed = np.abs(signals.qd[centres]) / signals.deadband

    def errors_of_rule(self, rule):
        """Return errors without torque noise, with 0.1 N m, and the share of rows used."""
        used = rule(self.share, self.speed)
        study = self.study
        samples = self.study.samples
        tau = tuple(np.where(keep, t, np.nan) for keep, t in zip(used.T, samples.tau))
        study.samples = replace(samples, tau=tau)
        clean = friction_errors(study, study.identify(study.samples)[0])
        draws = [
            study.noisy(Noise(0.1), np.random.default_rng(k)) for k in range(DRAWS)
        ]
        noisy = [friction_errors(study, study.identify(draw)[0]) for draw in draws]
        study.samples = samples
        return clean, np.sqrt(np.mean(np.square(noisy), axis=0)), np.mean(used)


def table_line(results) -> str:
    """Return the line with median and worst of each error."""
    clean, noisy = (100.0 * np.array([r[k] for r in results]) for k in (0, 1))
    pairs = "  ".join(f"{np.median(e):.3f} {np.max(e):.3f}" for e in clean.T)
    loud = " ".join(f"{value:.2f}" for value in np.median(noisy, axis=0))
    used = np.mean([r[2] for r in results])
    return f"{pairs}   used {100 * used:.0f} %   with 0.1 N m noise: {loud}"


if __name__ == "__main__":
    main()
