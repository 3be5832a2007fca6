"""The command line `dadiff-plan`: plans from a planner's file."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dadiff.commands import reported
from dadiff.errors import DataError
from dadiff.outside import yaml_of

DESCRIPTION = """Plans of a trained planner, for one condition.

The fields of the condition are given by name, numbers separated by commas:
  dadiff-plan robot.zip --x-init 0,0,0,0 --target 1,2,0,0 --samples 4 --output plan.csv --plot plan.png
or, where it has more than numbers, in a yaml file with the same names:
  dadiff-plan robot.zip --condition case.yaml --animate plan.gif
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; an error that the user can mend becomes one line and exit code 1."""
    options, rest = _parser().parse_known_args(arguments)
    if code := reported("dadiff-plan", lambda: _plan(options, _fields(rest))):
        raise SystemExit(code)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "dadiff-plan", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("planner", type=Path, help="a file that planner.save(...) wrote, or a run's folder")
    parser.add_argument("--condition", type=Path, help="a yaml file with the fields of the condition")
    parser.add_argument("--samples", type=int, default=1, help="number of plans (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise (default: 0)")
    parser.add_argument("--output", type=Path, help="write the plans to .csv or .npz (default: print the table)")
    parser.add_argument("--plot", type=Path, help="draw the plans into this file")
    parser.add_argument("--animate", type=Path, help="film robots that execute the plans into this .gif or .mp4")
    parser.add_argument("--components", default="", help="packages besides dadiff that the file may name, by commas")
    return parser


def _plan(options: argparse.Namespace, fields: Mapping[str, Any]) -> None:
    from dadiff.planning.planner import Planner

    if options.samples < 1:
        raise DataError(f"--samples is {options.samples}; it must be at least 1")
    planner = Planner.load(options.planner, [name for name in options.components.split(",") if name])
    given = {**(_from_yaml(options.condition) if options.condition else {}), **fields}
    environment = planner.task.environment(planner.system, given)
    plans = planner.plan(environment, samples=options.samples, seed=options.seed)
    if plans.diverged_at is not None:
        raise DataError(f"{options.planner}: the plans diverged at step {plans.diverged_at}; nothing is written")
    if options.plot:
        from dadiff.planning.drawing import draw

        print(f"drawn in {draw(plans, options.plot)}")
    if options.animate:
        from dadiff.planning.animation import animate

        print(f"filmed in {animate(planner, plans, environment, options.animate)}")
    if options.output:
        print(f"written to {plans.save(options.output)}")
    elif not (options.plot or options.animate):
        print(plans.table().to_string(index=False, float_format=lambda value: f"{value:.5g}"))


def _fields(rest: Sequence[str]) -> dict[str, Any]:
    """`--x-init 0,0 --target=1,2` as fields.

    Raises:
        DataError: for what is no name with a value.
    """
    words = [part for word in rest for part in (word.split("=", 1) if word.startswith("--") else [word])]
    if len(words) % 2 or not all(name.startswith("--") for name in words[::2]):
        raise DataError(f"arguments: {' '.join(rest)}: expected the fields of the condition as --name numbers")
    named = zip(words[::2], words[1::2], strict=True)
    return {name.removeprefix("--").replace("-", "_"): _numbers(name, value) for name, value in named}


def _numbers(name: str, value: str) -> list[float]:
    try:
        return [float(number) for number in value.split(",")]
    except ValueError as error:
        raise DataError(f"{name} is {value!r}; expected numbers separated by commas") from error


def _from_yaml(path: Path) -> dict[str, Any]:
    content = yaml_of(path)
    if not isinstance(content, dict) or not all(isinstance(name, str) for name in content):
        raise DataError(f"{path}: expected a mapping with the fields of a condition; found {type(content).__name__}")
    return content
