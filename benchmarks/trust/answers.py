"""What the commands answer to simulated logs: models and logs as files, results as params.json.

Benchmarks that use this module need only the commands and the documented formats, so that they
also judge another checkout's package: see ``benchmarks.trust.confusion``.
"""

from __future__ import annotations

import io
import json
import multiprocessing
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robot_sysid.cli import main
from robot_sysid.records import Recording

SHAPES = ("geoms", "meshes", "materials", "textures", "lights", "cameras", "keys")
"""Elements of a model without which it compiles in no time, and has the same dynamics."""


CRASH = "Traceback (most recent call last)"
"""What standard error has of a program that crashed."""


STOPS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a benchmark."""


class Stopped(SystemExit):
    """A signal has ended the benchmark, whose exit code is that of a process it kills."""


@contextmanager
def end_on_signals() -> Iterator[None]:
    """Have signals that arrive in the block end the benchmark and its processes, whatever catches
    them there: a command turns an interruption into an exit code, which is no answer to a log.

    Outside of the main thread nothing is changed, and signals that are ignored stay so.
    """
    codes: list[int] = []

    def stop(number: int, frame: Any) -> None:
        codes.append(128 + number)
        for process in multiprocessing.active_children():
            process.terminate()
        raise Stopped(codes[0])

    previous = {}
    is_main = threading.current_thread() is threading.main_thread()
    for number in STOPS if is_main else ():
        if signal.getsignal(number) is not signal.SIG_IGN:
            previous[number] = signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        if codes:
            raise Stopped(codes[0])


def run_command(*words: str | Path) -> tuple[int, str, str]:
    """Return (exit code, standard output, standard error) of a command, run in this process.

    A crash has a traceback in its standard error, as in a process of its own. A signal ends the
    benchmark.
    """
    output = io.StringIO()
    messages = io.StringIO()
    with end_on_signals(), redirect_stdout(output), redirect_stderr(messages):
        try:
            code = main([str(word) for word in words])
        except Stopped:
            raise
        except SystemExit as end:
            code = int(end.code or 0)
        except Exception:
            traceback.print_exc()
            code = 1
    return code, output.getvalue(), messages.getvalue()


def model_text(path: Path, edit: Callable[[Any], None] | None = None) -> str:
    """Return a model file without shapes, its ``MjSpec`` changed by ``edit``, as MJCF."""
    spec = mujoco.MjSpec.from_file(str(path))
    for elements in SHAPES:
        for element in list(getattr(spec, elements)):
            spec.delete(element)
    if edit is not None:
        edit(spec)
    spec.compile()
    return str(spec.to_xml())


@cache
def bare_model_text(path: Path) -> str:
    """Return a model file without shapes as MJCF."""
    return model_text(path)


def write_log(path: Path, joint_names: Sequence[str], log: Recording) -> None:
    """Write a log as CSV, its columns named after joints."""
    titles = ["time"]
    columns = [log.time[:, None]]
    for quantity in ("q", "qd", "tau"):
        values = getattr(log, quantity)
        if values is not None:
            titles += [f"{quantity}_{j}" for j in joint_names]
            columns.append(values)
    header = ",".join(titles)
    rows = np.concatenate(columns, axis=1)
    np.savetxt(path, rows, "%.9g", ",", header=header, comments="")


def identify_logs(
    folder: Path, model: Path, logs: Sequence[Path], *options: str
) -> tuple[dict[str, Any] | None, str]:
    """Return (content of params.json, what was printed) of logs; None where they are refused."""
    results = folder / "results"
    words = ("identify", model, *logs, "--output-dir", results, *options)
    _, output, messages = run_command(*words)
    path = results / "params.json"
    answer = json.loads(path.read_text()) if path.exists() else None
    path.unlink(missing_ok=True)
    return answer, output + messages


def number(value: float | None) -> float:
    """Return a number of params.json, where null is one that is not finite."""
    return float("nan") if value is None else float(value)
