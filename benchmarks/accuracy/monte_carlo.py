"""Efficiency and coverage on the Kinova pair: 200 draws of noise on each of several trajectories.

Run from the checkout:  python -m benchmarks.accuracy.monte_carlo

The other links are known; encoder step 1e-4 rad. "error / bound" is the root mean square error over
the standard deviation of the Cramer-Rao bound of the whole log, for all 38 parameters. With 200
draws a ratio of exactly 1 is seen as 1 +- 0.05, and the largest of 38 as up to about 1.1. The
designed trajectory sees so much that the encoder, not torque noise, limits it: the last column is
the error without any torque noise over the bound at that noise.
"""

from __future__ import annotations

import numpy as np

from benchmarks.accuracy.example_study import Noise, NoiseStudy, designed_plan

DRAWS = 200
MIXED = (0.5, 0.5, 0.3, 0.3, 0.1, 0.1, 0.1)
LEVELS = {"0.1": 0.1, "0.3": 0.3, "0.5": 0.5, "0.1 to 0.5": MIXED}
MEMORIES = (0.0, 0.02, 0.1)


def main() -> None:
    """Print both tables for random trajectories and for a designed one."""
    studies = {f"random {seed}": NoiseStudy(seed=seed) for seed in (1, 2, 3)}
    robot = next(iter(studies.values())).robot
    studies["designed"] = NoiseStudy(designed_plan(robot))
    for name, study in studies.items():
        print(f"{name}, cut-off {study.cutoff:.3g} Hz")
        for title, level in LEVELS.items():
            for memory in MEMORIES if title == "0.1 to 0.5" else (0.0,):
                print(line(study, title, Noise(level, memory)), flush=True)


def line(study, title, noise) -> str:
    """Return one line of the table."""
    outcome = study.run(noise, DRAWS)
    bound = study.bound(noise)
    plain = np.mean(outcome.plain_covered)
    result = np.mean(outcome.covered)
    text = f"  {title:>10} N m, memory {1e3 * noise.memory:3.0f} ms: "
    if noise.memory == 0.0:
        ratio = outcome.over_bound(bound)
        noise_free_errors = study.errors(study.identify(study.recording)[0])
        worst = outcome.names[int(np.argmax(ratio))]
        text += f"error / bound median {np.median(ratio):.3f}, worst {ratio.max():.3f} ({worst}); "
        text += f"encoder {np.max(np.abs(noise_free_errors) / bound):.2f}; "
    return (
        f"{text}intervals hold the truth: plain {100 * plain:.1f} %, result {100 * result:.1f} %; "
        f"moved {100 * outcome.constrained:.0f} %, impossible {outcome.impossible}"
    )


if __name__ == "__main__":
    main()
