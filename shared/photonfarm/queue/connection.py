"""Connections to Redis, whose passwords appear in no message, and its errors as ours."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

import redis
from redis import Redis
from redis.backoff import ExponentialBackoff, NoBackoff
from redis.exceptions import ClusterCrossSlotError, MovedError, NoPermissionError
from redis.retry import Retry

from photonfarm.core.errors import QueueError

SOCKET_TIMEOUT_S = 30

RETRY = Retry(ExponentialBackoff(cap=0.5, base=0.1), 3)
"""Three tries within a second, for short faults; the supervisor waits out longer outages."""

PASSWORD_VARIABLE = "PHOTONFARM_REDIS_PASSWORD_FILE"  # noqa: S105 - the name of a variable
USER = "photonfarm"
"""The user of a URL without a name, if the password comes from a file."""


class RefusedError(QueueError):
    """A Redis refuses what it would refuse again."""


@contextlib.contextmanager
def redis_errors(what: str) -> Iterator[None]:
    """Turn an error of Redis while it was `what` ("asked") into a QueueError, or a RefusedError if it would recur."""
    try:
        yield
    except redis.RedisError as error:
        raise queue_error(error, what) from error


def queue_error(error: redis.RedisError, what: str = "used") -> QueueError:
    """The QueueError for an error of Redis, as in `redis_errors`."""
    said = str(error).rstrip(".")
    if isinstance(error, redis.AuthenticationError):
        return RefusedError(f"Redis no longer lets this process in: {said}; check its user and password")
    if isinstance(error, NoPermissionError):
        return RefusedError(
            f"Redis refuses its user a command or key: {said}; `docker/redis.sh` shows the permissions that are needed"
        )
    if isinstance(error, MovedError | ClusterCrossSlotError):
        return RefusedError(f"Redis is a cluster: {said}; the queue needs one server, without cluster mode")
    return QueueError(f"Redis failed while it was {what}: {said}")


def connect(url: str, *, only_s: float | None = None) -> Redis:
    """A connection that has answered once; raises QueueError with a sentence if there is no Redis or it refuses us.

    With `only_s`, each answer is awaited once, for so many seconds: for commands that a user waits for.
    """
    shown = without_password(url)
    retry = RETRY if only_s is None else Retry(NoBackoff(), 0)
    try:
        # redis://:a@b@host and redis://:a/b@host: a password that is not percent-encoded
        if url.count("@") > 1 or ("@" in url and "@" not in urlsplit(url).netloc):
            raise ValueError
        connection = Redis.from_url(
            url, socket_timeout=only_s or SOCKET_TIMEOUT_S, socket_connect_timeout=5, retry=retry
        )
    except (ValueError, TypeError):  # their text may hold a piece of the password
        raise QueueError(
            f"no Redis at {shown}: a URL is redis://[user:password@]host:port/0, rediss://… or unix:///path, "
            "and in a name or password every one of / ? # @ : % is written as %2F %3F %23 %40 %3A %25"
        ) from None
    try:
        connection.ping()
    except redis.AuthenticationError as error:
        raise QueueError(f"the Redis at {shown} {_why_refused(str(error).rstrip('.'), url)}") from error
    except (redis.RedisError, OSError) as error:
        answers = isinstance(error, redis.BusyLoadingError | redis.ResponseError)
        remedy = "" if answers else "; `photonfarm redis` starts one"
        raise QueueError(f"no Redis at {shown}: {str(error).rstrip('.')}{remedy}") from error
    return connection


def _why_refused(reason: str, url: str) -> str:
    """Why a login failed, and the remedy."""
    if not has_password(url):
        return (
            f"wants a password ({reason}); put it into a file that {PASSWORD_VARIABLE} names. That logs in as the "
            f"user {USER}, and with redis://default@host as the one that `requirepass` is for"
        )
    user = urlsplit(url).username or "default"
    other = "; a Redis with `requirepass` has the user default: redis://default@host" if user == USER else ""
    return (
        f"does not let in the user {user} ({reason}); check the password, in the URL or in a {PASSWORD_VARIABLE}{other}"
    )


def without_password(url: str) -> str:
    """A URL for messages: without name, password and options, also where it is not a proper URL."""
    scheme, separator, rest = url.partition("://") if "://" in url else ("", "", url)
    before_options = rest.partition("?")[0]
    if "@" in rest and "@" not in before_options:  # redis://:a?b@host, redis://host?password=a@b
        return f"{scheme}{separator}…"
    return f"{scheme}{separator}{before_options.rpartition('@')[2]}"


def has_password(url: str) -> bool:
    """Whether a URL holds a password, also where it is not a proper URL."""
    rest = url.partition("://")[2] or url
    return ":" in rest.rpartition("@")[0] or "password=" in unquote(rest.partition("?")[2])


def add_password(file: Path | None, url: str) -> str:
    """The URL of a TCP port with the password from a file, unless the URL has one; raises QueueError.

    Docker stores secrets in files; unlike variables, they do not show in `docker inspect` and are not inherited.
    """
    parts = urlsplit(url)
    if file is None or parts.scheme not in ("redis", "rediss") or ":" in parts.netloc.rpartition("@")[0]:
        return url
    try:
        password = file.read_text().strip()
    except OSError as error:
        raise QueueError(f"{file}: the Redis password cannot be read: {error.strerror}") from error
    user, _, host = parts.netloc.rpartition("@")
    return parts._replace(netloc=f"{user or USER}:{quote(password, safe='')}@{host}").geturl()
