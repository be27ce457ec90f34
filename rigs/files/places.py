"""Where things are: the checkout, its example, and the public arms and logs beside it."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "kinova"
GUESS = EXAMPLE / "model" / "kinova_fullinertia_guess.xml"
TRUTH = EXAMPLE / "model" / "kinova_fullinertia.xml"
# Public models and logs lie beside the checkout where they are at hand; tests skip without them.
SHARED = ROOT.parent / "shared"
MODELS = SHARED / "models"
DATA = SHARED / "data"
