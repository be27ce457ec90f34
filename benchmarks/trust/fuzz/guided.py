"""The fuzz targets under atheris, whose bytes replace the random generator."""

from __future__ import annotations

import importlib
import sys
import tempfile
from pathlib import Path
from random import Random

from benchmarks.trust.fuzz.harness import Watch


class BytesRandom(Random):
    """A random generator that takes its numbers from given bytes, then zeros."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0
        super().__init__(0)

    def getrandbits(self, k: int) -> int:
        """Return the next k bits."""
        count = (k + 7) // 8
        piece = self._data[self._at : self._at + count].ljust(count, b"\0")
        self._at += count
        return int.from_bytes(piece, "little") >> (8 * count - k)

    def random(self) -> float:
        """Return a number from 0 to 1 made of the next two bytes."""
        return self.getrandbits(16) / 2.0**16


def fuzz(name: str, seconds: int, seed: int) -> int:
    """Run a target until the time is over; print each new kind of finding with its bytes."""
    import atheris

    with atheris.instrument_imports(include=["robot_sysid"]):
        target = importlib.import_module(f"benchmarks.trust.fuzz.{name}")
    target.case(Random(seed))  # what all inputs are made from is made once
    folder = Path(tempfile.mkdtemp())
    watch = Watch(folder)
    reported = set()

    def one(data: bytes) -> None:
        """Use one input; print its finding where that is new."""
        verdict, text = watch.outcome(target, target.case(BytesRandom(data)))
        if verdict not in ("result", "refused") and verdict not in reported:
            reported.add(verdict)
            print(f"\n{name}: {verdict}\n{data.hex()}\n{text}", flush=True)

    limits = [f"-max_total_time={seconds}", f"-seed={seed or 1}", "-max_len=4096"]
    atheris.Setup(
        [sys.argv[0], *limits, "-print_final_stats=1", f"-artifact_prefix={folder}/"],
        one,
    )
    atheris.Fuzz()
    return 0
