"""Arguments that benchmarks of played motions share: how an arm is played, and with which model."""

from __future__ import annotations

import argparse
from typing import Any

from rigs.motors.sound_runs import RunOptions

MODELS = {"both": (True, False), "with": (True,), "without": (False,)}
"""Choice of ``--model`` to whether the player has the model, run after run."""


def add_run_arguments(parser: argparse.ArgumentParser, default_model: str) -> None:
    """Add how an arm is played, and how many processes play."""
    add_model_argument(parser, default_model)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--rate", type=float)
    parser.add_argument("--kp", type=float)
    parser.add_argument("--seed", type=int, default=0)


def add_model_argument(parser: argparse.ArgumentParser, default_model: str) -> None:
    """Add whether the player has the model, and how many processes play."""
    parser.add_argument("--model", choices=MODELS, default=default_model)
    parser.add_argument("--jobs", type=int, default=2)


def run_options(
    arguments: argparse.Namespace, arm: str, has_model: bool, **others: Any
) -> RunOptions:
    """Return how an arm is played by parsed arguments; ``others`` are fields of the record."""
    return RunOptions(
        arm=arm,
        seed=arguments.seed,
        speed=arguments.speed,
        rate=arguments.rate,
        kp=arguments.kp,
        has_model=has_model,
        **others,
    )
