"""What ``identify --polish`` gains: open-loop positions and torques of files before and after.

Run from the checkout, five minutes on one core:

    OMP_NUM_THREADS=1 python -m benchmarks.polish

Logs of real arms lie in ../shared/data beside the checkout; simulated arms are as far from their
models as real ones (``rigs.wrong_arms``). The errors are those of held-out windows and blocks, as
the command says them.
"""

from __future__ import annotations

import time

import robot_sysid as rs
from rigs.places import DATA, MODELS
from rigs.wrong_arms import ARMS, draw_arm
from robot_sysid.parser import load_robot_model

LOGS = {
    "UR10e": ("ur10e_payload/ur10e.urdf", "ur10e_payload/empty_100Hz.csv"),
    "UR10e with a load": (
        "ur10e_payload/ur10e.urdf",
        "ur10e_payload/loaded_2p805kg_100Hz.csv",
    ),
    "TX40": ("tx40/tx40.urdf", "tx40/tx40_500Hz.csv"),
    "KUKA LWR4+, run 1": ("kuka_lwr4/kuka_lwr4.urdf", "kuka_lwr4/lwr4_hw1_200Hz.csv"),
}
SIMULATED = ("ur5e", "iiwa14", "gen3")


def report(title, model, log):
    """Print what the polish of one arm comes to."""
    start = time.process_time()
    result = rs.identify(model, log, polish=True)
    seconds = time.process_time() - start
    texts = [remark.text for remark in result.remarks]
    (sentence,) = [text for text in texts if "polished" in text] or ["refused"]
    print(f"{title} ({seconds:.1f} s): {sentence}")


def main() -> None:
    """Print a line per arm."""
    for title, (model, log) in LOGS.items():
        report(title, DATA / model, DATA / log)
    for name in SIMULATED:
        path = MODELS / ARMS[name]
        truth = draw_arm(load_robot_model(path), "real", False, 15.0, False, 0)
        report(f"simulated {name}", path, truth.log)


if __name__ == "__main__":
    main()
