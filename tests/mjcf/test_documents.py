"""Reading model files: what is refused, and includes as MuJoCo reads them."""

from __future__ import annotations

import hashlib

import pytest

from rigs.files.model_files import ARM, document_of, make_pipe, write_files
from rigs.files.refusals import refused
from robot_sysid.errors import ModelError
from robot_sysid.mjcf.documents import read_document
from robot_sysid.parser import load_robot_model

BODY = "<mujoco><worldbody><body name='{}'/></worldbody></mujoco>"
LAUGHS = """<!DOCTYPE a [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>
<mujoco model="&b;"><worldbody/></mujoco>"""
OUTSIDE = """<!DOCTYPE a [<!ENTITY a SYSTEM "file:///etc/hostname">]>
<mujoco><worldbody>&a;</worldbody></mujoco>"""


def names(path):
    return [node.get("name") for node in read_document(path).root.iter("body")]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "Expected an XML model file, but .* is empty"),
        (b"hello", "Expected an XML model file, but .* is not XML"),
        (b"\x89PNG\r\n\x1a\n\x00\xff", "Expected an XML model file"),
        (ARM[:200].encode(), "Expected an XML model file, but .* is not XML"),
        (LAUGHS.encode(), "declares XML entities"),
        (OUTSIDE.encode("utf-16"), "declares XML entities"),
        (b"<mujoco>" * 300, "not XML: Excessive depth"),
        (b"<default/>", "is a fragment, not a whole model: its root is <default>"),
        (b"<mujoco/>", "is a fragment, not a whole model: no <worldbody>"),
        (b"<robot name='r'/>", "no <link>; pass the main model file"),
        (
            b"<sdf version='1.9'><model/><model/></sdf>",
            "is SDF, .* pass the URDF or xacro",
        ),
    ],
)
def test_what_is_no_model_is_refused_in_one_line(tmp_path, content, message):
    path = tmp_path / "m.xml"
    path.write_bytes(content)
    with refused(message, ModelError):
        read_document(path)


def test_a_folder_and_a_missing_file_are_one_line(tmp_path):
    with refused("is a folder"):
        read_document(tmp_path)
    with refused("nothing.xml not found"):
        read_document(tmp_path / "nothing.xml")
    with refused("cannot read"):
        read_document(tmp_path / "a\0b")


@pytest.mark.parametrize(
    ("encoding", "declared"),
    [
        ("utf-16", "UTF-16"),
        ("utf-16-le", "UTF-16"),
        ("utf-16-be", ""),
        ("utf-32", "UTF-32"),
        ("utf-32-le", ""),
        ("utf-8-sig", "UTF-8"),
        # What a program declares that writes its texts as UTF-8.
        ("utf-8", "UTF-16"),
        ("utf-16", "UTF-8"),
        ("shift_jis", "Shift_JIS"),
        ("iso2022_jp", "ISO-2022-JP"),
        ("gb18030", "GB18030"),
        ("cp037", "IBM037"),
    ],
)
def test_a_model_is_read_in_any_encoding_that_xml_has(tmp_path, encoding, declared):
    name = "arm" if encoding == "cp037" else "\u95a2\u7bc0"
    text = ARM.replace('name="tool"', f'name="{name}"')
    head = f"<?xml version='1.0' encoding='{declared}'?>" if declared else ""
    path = tmp_path / "m.xml"
    path.write_bytes((head + text.lstrip()).encode(encoding))
    assert name in names(path)
    assert (
        load_robot_model(path).n_joints
        == load_robot_model(write_files(tmp_path, {"plain.xml": ARM})).n_joints
    )


@pytest.mark.parametrize("declared", ["no-such", "rot13", "zlib", "undefined", "idna"])
def test_a_declaration_of_no_encoding_is_no_error(tmp_path, declared):
    path = tmp_path / "m.xml"
    head = f"<?xml version='1.0' encoding='{declared}'?><!-- \xe9 -->"
    path.write_bytes((head + ARM).encode("latin-1"))
    assert "tool" in names(path)


@pytest.mark.parametrize(
    "content",
    [
        ARM,
        "\ufeff" + ARM,
        "\n  <?xml version='1.0'?>" + ARM,
        "<?xml version='1.0' encoding='latin-1'?>" + ARM,
        "<!DOCTYPE mujoco>" + ARM,
    ],
)
def test_what_mujoco_accepts_is_accepted(tmp_path, content):
    path = write_files(tmp_path, {"m.xml": content})
    assert names(path) == ["base", "link1", "link2", "tool", "finger"]


ONE = "<mujoco><include file='s/a'/></mujoco>"
TWO = "<mujoco><include file='b'/></mujoco>"
INSIDE = (
    "<worldbody><body name='1'><include file='a'/></body><body name='4'/></worldbody>"
)
THREE = "<anything><body name='2'><body name='3'/></body></anything>"


@pytest.mark.parametrize(
    ("files", "bodies"),
    [
        ({"m": ONE, "s/a": TWO, "s/b": BODY.format("x")}, ["x"]),
        (
            {"m": ONE, "s/a": TWO, "s/b": BODY.format("x"), "b": BODY.format("first")},
            ["first"],
        ),
        ({"m": f"<mujoco>{INSIDE}</mujoco>", "a": THREE}, ["1", "2", "3", "4"]),
    ],
)
def test_includes_are_found_where_mujoco_finds_them(tmp_path, files, bodies):
    assert names(write_files(tmp_path, files)) == bodies


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"m": "<mujoco><include/></mujoco>"}, "without a file attribute"),
        (
            {"m": "<mujoco>\n<include file='a'/></mujoco>"},
            "line 2: included file a not found",
        ),
        (
            {"m": "<mujoco><include file='m'/></mujoco>"},
            "m is included twice or includes itself",
        ),
        (
            {
                "m": "<mujoco><include file='a'/><include file='./a'/></mujoco>",
                "a": BODY.format("x"),
            },
            "included twice",
        ),
    ],
)
def test_includes_that_fail_are_one_line(tmp_path, files, message):
    with refused(message, ModelError):
        read_document(write_files(tmp_path, files))


def test_the_hash_is_that_of_the_file_and_covers_includes(tmp_path):
    path = write_files(tmp_path, {"m.xml": BODY.format("x")})
    assert read_document(path).sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    main = "<mujoco><include file='m.xml'/></mujoco>"
    outer = read_document(write_files(tmp_path, {"n.xml": main})).sha256
    write_files(tmp_path, {"m.xml": BODY.format("y")})
    assert read_document(tmp_path / "n.xml").sha256 != outer


def test_a_doctype_in_another_file_is_not_opened(tmp_path):
    make_pipe(tmp_path / "other.dtd")  # it would be waited for without end
    text = '<!DOCTYPE mujoco SYSTEM "other.dtd"><mujoco><worldbody/></mujoco>'
    assert document_of(tmp_path, text).is_urdf is False


def test_nothing_of_a_file_that_is_no_model_is_shown(tmp_path):
    (tmp_path / "secret").write_text("hunter2:x:0:0")
    path = write_files(
        tmp_path / "model", {"m.xml": '<mujoco><include file="../secret"/></mujoco>'}
    )
    with refused("secret is not XML", ModelError) as caught:
        read_document(path)
    assert "hunter2" not in str(caught.value)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("mark", ["<!--", "<!DOCTYPE"])
def test_marks_that_never_end_take_no_longer_than_their_length(tmp_path, mark):
    path = tmp_path / "model.xml"
    path.write_text("<mujoco>" + mark * 250_000, encoding="utf-8")
    with refused("is not XML", ModelError):
        read_document(path)


TEXT = """<?xml version='1.0' encoding='UTF-8'?>
<!-- <fake/> -- dashes --><mujoco x="1&gt;2" y="3"><b/><c z="4"><d>t</d></c><!----><worldbody/>
</mujoco>
"""
PREFIXES = """<!DOCTYPE robot>
<robot xmlns="http://drake.mit.edu" xmlns:x="http://x" x:y="1">
  <link name="a"/>
  <gazebo><sensor:camera/></gazebo>
</robot>
"""


@pytest.mark.parametrize("text", [TEXT, PREFIXES, ARM, ARM.replace("\n", "\r\n")])
def test_nothing_but_quotes_and_white_space_inside_tags_changes(tmp_path, text):
    written = document_of(tmp_path, text).text().decode()
    marks = str.maketrans("'", '"', " \r\n")
    assert written.translate(marks) == text.translate(marks)
    assert written.count("\n") == written.count("\r\n") or "\r" not in text
