"""`dadiff`, but the first process that comes to a given place is killed there, once.

FAULT is "module:function:before" or "...:after", FAULT_TOKEN a file that says that it has happened. Jobs run this
module's top level again before they start, so that a place may lie in the launcher or in any job.
"""

from __future__ import annotations

import functools
import importlib
import os
import signal


def arm(fault: str, token: str) -> None:
    """Put the trap in place."""
    module_name, path, when = fault.split(":")
    *owners, name = path.split(".")
    owner = functools.reduce(getattr, owners, importlib.import_module(module_name))
    original = getattr(owner, name)

    @functools.wraps(original)
    def trapped(*arguments, **options):
        if when == "before":
            die_once(token)
        result = original(*arguments, **options)
        if when == "after":
            die_once(token)
        return result

    setattr(owner, name, trapped)


def die_once(token: str) -> None:
    """SIGKILL for the first that comes."""
    try:
        os.close(os.open(token, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return
    os.kill(os.getpid(), signal.SIGKILL)


if os.environ.get("FAULT"):
    arm(os.environ["FAULT"], os.environ["FAULT_TOKEN"])

if __name__ == "__main__":
    from dadiff.cli import main

    main()
