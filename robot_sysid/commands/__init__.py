"""One file per subcommand, and the console that all of them print on."""

PROGRAM = "robot-sysid"
COMMANDS = ("plan", "identify", "arm", "payload", "log", "report", "motors", "example")
"""Subcommands, each a module of its name (but ``arm``, an older name of ``identify --links``); any
other first word is a model file."""
