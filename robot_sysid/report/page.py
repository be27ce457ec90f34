"""The page: which parts in which order, and their HTML.

Names from models and logs are text that somebody else wrote: all of it is escaped, and the page
itself forbids scripts and anything from elsewhere.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from robot_sysid import __version__
from robot_sysid.report.drawing import inline
from robot_sysid.report.elements import Figure, Section
from robot_sysid.report.runs import PAYLOAD, Run
from robot_sysid.report.sections import comparison, errors, payload, verdict
from robot_sysid.report.sections.excitation import excitation
from robot_sysid.report.sections.friction import friction
from robot_sysid.report.sections.parameters import parameters, visibility
from robot_sysid.report.sections.picture import picture
from robot_sysid.report.sections.torques import residuals, torques

_TEMPLATE = Path(__file__).with_name("template.html")
_WORDY = 24
Maker = Callable[[Run], "Section | None"]


def sections_of(run: Run, mesh_dir: Path | None = None) -> list[Section]:
    """Return all parts of a run's page."""
    weighed = (payload.card, payload.scatter) if run.kind == PAYLOAD else ()
    makers: tuple[Maker, ...] = (
        *(verdict.verdict, *weighed, parameters, visibility, torques, residuals, friction),
        *(excitation, errors.errors, errors.rollout),
        partial(picture, mesh_dir=mesh_dir),
        verdict.next_steps,
    )
    return [each for maker in makers for each in _made(maker, run)]


def _made(maker: Callable[[Any], Section | None], run: Run | Sequence[Run]) -> Iterator[Section]:
    """Yield a part; where the result file holds something odd, what it was in its place."""
    name = getattr(maker, "__name__", "picture")
    try:
        section = maker(run)
    except (ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError) as error:
        cause = f"this part cannot be shown: the result holds {type(error).__name__}: {error}"
        section = Section(name, name.capitalize().replace("_", " "), missing=(cause,))
    if section is not None:
        yield section


def sections_comparing(runs: Sequence[Run]) -> list[Section]:
    """Return all parts of a page about several runs."""
    makers = (
        *(comparison.verdicts, comparison.compared, comparison.friction_beside),
        comparison.predicted,
    )
    return [each for maker in makers for each in _made(maker, runs)]


def html(title: str, sections: Sequence[Section]) -> str:
    """Return a page that opens without anything else."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters.update(prose=_prose, drawing=_drawing, wordy=_wordy)
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    return template.render(title=title, sections=sections, version=__version__) + "\n"


def _prose(text: str) -> str:
    """Return a sentence with what stands between backticks as code."""
    from markupsafe import Markup, escape

    parts = [str(escape(part)) for part in text.split("`")]
    if len(parts) % 2 == 0:
        return Markup("`".join(parts))
    return Markup("".join(f"<code>{p}</code>" if k % 2 else p for k, p in enumerate(parts)))


def _drawing(figure: Figure) -> str:
    from markupsafe import Markup, escape

    if figure.png:
        data = base64.b64encode(figure.png).decode("ascii")
        alternative = escape(figure.caption)
        return Markup(f'<img alt="{alternative}" src="data:image/png;base64,{data}">')
    return Markup(inline(figure))


def _wordy(cell: str) -> str:
    """Return the class of a cell that holds words."""
    from markupsafe import Markup

    return Markup(' class="words"') if len(cell) > _WORDY else ""
