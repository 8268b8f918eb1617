"""Requests to a bucket: connecting, trying again, and turning errors into those of a file system."""

from __future__ import annotations

import contextlib
import errno
import itertools
import re
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from typing import Any, TypeVar

from obstore.exceptions import BaseError, GenericError, PermissionDeniedError, UnauthenticatedError
from obstore.store import from_url

from photonfarm.core.errors import StoreError

PATIENCE_S = 60.0
"""How long a failing or unreachable server is tried again: it may be restarting."""

PAUSES_S = (0.3, 1.0, 3.0, 5.0)
"""The pauses before our new attempts, the last one repeated; the library has its own within an attempt."""

RETRIES = 1000
"""The library's attempts within a request; PATIENCE_S ends them.

It repeats neither what may have worked already, nor an answer that breaks off in the middle.
"""

LONGEST_PAUSE_S = 5.0

T = TypeVar("T")


def connect(url: str, timeout_s: float) -> Any:
    """Make the library's store; nothing is sent yet."""
    try:
        return from_url(
            url,
            client_options={
                "allow_http": True,  # where the endpoint's URL says so, as within a cluster
                "timeout": timedelta(seconds=timeout_s),
            },
            retry_config={
                "max_retries": RETRIES,
                "retry_timeout": timedelta(seconds=PATIENCE_S),
                "backoff": {
                    "init_backoff": timedelta(seconds=PAUSES_S[0]),
                    "max_backoff": timedelta(seconds=LONGEST_PAUSE_S),
                    "base": 2,
                },
            },
        )
    except (BaseError, ValueError) as error:
        raise StoreError(f"{url}: cannot be used as a store: {_first_line(error)}") from error


def patiently(action: Callable[[], T], *passing: type[Exception], times: int = 1) -> T:
    """The result of an action, tried again for PATIENCE_S while the server fails, or with one of the `passing` errors.

    It is tried at least `times` times, however long each takes, as a transfer may break off after minutes. A put that
    failed may yet have worked; the action must find that out when it is tried again.
    """
    failures: tuple[type[Exception], ...] = (GenericError, *passing)
    deadline = time.monotonic() + PATIENCE_S
    for tried, pause_s in enumerate(itertools.chain(PAUSES_S, itertools.repeat(PAUSES_S[-1])), 1):
        try:
            return action()
        except failures as error:
            if (tried >= times and time.monotonic() + pause_s > deadline) or _is_refusal(error):
                raise
        time.sleep(pause_s)
    raise AssertionError("pauses without end have ended")


def _is_refusal(error: Exception) -> bool:
    """Whether the server has refused for good (any 4xx but "too slow" and "too many requests")."""
    return isinstance(error, GenericError) and re.search(r"\b4(?!08|29)\d\d [A-Z]", _first_line(error)) is not None


@contextlib.contextmanager
def os_errors(name: str) -> Iterator[None]:
    """Turn the library's errors into those of a file system, with the name of the object."""
    try:
        yield
    except FileNotFoundError as error:
        if "<Code>NoSuchBucket</Code>" in str(error):  # else the caller would look for a missing object
            raise OSError(errno.EIO, "the bucket does not exist", name) from error
        raise FileNotFoundError(errno.ENOENT, "no such object, or no such bucket", name) from error
    except (PermissionDeniedError, UnauthenticatedError) as error:
        raise PermissionError(errno.EACCES, _reason(error), name) from error
    except BaseError as error:
        if "404 Not Found" in _first_line(error):  # the library's error for a bucket that cannot be listed
            raise FileNotFoundError(errno.ENOENT, "no such bucket", name) from error
        raise OSError(errno.EIO, _reason(error), name) from error


def _reason(error: Exception) -> str:
    """The library's error in one line, with code and message of the server's answer instead of its XML."""
    said = re.split(r"<\?xml|<Error>", _first_line(error))[0].rstrip(": ")
    answer = str(error).partition("\n\nDebug source:")[0]
    parts = [
        match[1] for tag in ("Code", "Message") if (match := re.search(f"<{tag}>(.*?)</{tag}>", answer, re.DOTALL))
    ]
    return " ".join(": ".join([said, *parts]).split())


def _first_line(error: Exception) -> str:
    """The library's error without the part for its developers."""
    return str(error).partition("\n")[0]
