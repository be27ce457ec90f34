"""The option tables of the pages, made from the records that the command line is made from.

    python -m rigs.option_tables

writes them anew. A table stands between ``<!-- options: NAME -->`` and ``<!-- end -->``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from rigs.command_line import COMMANDS
from rigs.places import ROOT
from robot_sysid.commands import ConsoleOptions
from robot_sysid.commands.arguments import default_text
from robot_sysid.commands.motors import PlayChoices
from robot_sysid.commands.motors.mapping import MapOptions
from robot_sysid.commands.motors.setup import MonitorOptions, SetupOptions
from robot_sysid.config import (
    MotorOptions,
    OutputOptions,
    PayloadOptions,
    SelfTestConfig,
)
from robot_sysid.damiao.adapters import BusAddress
from robot_sysid.damiao.protocol import BusTiming
from robot_sysid.damiao.settings import Permissions, PlaySettings, RecordingOptions
from robot_sysid.estimate.options import EstimationOptions, Priors
from robot_sysid.logs import FittedLogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.motion import AimOptions, ExcitationOptions, LimitOptions
from robot_sysid.records.option_fields import Option, TrajectoryOptions, options_of
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.wording import with_option_names

PAGES = (ROOT / "README.md", ROOT / "docs" / "options.md")
TABLES: Mapping[str, Sequence[type]] = {
    "model and output": (ModelOptions, OutputOptions),
    "trajectory": (TrajectoryOptions,),
    "excitation": (ExcitationOptions,),
    "limits": (LimitOptions,),
    "measurements": (FittedLogOptions,),
    "simulated plant": (SimulatedArmOptions,),
    "estimation": (EstimationOptions,),
    "priors": (Priors,),
    "Damiao motors": (MotorOptions,),
    "main": tuple(SelfTestConfig.records().values()),
    "plan for a payload": (AimOptions,),
    "console": (ConsoleOptions,),
    "payload": (PayloadOptions,),
    "motors: bus": (BusAddress, BusTiming),
    "motors: motion and limits": (PlaySettings,),
    "motors: what to allow": (Permissions,),
    "motors: recording": (RecordingOptions,),
    "motors: setup": (SetupOptions,),
    "motors: monitor": (MonitorOptions,),
    "motors: map": (MapOptions,),
    "motors: play and simulate": (PlayChoices,),
}
"""Name of a table to the records whose options it lists; of "main" only the main options."""
_PLACE = re.compile(r"(<!-- options: (.*?) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def table(name: str) -> str:
    """Return the table of a name in ``TABLES``."""
    rows = ["| Option | Default | Meaning |", "| --- | --- | --- |"]
    for record in TABLES[name]:
        for field, option in options_of(record).items():
            is_main = name != "main" or option.key in COMMANDS[""].main
            if option.is_argument or not is_main:
                continue
            shown = default_text(option)
            if shown and not option.default_text:
                shown = f"`{shown}`"
            form = f"`{field}`" if name == "priors" else _typed_form(option)
            cells = (form, shown, _meaning(option))
            rows.append(f"| {' | '.join(cells)} |".replace("|  |", "| |"))
    return "\n".join(rows) + "\n"


def _typed_form(option: Option) -> str:
    text = option.key.upper()
    if isinstance(option.default, bool):
        text = ""
    elif option.metavar:
        names = option.metavar
        text = names if isinstance(names, str) else " ".join(names)
    elif option.choices:
        text = "{" + ",".join(option.choices) + "}"
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
