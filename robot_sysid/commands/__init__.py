"""The subcommands, and the console that all of them print on."""

PROGRAM = "robot-sysid"
COMMANDS = {
    **dict.fromkeys(("plan", "identify", "payload"), "run"),
    **{name: name for name in ("log", "report", "motors", "example")},
}
"""Subcommand to its module; any other first word is a model file."""
