"""Measured data through the whole command: files in, result block, params.json and exit code."""

from __future__ import annotations

import json
import re

import mujoco
import numpy as np
import pytest

from robot_sysid.cli import main
from robot_sysid.dynamics import spatial
from tests.support import arms
from tests.support.measured_logs import JOINT

MOTION = ("--duration", "8", "--sample-rate", "200", "--seed", "1")
SENSORS = ("--noise-torque", "0.05", "--encoder-resolution", "1e-4")
XML = arms.serial_arm((arms.Z, arms.Y, arms.X), joint=JOINT)
HEAVIER = XML.replace('mass=".8"', 'mass="1.1"')
ANGLES = re.compile(r"joint\d_position")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A guess, a plant whose terminal link is heavier, and a log of that plant."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "guess.xml").write_text(XML)
    (folder / "plant.xml").write_text(HEAVIER)
    return folder


@pytest.fixture(scope="module")
def log(folder, arm_command):
    """The plant's log and the params.json of the run that made it."""
    path = folder / "log.csv"
    result = arm_command("--plant-model", "plant.xml", *SENSORS, "--save-measurements", str(path))
    assert result.code == 0, result.err
    return path, result.params


class Result:
    """What one run of the command left behind."""

    def __init__(self, code, printed, output):
        self.code, self.out, self.err = code, printed.out, printed.err
        path = output / "params.json"
        self.params = json.loads(path.read_text()) if path.exists() else None
        self.model = output / "updated_model.xml"


@pytest.fixture(scope="module")
def arm_command(folder):
    """Run robot-sysid on the guess; every run has an output folder of its own."""
    import contextlib
    import io
    import types

    count = iter(range(1000))

    def run(*options):
        output = folder / f"out{next(count)}"
        out, err = io.StringIO(), io.StringIO()
        # A log brings its own motion.
        motion = () if "--measurements" in options else MOTION
        arguments = [str(folder / "guess.xml"), *motion, "--cutoff", "8"]
        arguments += ["--output-dir", str(output), "--link-uncertainty", "2"]
        there = [str(folder / o) if o.endswith(".xml") else o for o in options]
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main([*arguments, *there])
        printed = types.SimpleNamespace(out=out.getvalue(), err=err.getvalue())
        return Result(code, printed, output)

    return run


def figures(params):
    """All numbers of a result, without where it came from."""
    apart = ("source", "logs", "seed", "notes")
    return {key: value for key, value in params.items() if key not in apart}


def rewritten(log, change, titles=lambda t: t):
    """The log as another program might have written it."""
    header, *lines = log.read_text().splitlines()
    rows = change(np.array([[float(x) for x in line.split(",")] for line in lines]))
    path = log.with_name("other.csv")
    names = ",".join(titles(t) for t in header.split(","))
    np.savetxt(path, rows, delimiter=",", header=names, comments="", fmt="%.17g")
    return path


def test_a_log_on_file_gives_the_same_as_the_simulation_that_wrote_it(log, arm_command):
    path, first = log
    again = arm_command("--measurements", str(path))
    assert again.code == 0
    assert figures(again.params) == figures(first)


def test_the_plants_link_is_found(log):
    params = log[1]
    truth = arms.robot_of(HEAVIER).prior.theta
    names = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
    six = params["inertia_tensor"]
    values = [params["mass"], *params["center_of_mass_moment"], *(six[n] for n in names[4:])]
    errors = np.array([params["standard_errors"][name] for name in names])
    assert np.all(np.abs(np.array(values) - truth) < 4.0 * errors)
    assert params["relative_standard_errors"]["m"] < 0.1


def test_params_json_holds_all_that_is_known_of_measured_data(log):
    params = log[1]
    joints = ["joint0", "joint1", "joint2"]
    for joint in joints:
        assert set(params["friction_per_joint"][joint]) == {
            "coulomb",
            "viscous",
            "offset",
            "armature",
        }
        assert f"offset[{joint}]" in params["standard_errors"]
        assert params["noise_per_joint"][joint] > 0.0
    assert set(params["data_share"]) == set(params["standard_errors"])
    (test,) = params["validation"]
    assert test["source"] == "20 % of the log that was not fitted for it"
    assert set(test["rmse_per_joint"]) == set(test["relative_error_per_joint"]) == set(joints)
    assert params["source"].startswith("simulated plant") and params["cutoff"] == 8.0
    assert params["delay"] is None and params["tilt"] is None and params["gravity"] is None
    causes = {
        "noise",
        "links",
        "torque scale",
        "joint offsets",
        "gravity",
        "friction model",
        "filtering",
    }
    for name, error in params["standard_errors"].items():
        parts = params["error_budget"][name]
        assert set(parts) == causes and parts["noise"] == params["standard_errors_noise"][name]
        assert sum(part**2 for part in parts.values()) == pytest.approx(error**2, rel=1e-6)
    assert params["limitations"] and params["valid"]["trustworthy"]


def test_delay_and_tilt_reach_the_file_and_the_block(folder, arm_command):
    tilted = HEAVIER.replace("<option ", '<option gravity="0 0.1712 -9.8085" ')
    (folder / "tilted.xml").write_text(tilted)
    result = arm_command(
        *("--plant-model", "tilted.xml", "--torque-delay", "0.004", "--delay", "auto"),
        *("--tilt", "auto", "--encoder-resolution", "1e-5"),
    )
    assert result.params["delay"] == pytest.approx(0.004, abs=1e-4)
    assert np.degrees(result.params["tilt"]) == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(result.params["gravity"], [0.0, 0.1712, -9.8085], atol=4e-3)
    assert re.search(r"Delay of torque behind position: \S+ ± \S+ ms", result.out)
    assert re.search(r"Tilt of the base: \S+ ± \S+ degrees", result.out)


def test_the_written_model_moves_like_the_plant(log, arm_command):
    result = arm_command("--measurements", str(log[0]))
    written = mujoco.MjModel.from_xml_path(str(result.model))
    assert written.body("link2").mass[0] == pytest.approx(result.params["mass"], rel=1e-12)


def test_degrees_milliseconds_and_other_titles_change_nothing(log, arm_command):
    path, first = log

    def change(rows):
        rows[:, 1:4] = np.degrees(rows[:, 1:4])
        rows[:, 0] *= 1e3
        return rows

    other = rewritten(path, change, lambda t: t.replace("torque", "effort"))
    silent = arm_command("--measurements", str(other))
    assert silent.code == 2 and "pass --units" in silent.err
    result = arm_command("--measurements", str(other), "--units", "deg,ms")
    assert result.params["mass"] == pytest.approx(first["mass"], rel=1e-9)


def test_a_columns_file_names_what_titles_do_not(log, folder, arm_command):
    path, first = log
    other = rewritten(path, lambda rows: rows, lambda t: "x" + str(sum(map(ord, t))))
    named = [f"#{k}" for k in range(1, 8)]
    columns = folder / "columns.txt"
    columns.write_text(
        f"time = {named[0]}\nposition = {', '.join(named[1:4])}\ntorque = {', '.join(named[4:])}\n"
    )
    assert arm_command("--measurements", str(other)).code == 2
    result = arm_command("--measurements", str(other), "--columns", str(columns))
    assert result.params["mass"] == first["mass"]


def flip(rows):
    rows[:, 5] *= -1.0
    return rows


def still(rows):
    rows[:, 1:4] = rows[0, 1:4]
    return rows


def silent(rows):
    rows[:, 6] = 0.0
    return rows


def swapped(rows):
    rows[[30, 31], 0] = rows[[31, 30], 0]
    return rows


def spiked(rows):
    rows[40, 2] += 1.0
    return rows


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (flip, "torque of joint joint1 has the opposite sign"),
        (still, "the arm is at rest"),
        (silent, "torque of joint joint2 is zero in every row"),
        (swapped, "time runs backwards at line 33"),
        (spiked, "position of joint joint1 jumps at lines 42, 43"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_faulty_log_ends_with_one_line_and_no_file(log, arm_command, fault, words):
    result = arm_command("--measurements", str(rewritten(log[0], fault)))
    assert result.code == 2 and result.params is None
    (line,) = [line for line in result.err.splitlines() if "error:" in line]
    assert words in line


def test_what_looks_odd_is_said_even_where_the_run_then_fails(log, arm_command):
    def outside(rows):
        rows[:, 1] += 3.0
        return flip(rows)

    result = arm_command("--measurements", str(rewritten(log[0], outside)))
    assert result.code == 2
    assert "note: positions leave the model's joint limits: joint0" in result.err


def test_an_impossible_body_is_said_and_no_model_is_written(arm_command):
    noisy = ("--plant-model", "plant.xml", "--noise-torque", "4", "--consistency", "off")
    results = [arm_command(*noisy, "--seed", str(seed)) for seed in range(2, 6)]
    bad = [r for r in results if r.params["status"] == "INCONSISTENT"]
    assert bad
    for result in bad:
        assert result.code == 1 and not result.model.exists()
        assert "no model was written: the estimate is not a possible rigid body" in result.err
        assert not result.params["valid"]["trustworthy"]


def test_auto_returns_possible_bodies_of_the_same_logs(arm_command):
    noisy = ("--plant-model", "plant.xml", "--noise-torque", "4")
    for seed in range(2, 6):
        params = arm_command(*noisy, "--seed", str(seed)).params
        six = params["inertia_tensor"]
        theta = [params["mass"], *params["center_of_mass_moment"], *six.values()]
        assert spatial.is_consistent(np.array(theta))


def test_a_mass_lost_in_noise_gets_no_model(arm_command):
    result = arm_command("--plant-model", "plant.xml", "--noise-torque", "60")
    assert result.code == 1 and not result.model.exists()
    assert "no model was written: the data does not tell the link's mass" in result.err


def test_a_closed_loop_says_how_to_read_its_log_the_same_way(folder, arm_command):
    path = folder / "loop.csv"
    result = arm_command(
        *("--plant-model", "plant.xml", "--simulation", "forward"),
        *("--encoder-resolution", "1e-5", "--save-measurements", str(path)),
    )
    assert result.code == 0
    (advice,) = re.findall(r"--velocity-deadband ([\d.,]+) does the same", result.err)
    assert advice in path.read_text().splitlines()[0]
    again = arm_command("--measurements", str(path), "--velocity-deadband", advice)
    assert again.params["mass"] == result.params["mass"]
    assert again.params["friction_per_joint"] == result.params["friction_per_joint"]


def test_friction_that_never_saturates_is_reported(folder, arm_command):
    bare = HEAVIER.replace('armature=".05"', "").replace('frictionloss=".3"', 'frictionloss="8"')
    (folder / "bare.xml").write_text(bare)
    result = arm_command("--plant-model", "bare.xml", "--simulation", "forward")
    assert "the frictionloss of joint0 (8 N m) is never reached" in result.err


def test_another_log_tests_the_result(log, folder, arm_command):
    other = folder / "second.csv"
    arm_command(
        *("--plant-model", "plant.xml", *SENSORS, "--seed", "5"),
        *("--save-measurements", str(other)),
    )
    result = arm_command("--measurements", str(log[0]), "--validation-measurements", str(other))
    own, second = result.params["validation"]
    assert second["source"] == str(other)
    assert second["rmse"] < 1.5 * result.params["rmse"]
    assert f"Validation on {other}: " in result.out
    assert "note: validation log: log columns" in result.err
    alone = arm_command(
        *("--measurements", str(log[0]), "--validate", "0"),
        *("--validation-measurements", str(other)),
    )
    assert [test["source"] for test in alone.params["validation"]] == [str(other)]


@pytest.mark.parametrize(
    "options",
    [
        ("--method", "ols"),
        ("--method", "robust"),
        ("--prior", "entropic"),
        ("--prior", "entropic", "--prior-weight", "50"),
        ("--consistency", "enforce"),
        ("--friction-model", "auto"),
        ("--friction-model", "coulomb-viscous-offset-armature-sqrt"),
        ("--no-friction",),
        ("--torques", "terminal"),
        ("--validate", "0"),
        ("--velocity-deadband", "0.01,0.02,0.03"),
    ],
    ids=" ".join,
)
def test_every_option_runs_on_a_log(log, arm_command, options):
    result = arm_command("--measurements", str(log[0]), *options)
    assert result.code == 0, result.err
    assert result.params["valid"]["physically_consistent"]


def test_several_logs_are_one_result(log, folder, arm_command):
    path, first = log
    other = folder / "another.csv"
    made = ("--plant-model", "plant.xml", *SENSORS, "--seed", "6", "--save-measurements")
    arm_command(*made, str(other))
    result = arm_command("--measurements", str(path), "--measurements", str(other))
    assert result.code == 0, result.err
    assert result.params["source"] == f"log {path}, {other}"
    assert result.params["duration"] == pytest.approx(16.0, abs=1e-6)
    assert result.params["sample_rate"] == pytest.approx(200.0, rel=1e-9)
    assert result.params["validation"][0]["source"] == "20 % of each log that was not fitted for it"
    assert f"note: {path.name}: log columns" in result.err
    assert f"note: {other.name}: log columns" in result.err
    errors = (run["standard_errors"]["m"] for run in (result.params, first))
    assert next(errors) < next(errors)
    assert re.search(
        r"mass of each log alone: .*log.csv [\d.]+ ± [\d.]+ kg; .*another.csv", result.err
    )
    assert "the logs agree: their masses scatter by" in result.err
    apart = [
        test for test in result.params["validation"] if "from the other logs" in test["source"]
    ]
    assert len(apart) == 2 and all(test["relative_error"] < 0.1 for test in apart)


def test_logs_that_do_not_agree_are_called_so(log, folder, arm_command):
    (folder / "lighter.xml").write_text(XML.replace('mass=".8"', 'mass=".5"'))
    other = folder / "lighter.csv"
    made = ("--plant-model", "lighter.xml", *SENSORS, "--seed", "7", "--save-measurements")
    arm_command(*made, str(other))
    result = arm_command("--measurements", str(log[0]), "--measurements", str(other))
    assert "the logs do not agree" in result.err


def test_the_models_own_simulation_names_the_two_ways_to_real_data(arm_command):
    bare = arm_command("--cutoff", "8")
    assert bare.code == 2 and "--cutoff needs --measurements or --plant-model" in bare.err


def test_an_earlier_run_is_continued(log, folder, arm_command):
    path, _ = log
    other = folder / "later.csv"
    made = ("--plant-model", "plant.xml", *SENSORS, "--seed", "8", "--save-measurements")
    arm_command(*made, str(other))
    arm_command("--measurements", str(path))
    before = max(folder.glob("out*/params.json"), key=lambda p: p.stat().st_mtime_ns)
    earlier = before.rename(folder / "earlier.json")
    together = arm_command("--measurements", str(path), "--measurements", str(other))
    continued = arm_command("--measurements", str(other), "--append", str(earlier))
    assert figures(continued.params) == figures(together.params)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"logs": []}, "no identification from logs"),
        ({"logs": ["/nowhere/log.csv"]}, "is no longer there"),
        ({"model": {"sha256": "00"}}, "was made with another model"),
    ],
)
def test_what_cannot_be_continued_is_refused(log, folder, arm_command, change, words):
    path, _ = log
    made = arm_command("--measurements", str(path))
    broken = folder / "broken.json"
    broken.write_text(json.dumps({**made.params, **change}))
    result = arm_command("--measurements", str(path), "--append", str(broken))
    assert result.code == 2 and words in result.err and result.params is None
