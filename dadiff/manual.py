"""What `dadiff --help` prints: every group with a line for each of its choices, from the first comment of its yaml."""

from __future__ import annotations

import shutil
import textwrap
from pathlib import Path

from dadiff.config.settings import GROUPS
from dadiff.folders import shipped

USAGE = """\
dadiff: dynamics-aware diffusion for planning and control

  dadiff task=lqr projector=known                              one run: one choice in each group, group.key=value
  dadiff -m projector=none,known,hankel_lowrank seed=0,1,2     a sweep: every combination
  dadiff +sweeps=lqr_quick                                     a sweep that is written down; dry_run=true only says it
  dadiff --cfg job projector=known                             the configuration of a run
  dadiff-report lqr_quick                                      the report of a sweep
"""
GAP, NARROWEST = 2, 24


def text(own: str | None = None) -> str:
    """The help, as wide as the terminal.

    Args:
        own: a folder with further choices, as `--config-dir` names it.
    """
    width = shutil.get_terminal_size().columns
    usage = "\n".join(_usage(line, width) for line in USAGE.splitlines())
    groups = [*GROUPS, "preset", "sweeps", "hydra/launcher"]
    return "\n".join([usage, "", *(part for group in groups if (part := _group(group, own, width)))])


def _usage(line: str, width: int) -> str:
    """A command and what it does; on two lines where the terminal is narrow."""
    command, _, meaning = line.partition("     ")
    return line if len(line) <= width else f"{command}\n      {meaning.strip()}"


def _group(group: str, own: str | None, width: int) -> str:
    folders = [shipped("conf"), *([Path(own)] if own else [])]
    files = {file.stem: file for folder in folders for file in sorted((folder / group).glob("*.yaml"))}
    indent = 2 + max(map(len, files), default=0) + GAP
    choices = [_choice(name, said(file), indent, width) for name, file in files.items()]
    return "\n".join([f"{group}:", *choices]) if files else ""


def _choice(name: str, meaning: str, indent: int, width: int) -> str:
    """`name  meaning`, wrapped at words."""
    head = f"  {name}".ljust(indent)
    return textwrap.fill(
        meaning, width=max(width, indent + NARROWEST), initial_indent=head, subsequent_indent=" " * indent,
        break_long_words=False, break_on_hyphens=False,
    ) or head.rstrip()  # fmt: skip


def said(file: Path) -> str:
    """The first comment of a yaml that is no directive; empty if it opens without one."""
    comments = [line[1:].strip() for line in file.read_text("utf-8").splitlines() if line.startswith("#")]
    return next((comment for comment in comments if not comment.startswith("@")), "")
