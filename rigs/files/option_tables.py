"""The option tables of the pages, made from the records that the command line is made from.

    python -m rigs.files.option_tables

writes them anew. A table stands between ``<!-- options: NAME -->`` and ``<!-- end -->``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from rigs.files.command_line import COMMANDS
from rigs.files.places import ROOT
from robot_sysid.commands import motors
from robot_sysid.commands.arguments import CONSOLE, argument_settings, default_text
from robot_sysid.config import (
    CardOptions,
    MotorOptions,
    OutputOptions,
    PayloadOptions,
    SelfTestConfig,
)
from robot_sysid.estimate.options import EstimationOptions, Priors
from robot_sysid.logs import FittedLogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.motion import AimOptions, ExcitationOptions, LimitOptions
from robot_sysid.records.option_fields import Option, TrajectoryOptions, options_of_all
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.wording import with_option_names

PAGES = (ROOT / "README.md", ROOT / "docs" / "options.md")
_MAIN = COMMANDS[""].main
TABLES: Mapping[str, Sequence[Option]] = {
    "model and output": options_of_all(ModelOptions, OutputOptions),
    "trajectory": options_of_all(TrajectoryOptions),
    "excitation": options_of_all(ExcitationOptions),
    "limits": options_of_all(LimitOptions),
    "measurements": options_of_all(FittedLogOptions),
    "simulated plant": options_of_all(SimulatedArmOptions),
    "estimation": options_of_all(EstimationOptions),
    "priors": options_of_all(Priors),
    "Damiao motors": options_of_all(MotorOptions),
    "main": options_of_all(*SelfTestConfig.records().values(), only=_MAIN),
    "plan for a payload": options_of_all(AimOptions),
    "payload": options_of_all(PayloadOptions),
    "cards": options_of_all(CardOptions),
    "console": CONSOLE,
    **{
        f"motors: {title}": options
        for command in motors.COMMANDS
        for title, options in command.groups.items()
        # Arguments, and what other tables list.
        if title not in ("", "arm", "limits", "how it is held")
    },
}
"""Name of a table to the options that it lists; of a group of motors' options its heading."""
_PLACE = re.compile(r"(<!-- options: (.*?) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def table(name: str) -> str:
    """Return the table of a name in ``TABLES``."""
    rows = ["| Option | Default | Meaning |", "| --- | --- | --- |"]
    for option in TABLES[name]:
        if option.is_argument:
            continue
        shown = default_text(option)
        if shown and not option.default_text:
            shown = f"`{shown}`"
        form = f"`{option.key}`" if name == "priors" else _typed_form(option)
        cells = (form, shown, _meaning(option))
        rows.append(f"| {' | '.join(cells)} |".replace("|  |", "| |"))
    return "\n".join(rows) + "\n"


def _typed_form(option: Option) -> str:
    names = argument_settings(option).get("metavar", "")
    text = names if isinstance(names, str) else " ".join(names)
    short = f", `{option.short}`" if option.short else ""
    return f"`{f'{option.flag} {text}'.strip()}`{short}"


def _meaning(option: Option) -> str:
    text = with_option_names(option.help[0].upper() + option.help[1:])
    return (f"{text} [{option.unit}]" if option.unit else text).replace("|", "\\|")


def with_tables(text: str) -> str:
    """Return a page with all its tables as the records say; an unknown name is a KeyError."""
    return _PLACE.sub(lambda match: match[1] + table(match[2]) + match[4], text)


def tables_in(text: str) -> list[str]:
    """Return the names of the tables of a page, in their order."""
    return [match[2] for match in _PLACE.finditer(text)]


def main() -> None:
    """Write the tables of the pages anew."""
    for path in PAGES:
        path.write_text(with_tables(path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
