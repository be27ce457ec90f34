"""Compare what the Quick Start printed and wrote with what the README promises.

Runs in the folder of the run, which holds printed.txt, errors.txt and sysid_output/.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import mujoco

EXPECTED_LINES = [
    r"Loading robot model from examples/kinova/model/kinova_fullinertia_guess\.xml\.\.\.",
    r"Identified terminal joint: joint6",
    r"Generating excitation trajectory \(15\.0s, 1000 Hz\)\.\.\.",
    r"Running MuJoCo simulation\.\.\.",
    r"Collecting regressor data: 100%",
    r"Solving for parameters\.\.\.",
    r"Identified parameters:",
    r"  Mass: 0\.789 kg",
    r"  CoM moment: \[-0\.000, 0\.009, 0\.120\] kg·m",
    r"  Inertia: \[0\.024, 0\.000, 0\.000, 0\.024, -0\.002, 0\.001\] kg·m²",
    r"  Coulomb friction: 0\.40 N·m",
    r"  Viscous friction: 0\.10 N·m·s/rad",
    r"  RMSE: \d+\.\d{4} N·m",
    r"  Condition number: \d+\.\d",
    r"  Base parameters: \d+",
    r"Results saved to \./sysid_output/",
]


def check_printed() -> None:
    """Check that printed.txt has every expected line, in order, and errors.txt only notes."""
    lines = iter(Path("printed.txt").read_text(encoding="utf-8").splitlines())
    for pattern in EXPECTED_LINES:
        assert any(re.fullmatch(pattern, line) for line in lines), (
            f"missing or late: {pattern}"
        )
    errors = Path("errors.txt").read_text().splitlines()
    others = [line for line in errors if not line.startswith("note: ")]
    assert others == [], "something else than a note on standard error"


def check_files() -> None:
    """Check that exactly the result files exist and the model loads with the identified mass."""
    written = sorted(path.name for path in Path("sysid_output").glob("[!.]*"))
    assert written == ["params.json", "run.toml", "updated_model.xml"], written
    inputs = {"printed.txt", "errors.txt", "examples"}
    outputs = {path.name for path in Path().iterdir()} - inputs
    assert outputs == {"sysid_output"}, outputs
    parameters = json.loads(
        Path("sysid_output/params.json").read_text(encoding="utf-8")
    )
    assert parameters["joint_name"] == "joint6"
    assert abs(parameters["mass"] - 0.789160) < 1e-9
    assert parameters["rmse"] < 1e-9
    model = mujoco.MjModel.from_xml_path("sysid_output/updated_model.xml")
    assert abs(model.body("link6").mass[0] - parameters["mass"]) < 1e-12


if __name__ == "__main__":
    check_printed()
    check_files()
