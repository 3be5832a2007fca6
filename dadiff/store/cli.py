"""`dadiff-cache`: list, verify and prune what the cache holds."""

from __future__ import annotations

import argparse
import shutil
from collections import Counter
from pathlib import Path

from dadiff.commands import reported
from dadiff.errors import StoreError
from dadiff.memory import in_words
from dadiff.store.cache import Cache, Entry, damage
from dadiff.store.folder import is_store
from dadiff.store.results import Results
from dadiff.store.sweeps import Sweeps
from dadiff.terminal import plain_table, text


def users(output_dir: Path) -> Counter[tuple[str, str]]:
    """(kind, key) -> how many stored runs were made with this entry."""
    return Counter(link for run in Results(output_dir) for link in run.record.links.items())


def list_entries(output_dir: Path) -> str:
    """A table: kind, key, size, state, number of runs that were made with it."""
    counts, entries = users(output_dir), list(Cache(output_dir).entries())
    table = plain_table("kind", "key", "size", "state", "runs")
    table.columns[2].justify = table.columns[4].justify = "right"
    for entry in entries:
        table.add_row(entry.kind, entry.key, in_words(entry.size), entry.state, str(counts[entry.kind, entry.key]))
    table.add_row("total", "", in_words(sum(entry.size for entry in entries)), "", "")
    return text(table)


def verify(output_dir: Path) -> list[str]:
    """One line a damaged or misplaced entry or run; empty if every checksum holds."""
    entries = (entry for entry in Cache(output_dir).entries() if entry.state in ("whole", "foreign"))
    damaged = ((entry, damage(entry.folder)) for entry in entries)
    lines = [f"{entry.kind} {entry.key}: {'; '.join(problems)}" for entry, problems in damaged if problems]
    return lines + [f"run {key}: {'; '.join(problems)}" for key, problems in Results(output_dir).damaged()]


def prune(output_dir: Path, *, dry_run: bool) -> list[str]:
    """Remove what no stored run was made with, what is damaged and what was left half built.

    Only what carries a manifest of its kind and key is touched, and links are not followed.

    Raises:
        StoreError: where no store of ours is; while something is being worked on, which may need what no stored run
            needs yet.
    """
    if not is_store(output_dir):
        raise StoreError(f"{output_dir}: is no output folder of dadiff (it has no store.json); nothing is removed")
    _check_quiet(output_dir)
    counts, lines = users(output_dir), []
    for entry in Cache(output_dir).entries():
        if entry.state == "whole" and counts[entry.kind, entry.key]:
            continue
        if entry.state == "foreign":
            lines.append(f"left alone {_line(entry, 0)}: without a manifest of its kind and key")
            continue
        lines.append(f"{'would remove' if dry_run else 'removed'} {_line(entry, 0)}")
        if not dry_run:
            shutil.rmtree(entry.folder)
    return lines


def _check_quiet(output_dir: Path) -> None:
    sweeps = Sweeps(output_dir)
    if running := [name for name in sweeps.names() if sweeps.is_running(name)]:
        raise StoreError(f"{output_dir}: sweep {running[0]} is being run; prune when it has ended")
    if working := Results(output_dir).working_keys():
        raise StoreError(f"{output_dir}: {len(working)} runs are being worked on; prune when they have ended")
    if building := [entry for entry in Cache(output_dir).entries() if entry.state == "building"]:
        raise StoreError(
            f"{output_dir}: {building[0].kind} {building[0].key} is being built; prune when that has ended"
        )


def _line(entry: Entry, count: int) -> str:
    return f"{entry.kind:<10} {entry.key:<16} {in_words(entry.size):>9}  {entry.state:<8}  {count}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("dadiff-cache", description="Cached data sets, recordings and trained denoisers.")
    parser.add_argument("action", choices=["list", "verify", "prune"])
    parser.add_argument("--output-dir", type=Path, default=Path("outputs"), help="where results lie (outputs)")
    parser.add_argument("--dry-run", action="store_true", help="prune: only say what would be removed")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """The command line; returns its exit code, 1 if `verify` found damage."""
    given = _parser().parse_args(arguments)
    return reported("dadiff-cache", lambda: _act(given.action, given.output_dir, given.dry_run))


def _act(action: str, output_dir: Path, dry_run: bool) -> int:
    if action == "list":
        lines, code = [list_entries(output_dir)], 0
    elif action == "verify":
        damaged = verify(output_dir)
        lines, code = damaged or ["every entry agrees with its checksums"], int(bool(damaged))
    else:
        lines, code = prune(output_dir, dry_run=dry_run) or ["nothing to remove"], 0
    print("\n".join(lines))
    return code
