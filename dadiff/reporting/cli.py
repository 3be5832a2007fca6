"""`dadiff-report`: from a stored sweep to a folder with the report."""

from __future__ import annotations

import argparse
import logging
import shlex
import tempfile
from pathlib import Path
from typing import Any

from dadiff.commands import reported
from dadiff.config.trust import trust
from dadiff.store import Results, Sweeps
from dadiff.tracking import Tracking


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="dadiff-report", description="Write the report of stored sweeps.")
    parser.add_argument("sweep", nargs="+", help="name of a sweep, or several to report as one")
    parser.add_argument("--output-dir", type=Path, default=Path("outputs"), help="where results lie (default: outputs)")
    parser.add_argument(
        "--definition", help="which report to write: a name, or a yaml file (default: the one made for the sweep)"
    )
    parser.add_argument(
        "--against",
        help="another sweep, or the folder of a report: each number within or outside of its interval there",
    )
    parser.add_argument(
        "--components", default="", help="packages besides dadiff whose figures a definition may name: mylab,other"
    )
    parser.add_argument("--out", type=Path, help="folder to write (default: <output-dir>/reports/<sweep>)")
    parser.add_argument(
        "--publish", type=Path, help="folder to copy numbers, configurations and SVG figures to, for version control"
    )
    parser.add_argument(
        "--tracking-uri", help="read an MLflow parent run or experiment of that name from there instead"
    )
    parser.add_argument("--log", action="store_true", help="add the report to the sweep in MLflow")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Write one report; 0 if it was written."""
    logging.basicConfig(format="%(message)s")
    options = _parser().parse_args(arguments)
    trust(options.components.split(","))
    return reported("dadiff-report", lambda: print("\n".join(said(write(options), options))))


def said(index: Path, options: argparse.Namespace) -> list[str]:
    """What was found, in the report's own sentences, how it compares, and where it lies."""
    from dadiff.reporting import published, story
    from dadiff.reporting.claims import read_ledger
    from dadiff.reporting.compare import compared
    from dadiff.reporting.definitions import FOLDER

    content = published.read(index.parent)
    lines = story.sentences(content, story.ledger(content, read_ledger(FOLDER / "claims.yaml")))
    if options.against:
        lines += compared(content, _other(options), index.with_name("against.csv"))
    return [*lines, f"report: {index}"]


def _other(options: argparse.Namespace) -> dict[str, Any]:
    """The content of the report to compare with: of a folder, else of a sweep, whose report is written."""
    from dadiff.reporting import published

    if (Path(options.against) / "report.json").is_file():
        return published.read(Path(options.against))
    with tempfile.TemporaryDirectory() as folder:
        asked = {"sweep": [options.against], "out": Path(folder), "publish": None}
        _write(argparse.Namespace(**{**vars(options), **asked}), options.output_dir)
        return published.read(Path(folder))


def write(options: argparse.Namespace) -> Path:
    """Write the report of what lies in the results folder, and add it to MLflow if asked; or of what MLflow holds."""
    if options.tracking_uri is None:
        index = _write(options, options.output_dir)
        for name in options.sweep if options.log else []:
            _log(options.output_dir, name)
        return index
    from dadiff.tracking.download import download

    with tempfile.TemporaryDirectory() as folder:
        for name in options.sweep:
            download(options.tracking_uri, name, Path(folder))
        return _write(options, Path(folder))


def _log(output_dir: Path, name: str) -> None:
    """Mirror the sweep with its report into the store that its runs are in."""
    results, cells = Results(output_dir), Sweeps(output_dir).read(name).cells
    stored = [results.read(cell.key) for cell in cells if results.is_done(cell.key)]
    for run in stored[:1]:
        Tracking.of(run.record.config, output_dir).log_sweep(output_dir, name)


def _write(options: argparse.Namespace, source: Path) -> Path:
    """Read, gather and render; imports are late so that help answers at once."""
    from dadiff.reporting.aggregation import Evidence
    from dadiff.reporting.claims import read_ledger
    from dadiff.reporting.definitions import FOLDER, for_sweep, load
    from dadiff.reporting.render import publish, render
    from dadiff.reporting.report import build
    from dadiff.reporting.sources import read_sweeps

    sweep = read_sweeps(source, options.sweep)
    definition = load(options.definition) if options.definition else for_sweep(sweep.name)
    report = build(definition, Evidence(sweep), read_ledger(FOLDER / "claims.yaml"), _again(options, definition.name))
    index = render(report, options.out or options.output_dir / "reports" / sweep.name)
    if options.publish:
        publish(index.parent, options.publish)
    return index


def _again(options: argparse.Namespace, definition: str) -> str:
    """The command that writes the report again from the same results."""
    from dadiff.outside import without_passwords

    command = ["dadiff-report", *options.sweep, "--definition", options.definition or definition]
    if options.components:
        command += ["--components", options.components]
    if options.output_dir != Path("outputs"):
        command += ["--output-dir", str(options.output_dir)]
    if options.tracking_uri is not None:
        command += ["--tracking-uri", without_passwords(options.tracking_uri)]
    return shlex.join(command)


if __name__ == "__main__":
    raise SystemExit(main())
