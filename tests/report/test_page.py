"""The page is one file that loads no other, escapes names, is complete and reproducible."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import pytest

from robot_sysid.report.page import html, title_of, write_report
from robot_sysid.report.runs import load_run
from robot_sysid.report.sections import Section

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
    assert len(ids) == len(set(ids)) > 8
    anchors = {attrs["id"] for _, attrs in page.tags if "id" in attrs}
    assert set(re.findall(r"url\(#([^)]+)\)", text)) <= anchors
    assert {a["xlink:href"][1:] for tag, a in page.tags if tag == "use"} <= anchors


def test_every_part_is_there_and_every_figure_has_a_caption_and_a_unit(text):
    for phrase in (
        "Links before and after",
        "Identifiability",
        "Torque and residual of each joint, before and after",
        "Residual: noise or model error?",
        "Motion and its limits",
        "Friction",
        "Prediction errors",
        "truth",
        "Inertia on the arm",
        "fifths of arm.csv",
    ):
        assert phrase in text, phrase
    figures = re.findall(r"<figure.*?</figure>", text, re.DOTALL)
    assert len(figures) > 12
    for figure in figures:
        assert re.search(r"<figcaption>.{10,}</figcaption>", figure, re.DOTALL)
        assert re.search(r"\[|±|%|posture", figure)


def test_the_first_screen_is_the_verdict_with_one_figure_and_the_rest_is_folded(text):
    first_screen, *folds = text.partition("<main>")[2].split('<details class="fold"')
    assert first_screen.count("<figure") == 1
    # The torque error is stated once, by the sentence of the console.
    assert len(re.findall("27\u00a0%\u00a0→\u00a00.25\u00a0%", first_screen)) == 1
    assert len(folds) > 7 and not any(fold.startswith(" open") for fold in folds)


def run_with_model(link_run, folder, path):
    """A run of two logs whose model is at a path."""
    content = json.loads((link_run / "params.json").read_text())
    content["model"]["path"] = str(path)
    content["logs"] = ["/data/a.csv", "b.csv"]
    (folder / "params.json").write_text(json.dumps(content))
    return load_run(folder)


def test_the_title_names_the_robot_the_day_and_the_logs(link_run, tmp_path):
    model = tmp_path / "scene.xml"
    text = (link_run.parent / "arm.xml").read_text()
    model.write_text(re.sub("<mujoco[^>]*>", '<mujoco model="gen3">', text))
    run = run_with_model(link_run, tmp_path, model)
    assert re.fullmatch(r"gen3, \d{4}-\d\d-\d\d: a\.csv, b\.csv", title_of(run))


def test_a_model_that_is_gone_is_named_by_its_file(link_run, tmp_path):
    run = run_with_model(link_run, tmp_path, tmp_path / "gone.xml")
    assert title_of(run).startswith("gone, ")


def test_a_command_of_the_verdict_stands_alone_to_be_copied():
    lines = ("Usable: yes", "Next, to test it:", "  robot-sysid log 'a b.csv'")
    text = html("t", [Section("verdict", "Verdict", lines, verdict="good")])
    assert "<pre>robot-sysid log &#39;a b.csv&#39;</pre>" in text
    assert "<p>Next, to test it:</p>" in text


def test_print_opens_what_is_folded(text):
    print_style = text.partition("@media print {\n  @page")[2].partition("</style>")[0]
    assert "details::details-content { content-visibility: visible" in print_style


@pytest.mark.slow
def test_the_same_run_makes_the_same_bytes(page, link_run, tmp_path):
    (second_page,) = write_report([load_run(link_run)], tmp_path)
    assert second_page.read_bytes() == page.read_bytes()
