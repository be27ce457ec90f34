"""Check the errors that the tool states: many draws of torque noise on the example's arm.

Three questions, each with a limit: How much larger are the errors than the least ones any unbiased
estimate could have (the Cramer-Rao bound of the whole log)? How often does a 95 % interval hold the
truth, also when the noise is correlated in time? Is every result a possible body? Exit code 0 when
all limits hold.

Standard errors are those of the plain estimate. Where that is no possible body, the result is the
best possible one instead; its errors are smaller, so intervals hold the truth a little more often.
Both shares are printed.
"""

from __future__ import annotations

import sys

import numpy as np
from noise_study import Noise, NoiseStudy

DRAWS = 200
MIXED = (0.5, 0.5, 0.3, 0.3, 0.1, 0.1, 0.1)
CASES = {
    "white, 0.1 N m": Noise(0.1),
    "white, 0.5 N m": Noise(0.5),
    "white, 0.1 to 0.5 N m": Noise(MIXED),
    "20 ms, 0.1 to 0.5 N m": Noise(MIXED, 0.02),
    "100 ms, 0.1 to 0.5 N m": Noise(MIXED, 0.1),
}
# White noise alone would be worth a higher cut-off: at 10.3 Hz instead of 6.2 these are 1.04 and
# 1.18. Torques of real arms hold more that is not motion the higher the frequency, and the cut-off
# that commands choose is the one that predicts other logs of real arms best.
MEDIAN_OVER_BOUND = 1.07
WORST_OVER_BOUND = 1.4
COVERAGE = (0.92, 0.97)


def main(draws: int = DRAWS, study: NoiseStudy | None = None) -> int:
    """Run all cases, print a table and return the exit code."""
    study = study or NoiseStudy()
    print(
        f"{draws} draws each, encoder step 1e-4 rad, 15 s at 1 kHz, cut-off {study.cutoff:.3g} Hz"
    )
    first = ("noise", "error / bound", "95 % intervals", "moved to a")
    print("{:<24}{:>16}{:>18}{:>15}".format(*first))
    second = ("", "median", "worst", "plain", "result", "possible body", "impossible")
    print("{:<24}{:>8}{:>8}{:>9}{:>9}{:>15}{:>12}".format(*second))
    passed = [report(name, noise, study, draws) for name, noise in CASES.items()]
    print("all limits hold" if all(passed) else "NOT ALL LIMITS HOLD")
    return 0 if all(passed) else 1


def report(name: str, noise: Noise, study: NoiseStudy, draws: int) -> bool:
    """Run one case and print its line; return whether its limits hold."""
    outcome = study.run(noise, draws)
    median = ""
    worst = ""
    efficient = True
    if noise.memory == 0.0:
        ratio = outcome.over_bound(study.bound(noise))
        median = f"{np.median(ratio):.3f}"
        worst = f"{np.max(ratio):.3f}"
        efficient = (
            np.median(ratio) <= MEDIAN_OVER_BOUND and np.max(ratio) <= WORST_OVER_BOUND
        )
    plain, result = (
        float(np.mean(c)) for c in (outcome.plain_covered, outcome.covered)
    )
    print(
        f"{name:<24}{median:>8}{worst:>8}{100.0 * plain:>7.1f} %{100.0 * result:>7.1f} %"
        f"{100.0 * outcome.constrained:>13.0f} %{outcome.impossible:>12}"
    )
    honest = COVERAGE[0] <= plain <= COVERAGE[1] and result >= COVERAGE[0]
    return bool(efficient and honest and outcome.impossible == 0)


if __name__ == "__main__":
    sys.exit(main())
