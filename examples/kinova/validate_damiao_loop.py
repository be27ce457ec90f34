"""The whole loop on Damiao motors, without hardware: export, play, record, identify, compare.

The arm on the other side is the truth of this example, moved by seven simulated motors that pack
their measurements into 12 and 16 bits as real ones do, on a simulated CAN bus. The engineer's model
knows the other links but guesses the terminal one. Exit code 0 when the recording gives the true
mass within 1 % and the centre of mass within 2 mm, and when a motor with another torque scale is
refused before anything moves.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from robot_sysid import cli
from robot_sysid.damiao.bus.clock import SimulatedClock
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.play.player import StopRequest
from robot_sysid.damiao.play.run import Plan, RecordingChoice, look, make_plan, perform
from robot_sysid.damiao.play.settings import PlaySettings, default_gains
from robot_sysid.damiao.simulated.arm import SimulatedArm
from robot_sysid.damiao.simulated.faults import Fault
from robot_sysid.damiao.simulated.motor import simulated_motor
from robot_sysid.damiao.simulated.simulated_link import SimulatedLink
from robot_sysid.damiao.trajectory.csv_file import read_damiao_trajectory
from robot_sysid.errors import HardwareAbort
from robot_sysid.parser import load_robot_model
from robot_sysid.simulation.stepper import MujocoPlant

MODELS = Path(__file__).resolve().parent / "model"
TRUTH = MODELS / "kinova_fullinertia.xml"
GUESS = MODELS / "kinova_fullinertia_guess.xml"
MOTORS = ("DM8009",) * 4 + ("DM4340",) * 3
DURATION = 30.0
MASS_TOLERANCE, COM_TOLERANCE = 0.01, 2e-3


def main() -> int:
    """Run the loop in a temporary folder and return the exit code."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = known_links_guessed_tool(folder)
        print("1. export: robot-sysid MODEL --export-damiao --motor-type ...")
        plan = exported_plan(model, folder)
        print(f"   {plan.scan.samples} rows, {plan.scan.duration:g} s")
        print(f"2. play and record, {plan.settings.rate:g} Hz on a simulated classic CAN bus")
        play_and_record(plan, folder / "measured.csv")
        print("3. identify: robot-sysid MODEL --measurements measured.csv")
        close = compare(identified(model, folder / "measured.csv", folder))
        print("4. the same with a motor that has another TMAX than its type")
        refused = other_scale_is_refused(plan, folder / "never.csv")
    return 0 if close and refused else 1


def known_links_guessed_tool(folder: Path) -> Path:
    """Write the truth's model with the guess's terminal link, and return its path."""
    tree = ElementTree.parse(TRUTH)
    guessed = ElementTree.parse(GUESS).find(".//body[@name='link6']/inertial")
    inertial = tree.find(".//body[@name='link6']/inertial")
    compiler = tree.find("compiler")
    if inertial is None or guessed is None or compiler is None:
        raise SystemExit("the example's models have no link6 with an inertial")
    inertial.attrib.clear()
    inertial.attrib.update(guessed.attrib)
    compiler.set("meshdir", str(MODELS / compiler.get("meshdir", "")))
    path = folder / "known_links_guessed_tool.xml"
    tree.write(path)
    return path


def robot_sysid(*arguments: object) -> None:
    """Run the command robot-sysid, silently as long as it succeeds."""
    words = io.StringIO()
    with contextlib.redirect_stdout(words), contextlib.redirect_stderr(words):
        code = cli.main([str(argument) for argument in arguments])
    if code != 0:
        print(words.getvalue())
        raise SystemExit(f"robot-sysid ended with exit code {code}")


def exported_plan(model: Path, folder: Path) -> Plan:
    """Export the excitation trajectory and return the plan to play it."""
    types = [word for motor in MOTORS for word in ("--motor-type", motor)]
    options = ("--duration", DURATION, "--seed", 0, "--output-dir", folder / "export")
    robot_sysid(model, *options, "--export-damiao", *types)
    trajectory = read_damiao_trajectory(folder / "export" / "damiao_trajectory.csv")
    kp, kd = default_gains([joint.spec for joint in trajectory.joints])
    return make_plan(trajectory, PlaySettings(kp, kd))


def play_and_record(plan: Plan, record: Path, faults: tuple[Fault, ...] = ()) -> None:
    """Play on a simulated arm, in simulated time."""
    clock = SimulatedClock()
    joints = plan.trajectory.joints
    motors = [simulated_motor(j.spec, j.can_id, j.master_id) for j in joints]
    plant = MujocoPlant(load_robot_model(TRUTH), plan.scan.first)
    bus = SimulatedLink(clock, SimulatedArm(plant, motors, faults), echo=True)
    link = GuardedLink(bus, clock.now)
    inspection, _ = look(link, clock, plan)
    report = perform(link, clock, plan, inspection, StopRequest(), RecordingChoice(record))
    assert not any(motor.driving for motor in motors)
    worst = float(np.max(report.worst_tracking))
    print(f"   {report.cycles} cycles recorded, at most {worst:.3f} rad off the path")


def identified(model: Path, log: Path, folder: Path) -> dict[str, object]:
    """Identify the model's terminal link from a log and return params.json."""
    output = folder / "identified"
    robot_sysid(model, "--measurements", log, "--output-dir", output)
    return dict(json.loads((output / "params.json").read_text()))


def compare(found: dict[str, object]) -> bool:
    """Print found and true values and tell whether they are close enough."""
    truth = load_robot_model(TRUTH).prior
    guess = load_robot_model(GUESS).prior
    mass = float(str(found["mass"]))
    com = np.array(found["center_of_mass_moment"], dtype=float) / mass
    mass_error = mass / truth.mass - 1.0
    com_error = float(np.linalg.norm(com - truth.com))
    print(f"   mass [kg]: guess {guess.mass:.4f}, found {mass:.4f}, truth {truth.mass:.4f}")
    print(f"   centre of mass [mm]: found {1e3 * com}, truth {1e3 * truth.com}")
    print(f"   off by {100 * mass_error:+.3f} % and {1e3 * com_error:.3f} mm")
    return abs(mass_error) < MASS_TOLERANCE and com_error < COM_TOLERANCE


def other_scale_is_refused(plan: Plan, record: Path) -> bool:
    """Tell whether a motor with half its type's TMAX is refused before anything moves."""
    try:
        play_and_record(plan, record, (Fault("tmax", 1, 27.0),))
    except HardwareAbort as refusal:
        print(f"   refused: {refusal}")
        return not record.exists()
    print("   played in spite of it")
    return False


if __name__ == "__main__":
    np.set_printoptions(precision=3, suppress=True)
    sys.exit(main())
