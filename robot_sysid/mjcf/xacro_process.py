"""The process that expands a xacro file: ``python xacro_process.py``, a request on standard input.

A xacro is a program: its expressions are Python's, and the package's own protection of them can be
got round, so that a file could run any command. Here expressions are read as a tree first, in which
only what cannot lead out of them may stand; and the process that evaluates them may neither write,
nor start another one, nor open a connection, nor go on for long. It is a script of its own, which
imports nothing of this package, so that it begins in a tenth of a second.

The request is JSON: "sys_path" to import from, "path" of the file, "folders" in which packages are
looked up, "seconds" and "bytes" as limits. So is the answer on standard output: "urdf", or "error"
with "missing", names of packages that were not found.
"""

from __future__ import annotations

import ast
import json
import os
import re
import stat
import sys
from pathlib import Path
from typing import Any

# Forms of expressions whose values hold frames, and by these the whole interpreter.
_REFUSED_FORMS = (ast.Lambda, ast.GeneratorExp, ast.Await, ast.Yield, ast.YieldFrom)
# Beginnings of attributes of frames, code and generators.
_INNER_ATTRIBUTES = ("_", "gi_", "cr_", "ag_", "f_", "tb_", "co_", "func_")
# Functions of xacro's namespaces that return what attributes and forms would.
_INNER_FUNCTIONS = ("type", "vars")
# What an expression may read: YAML of numbers, as the descriptions of UR's and Franka's arms do.
_YAML_SUFFIXES = (".yaml", ".yml")
# Names of packages, as ROS has them: no path.
_PACKAGE = re.compile(r"\w[\w-]*", re.ASCII)
# Events of Python's audit hooks that write, start or connect; reading is looked at by itself.
_REFUSED_EVENTS = (
    "ctypes.",
    "os.chdir",
    "os.chmod",
    "os.chown",
    "os.exec",
    "os.fork",
    "os.kill",
    "os.link",
    "os.mkdir",
    "os.posix_spawn",
    "os.putenv",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.spawn",
    "os.startfile",
    "os.symlink",
    "os.system",
    "os.truncate",
    "os.unsetenv",
    "os.utime",
    "shutil.",
    "socket.",
    "subprocess.",
)
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


class RefusedError(Exception):
    """A file asks for what no description of a robot needs."""


def limit_process(seconds: int, memory: int) -> None:
    """Have the system end this process where it takes longer, or more memory, than it may.

    Windows knows no such limits: there the process that started this one ends it.
    """
    try:
        import resource
    except ImportError:
        return
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))


def refuse_acts(event: str, values: tuple[Any, ...]) -> None:
    """Raise RefusedError where the process is to do anything but to read a file; an audit hook."""
    if event.startswith(_REFUSED_EVENTS):
        raise RefusedError(f"it would use {event}, which no expression may")
    if event != "open" or not isinstance(values[0], (str, bytes)):
        return
    name = os.fsdecode(values[0])
    flags = values[2] if isinstance(values[2], int) else 0
    if flags & _WRITES:
        raise RefusedError(f"it would write {name}, which no expression may")
    if os.path.exists(name) and not stat.S_ISREG(os.stat(name).st_mode):
        raise RefusedError(f"{name} is a pipe or a device")


def checked_expression(text: str) -> str:
    """Return an expression without blanks around it, or raise RefusedError."""
    text = text.strip()
    for node in ast.walk(ast.parse(text, "<expression>", "eval")):
        is_inner = isinstance(node, _REFUSED_FORMS)
        if isinstance(node, ast.Attribute):
            is_inner = node.attr.startswith(_INNER_ATTRIBUTES)
        elif isinstance(node, ast.Name):
            is_inner = node.id.startswith("__")
        if is_inner:
            raise RefusedError(
                f"the expression {text!r:.100} is not one of numbers and names"
            )
    return text


class Expansion:
    """The expansion of one file.

    Attributes:
        missing: names of packages that were not found.
    """

    def __init__(self, path: Path, folders: list[Path]) -> None:
        self._path = path
        self._folders = folders
        # The folders that hold the file's own packages.
        self._own = [path.parent]
        self.missing: list[str] = []

    def text(self) -> str:
        """Return the URDF, arguments at their defaults."""
        import xacro
        from xacro import substitution_args

        evaluate = xacro.safe_eval
        self._find_as_ros = substitution_args._eval_find
        self._load_yaml = xacro.load_yaml
        # As if no variable of the environment were set.
        substitution_args._eval_env = _refuse_variable
        substitution_args._eval_optenv = _default_of_variable
        substitution_args._eval = _refuse_eval
        substitution_args._eval_find = self._find
        symbols = xacro._global_symbols
        xacro.safe_eval = lambda text, *names: evaluate(
            checked_expression(text), *names
        )
        for names in (symbols, symbols["python"]):
            for name in _INNER_FUNCTIONS:
                dict.pop(names, name, None)
        for names in (symbols, symbols["xacro"]):
            dict.__setitem__(names, "load_yaml", self._load_own_yaml)
        document = xacro.process_file(str(self._path), verbosity=0)
        return str(document.documentElement.toprettyxml(indent="  "))

    def _find(self, name: str) -> str:
        """Return the folder of a package."""
        folder = self._folder_of(name)
        self._own.append(Path(folder))
        return folder

    def _folder_of(self, name: str) -> str:
        if not _PACKAGE.fullmatch(name):
            raise RefusedError(f"{name!r:.100} is no name of a package")
        for folder in self._folders:
            # A clone may be called otherwise than the package.
            manifest = folder / "package.xml"
            text = manifest.read_text("utf-8", "replace") if manifest.is_file() else ""
            if folder.name == name or f"<name>{name}</name>" in text:
                return str(folder)
            if (folder / name).is_dir():
                return str(folder / name)
        self.missing.append(name)
        return str(self._find_as_ros(name))

    def _load_own_yaml(self, name: str) -> Any:
        """Return the content of a YAML file of the packages that the file belongs to."""
        import xacro

        path = Path(os.path.realpath(xacro.abs_filename_spec(name)))
        own = [Path(os.path.realpath(folder)) for folder in self._own]
        if path.suffix not in _YAML_SUFFIXES or not {*own} & {*path.parents}:
            raise RefusedError(f"{name} is no YAML file of the model's own packages")
        return self._load_yaml(name)


def _refuse_variable(name: str) -> str:
    raise RefusedError(f"$(env {name}): variables of the environment are not read")


def _default_of_variable(name: str, default: str = "") -> str:
    return default


def _refuse_eval(text: str, context: Any) -> str:
    raise RefusedError("$(eval ...) is not evaluated")


def fault_of(error: BaseException) -> str:
    """Return what is wrong, on one line: the first cause of an error that says it."""
    causes: list[BaseException] = [error]
    while causes[-1].__context__ is not None:
        causes.append(causes[-1].__context__)
    for cause in causes:
        if isinstance(cause, RefusedError):
            return str(cause)
        if isinstance(cause, (MemoryError, RecursionError)):
            return f"it takes more than there is ({type(cause).__name__})"
        if isinstance(cause, OSError) and cause.strerror:
            return cause.strerror
    return " ".join(str(error).split()) or type(error).__name__


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Return what a request asks for."""
    expansion = Expansion(Path(request["path"]), [*map(Path, request["folders"])])
    try:
        text = expansion.text()
    except Exception as error:
        return {"error": fault_of(error), "missing": expansion.missing}
    if len(text) > request["bytes"]:
        return {"error": f"it expands to more than {request['bytes']} characters"}
    return {"urdf": text}


def main() -> None:
    """Answer the request on standard input, within its limits."""
    request = json.loads(sys.stdin.buffer.read())
    sys.path[:] = request["sys_path"]
    sys.dont_write_bytecode = True
    limit_process(request["seconds"], request["memory"])
    sys.addaudithook(refuse_acts)
    text = json.dumps(answer(request))
    sys.__stdout__.write(text)  # type: ignore[union-attr]


if __name__ == "__main__":
    main()
