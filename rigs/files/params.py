"""The rows of a params.json by what has them.

Its words are those of docs/formats.md and not the package's constants, because benchmarks also
judge other checkouts of the package, which may have these elsewhere.
"""

OF_FILES = ("file", "curved file")
"""Sources of the numbers of written models."""


def rows(content):
    """(body or joint, name) to each identified row."""
    found = [row for row in content["quantities"] if row["source"] not in OF_FILES]
    return {(row["of"], row["name"]): row for row in found}


def motors(content):
    """The motors that turn several joints."""
    owners = [
        row["of"] for row in content["quantities"] if row["source"] not in OF_FILES
    ]
    return list(dict.fromkeys(owner for owner in owners if "+" in owner))
