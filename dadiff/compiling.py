"""Machine code of inner loops, by numba. It loads slowly: import compiled modules inside what calls them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

logger = logging.getLogger(__name__)


def compiled(function: Function) -> Function:
    """Machine code of a function, made at its first call; kept for later processes where there is a place for it."""
    try:
        return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
    except RuntimeError as error:  # numba's word for: no writable folder
        logger.info("%s; it is compiled anew in each process, set NUMBA_CACHE_DIR to a folder to avoid that", error)
        return cast(Function, numba.njit(nogil=True, error_model="numpy")(function))
