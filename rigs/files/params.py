"""The rows of a params.json by what has them."""

from robot_sysid.records.quantities import CURVED, FILE

OF_FILES = (FILE, CURVED)


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
