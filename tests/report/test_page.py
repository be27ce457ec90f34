"""The page is one file that loads no other, escapes names, is complete and reproducible."""

import json
import math
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from markupsafe import escape

from rigs.files import results as made
from rigs.files.reports import payload_result, saved, traces
from robot_sysid.errors import InputError
from robot_sysid.records.file_access import REPORT_NAME
from robot_sysid.records.messages import printable
from robot_sysid.report.drawing import COLOURS
from robot_sysid.report.figures import drawn_errors, error_bars
from robot_sysid.report.page import COMPARISON_NAME, write_report
from robot_sysid.report.runs import load_run
from robot_sysid.results.verdicts import Verdict

VOID = {"meta", "link", "br", "img", "input", "hr"}


class Tags(HTMLParser):
    """Every tag with its attributes, and the end tags that close no open one."""

    def __init__(self, text):
        super().__init__()
        self.open_tags = []
        self.tags = []
        self.faults = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open_tags.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if not self.open_tags or self.open_tags.pop() != tag:
            self.faults.append(tag)


@pytest.fixture(scope="module")
def text(page):
    """The HTML of a page."""
    return page.read_text(encoding="utf-8")


def test_every_tag_is_closed_names_are_text_and_nothing_is_loaded_from_elsewhere(text):
    page = Tags(text)
    assert page.faults == [] and page.open_tags == []
    assert not any(
        tag in ("script", "iframe", "object", "link") for tag, _ in page.tags
    )
    assert not any(name.startswith("on") for _, attrs in page.tags for name in attrs)
    assert "&lt;script&gt;alert(1)" in text and "$x^{1}&amp;" in text and "関節" in text
    for _, attrs in page.tags:
        for name in ("src", "href", "xlink:href", "action", "data"):
            assert str(attrs.get(name, "#")).startswith(("#", "data:image/png;base64,"))
    policies = [a for tag, a in page.tags if tag == "meta" and "http-equiv" in a]
    assert policies[0]["content"].startswith("default-src 'none'")
    sections = ("section", "details")
    ids = [attrs["id"] for tag, attrs in page.tags if "id" in attrs and tag in sections]
    assert len(ids) == len(set(ids)) >= 6
    anchors = {attrs["id"] for _, attrs in page.tags if "id" in attrs}
    assert set(re.findall(r"url\(#([^)]+)\)", text)) <= anchors
    assert {a["xlink:href"][1:] for tag, a in page.tags if tag == "use"} <= anchors


def test_every_part_is_there_and_every_figure_has_a_caption_and_a_unit(text):
    for phrase in (
        "Links before and after",
        "Identifiability",
        "Torque and residual of each joint, before and after",
        "Friction",
        "Prediction errors",
        "fifths of arm.csv",
    ):
        assert phrase in text, phrase
    figures = re.findall(r"<figure.*?</figure>", text, re.DOTALL)
    assert len(figures) >= 5
    for figure in figures:
        assert re.search(r"<figcaption>.{10,}</figcaption>", figure, re.DOTALL)
        assert re.search(r"\[|±|%|posture", figure)
        # Its colours are those of the page, light or dark.
        assert not set(COLOURS.values()) & set(re.findall(r"#\w{6}", figure))


def test_the_first_screen_is_verdict_all_joints_and_their_errors_the_rest_is_folded(
    text,
):
    first_screen, *folds = text.partition("<main>")[2].split('<details class="fold"')
    panels = re.findall(r"<figcaption>(.*?)</figcaption>", first_screen)
    assert panels == ["j5: torque [N·m]", "j6: torque [N]"]
    # The torque error is stated once, by the sentence of the console.
    assert len(re.findall("27\u00a0%\u00a0→\u00a00.25\u00a0%", first_screen)) == 1
    assert len(folds) >= 6 and not any(fold.startswith(" open") for fold in folds)


def test_bars_have_the_errors_of_the_file_and_one_scale(link_run, tmp_path):
    content = json.loads((link_run / "params.json").read_text())
    file = content["file"]
    for key, errors in (
        ("before_as_used", {"j5": 0.4, "j6": 0.1, "j7": None}),
        ("after_as_used", {"j5": 0.02, "j6": 0.2, "j7": None}),
    ):
        file[key]["relative_error_per_joint"] = errors
    text = page_with(link_run, tmp_path, file=file)
    assert re.findall(r'<i class="(\w+)" style="width:([\d.]+)%"></i>', text) == [
        ("before", "100.0"),
        ("after", "5.0"),
        ("before", "25.0"),
        ("after", "50.0"),
    ]
    rows = re.findall(r"<tr><td>(j\d)</td>.*?<td>([^<]*)</td></tr>", text, re.DOTALL)
    spaces = [(joint, said.replace("\u00a0", " ")) for joint, said in rows]
    assert spaces[:3] == [("j5", "40 % → 2 %"), ("j6", "10 % → 20 %"), ("j7", "–")]


def test_without_a_file_the_bars_have_the_errors_of_the_torques_that_are_drawn():
    """Those of the made-up traces are predicted as they are before, and 0.9 times after."""
    errors = drawn_errors(traces())
    for before, after in errors.values():
        assert before == pytest.approx(0.0) and after == pytest.approx(0.1)
    assert [bars.scale for bars in error_bars(errors)] == pytest.approx([0.1, 0.1])
    (still,) = error_bars({"j5": (math.nan, math.nan)})
    assert still.scale == 1.0


@pytest.fixture(autouse=True)
def no_pictures(page, no_renderer):
    """Let pages beside the one of the session have no pictures, which take long to draw."""


def page_of(folder):
    """The text of the page about the run in a folder."""
    return write_report([load_run(folder)], folder).read_text(encoding="utf-8")


def page_with(link_run, folder, **changes):
    """The text of the page about a run with changed entries of params.json."""
    for name in ("report_data.npz", "updated_model.xml"):
        shutil.copy(link_run / name, folder)
    content = json.loads((link_run / "params.json").read_text())
    (folder / "params.json").write_text(json.dumps({**content, **changes}))
    return page_of(folder)


def test_the_title_names_the_robot_the_day_and_the_logs(link_run, tmp_path):
    model = tmp_path / "scene.xml"
    model.write_text((link_run.parent / "arm.xml").read_text())
    entry = {"path": str(model), "sha256": ""}
    logs = ["/data/a.csv", "b.csv"]
    text = page_with(link_run, tmp_path, model=entry, logs=logs)
    title = re.search("<title>(.*)</title>", text)[1]
    assert re.fullmatch(r"scene, \d{4}-\d\d-\d\d: a\.csv, b\.csv", title)
    assert "has changed since the run" in text
    model.unlink()
    text = page_with(link_run, tmp_path, model=entry)
    assert "<title>scene, " in text and "not at" in text


@pytest.mark.slow
def test_a_command_of_the_verdict_stands_alone_to_be_copied(link_run, tmp_path):
    lines = ("Usable: yes", "Next, to test it:", "  robot-sysid log 'a b.csv'")
    run = replace(load_run(link_run), printed=lines)
    text = write_report([run], tmp_path).read_text(encoding="utf-8")
    assert "<pre>robot-sysid log &#39;a b.csv&#39;</pre>" in text
    assert "<p>Next, to test it:</p>" in text


def test_a_page_has_no_control_characters(link_run, tmp_path):
    odd = "a\x1b[2J\u202eb\x9bc.csv"
    text = page_with(link_run, tmp_path, logs=[odd], failure=odd, source=odd)
    assert "a?[2J?b?c.csv" in text
    assert not [
        letter for letter in text if letter != "\n" and printable(letter) != letter
    ]


def test_a_folder_that_was_moved_has_its_files_where_it_is(link_run, tmp_path):
    """Nor is a command repeated that was one for another place."""
    lines = ("Usable: old/updated_model.xml", "  robot-sysid log a.csv")
    text = page_with(link_run, tmp_path, verdict=lines)
    assert f"Usable: {tmp_path / 'updated_model.xml'}; torque error " in text
    assert "old/updated_model.xml" not in text and "<pre>robot-sysid" not in text


def test_no_text_of_a_result_becomes_a_command_or_a_file_of_another_folder(
    link_run, tmp_path
):
    command = "  robot-sysid motors play --yes"
    model = tmp_path / "updated_model.xml"
    model.write_text("<mujoco/>")
    folder = tmp_path / "run"
    folder.mkdir()
    content = json.loads((link_run / "params.json").read_text())
    file = {**content["file"], "name": "../updated_model.xml"}
    step = {"sentence": "Next", "command": [command], "then": None}
    source = f"a.csv\n{command}"
    odd = {"verdict": [command], "next_step": step, "source": source}
    text = page_with(link_run, folder, file=file, **odd)
    assert "<pre>robot-sysid" not in text and "../updated_model.xml" not in text
    lines = load_run(folder).verdict
    assert lines[0].startswith(f"Usable: {folder / 'updated_model.xml'}; ")
    assert not [line for line in lines if line.startswith(command)]


def rating_in(text):
    """The rating of a page's verdict, which is its colour."""
    return re.search('class="verdict ([a-z]+)"', text)[1]


def test_amber_is_the_colour_of_a_caveat_and_red_of_what_is_not_usable(
    link_run, tmp_path
):
    for status, rating in (("AS_GOOD", "good"), ("TORQUES_ONLY", "part")):
        assert rating_in(page_with(link_run, tmp_path, status=status)) == rating
    text = page_with(link_run, tmp_path, failure="it is no better")
    assert rating_in(text) == "bad" and "mass [kg]</td>" not in text.split("fold")[0]
    # The torques of another run are not drawn.
    assert "belongs to another run" in text and "time [s]" not in text


def test_a_model_of_its_own_simulation_has_one_body_without_errors(link_run, tmp_path):
    text = page_of(saved(tmp_path, made.itself()))
    main_table = re.search("<tbody>.*?</tbody>", text, re.DOTALL)[0]
    first_row = re.search("<tr>.*?</tr>", main_table)[0]
    words = re.sub("<[^>]*>", " ", first_row).split()
    assert words == ["mass", "[kg]", "1", "2", "+100", "%"]


@pytest.mark.parametrize(
    "odd",
    [{"quantities": "much"}, {"quantities": [7]}, {"remarks": [1]}, {"file": "m"}],
)
def test_a_result_with_an_entry_of_another_type_is_refused(link_run, tmp_path, odd):
    with pytest.raises(InputError, match="is no whole result: "):
        page_with(link_run, tmp_path, **odd)
    assert not (tmp_path / REPORT_NAME).exists()


def test_a_payload_has_its_card_unless_it_is_refused(link_run, tmp_path):
    """The same run makes the same page."""
    model = link_run.parent / "arm.xml"
    folder = saved(tmp_path, payload_result(model))
    text = page_of(folder)
    assert page_of(folder) == text
    assert str(escape((folder / "payload_card.txt").read_text())) in text
    assert "$x^{1}&amp;" in text
    assert "1.200" in text and rating_in(text) == "good"
    text = page_of(saved(tmp_path, payload_result(model, Verdict.SWAPPED)))
    assert "No card was written" in text and rating_in(text) == "bad"


def test_a_comparison_has_the_main_numbers_of_each_run(link_run, tmp_path):
    run = load_run(link_run)
    payload = load_run(saved(tmp_path, payload_result(link_run.parent / "arm.xml")))
    path = write_report([run, payload], tmp_path)
    text = path.read_text(encoding="utf-8")
    page = Tags(text)
    assert path.name == COMPARISON_NAME and page.faults == [] == page.open_tags
    assert text.count("mass [kg]</td>") == 3 and "<script" not in text
    assert "2 runs compared" in text
