"""The server of pages: GET and HEAD of what a table of routes has, POST of what a second one has, and nothing else.

It serves one machine's user, so it listens on this machine alone unless told otherwise, and answers only to names of
its own, so that no other site's page can ask it by a name that leads here. Another site may link to its first page;
what else a browser says that another site's page asks for is refused, and so is what such a page posts.
The farm's pages and the metrics have no second table.
"""

from __future__ import annotations

import errno
import json
import logging
import re
import signal
import sys
from collections.abc import Callable, Sequence
from functools import cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from photonfarm.core.errors import PhotonfarmError, StoreError
from photonfarm.core.page import STYLES

if TYPE_CHECKING:
    from photonfarm.farm.progress import FarmProgress
    from photonfarm.web.farm_pages import FarmPages
    from photonfarm.web.metrics import FarmMetrics

STATIC = Path(__file__).parent / "static"
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".js": "text/javascript; charset=utf-8",
}
PNG, JPEG, BYTES = "image/png", "image/jpeg", "application/octet-stream"
_SCENE, _ROW = "([0-9a-f]{32})", "([0-9]{1,12})"


def make_page_routes(pages: FarmPages) -> Routes:
    """The pages, what they show, and the metrics."""

    def document(make: Callable[..., Any]) -> Callable[..., Answer]:
        return lambda *groups: (JSON, json.dumps(make(*groups), allow_nan=False, default=str).encode())

    def file(path: Path) -> Callable[[], Answer]:
        return lambda: (KINDS[path.suffix], path.read_bytes())

    table: list[tuple[str, bool, Callable[..., Answer]]] = [
        ("/", False, file(STATIC / "index.html")),
        *((f"/{path.name}", False, file(path)) for path in [STYLES, *STATIC.iterdir()] if path.suffix in KINDS),
        ("/api/state", False, document(pages.state)),
        ("/api/curves", False, document(pages.curves)),
        (f"/api/wall/{_SCENE}", False, document(pages.wall)),
        (f"/api/sample/{_SCENE}/{_ROW}", False, document(lambda scene, row: pages.about(scene, int(row)))),
        (f"/sample/{_SCENE}/{_ROW}/thumbnail.jpg", True, lambda s, row: (JPEG, pages.samples(s).thumbnail(int(row)))),
        (f"/sample/{_SCENE}/{_ROW}/points", True, lambda s, row: (BYTES, pages.samples(s).points(int(row)))),
        (f"/sample/{_SCENE}/{_ROW}/photons", True, lambda s, row: (BYTES, pages.samples(s).photons(int(row)))),
        (
            f"/sample/{_SCENE}/{_ROW}/reference.png",
            False,
            lambda s, row: (PNG, pages.samples(s).picture(int(row), "reference")),
        ),
        (
            f"/sample/{_SCENE}/{_ROW}/([a-z_]{{1,20}}).png",
            True,
            lambda s, row, name: (PNG, pages.samples(s).picture(int(row), name)),
        ),
        ("/run/([0-9]{1,3})/([0-9]{1,8}).png", True, lambda run, step: (PNG, pages.prediction(int(run), int(step)))),
    ]
    routes = [(re.compile(pattern.replace(".", r"\.")), stays, make) for pattern, stays, make in table]
    return [*routes, *make_metric_routes(pages.view)]


def make_metric_routes(look: Callable[[], FarmProgress]) -> Routes:
    """The metrics of a farm, by a function that gives it as it is now."""

    @cache
    def metrics() -> FarmMetrics:
        from photonfarm.web.metrics import FarmMetrics  # whoever only looks at the pages needs no client of Prometheus

        return FarmMetrics(look)

    return [(re.compile("/metrics"), False, lambda: metrics().answer())]


IDLE_S = 30.0
"""How long a browser may leave a connection idle."""

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}

LOCAL_NAMES = ("localhost", "127.0.0.1", "[::1]")

JSON = "application/json"

Answer = tuple[str, bytes]  # its type and its content

Routes = Sequence[tuple[re.Pattern[str], bool, Callable[..., Answer]]]
"""What is served: patterns of paths, whether an answer stays the same, and functions of the patterns' groups."""

log = logging.getLogger(__name__)


class NotThereError(LookupError):
    """There is no such sample or picture."""


class WrongRequestError(ValueError):
    """What a path asks for is impossible."""


class NotAllowedError(Exception):
    """What is asked for is possible, and this server was started without the right to do it."""


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "photonfarm", ""
    timeout = IDLE_S

    def do_GET(self) -> None:
        """Answer with what the path names."""
        self._find(self.server.routes)

    do_HEAD = do_GET  # noqa: N815 - the library asks for these names

    def do_POST(self) -> None:
        """Do what the path names, if a page of this server asks for it; the connection ends, as no body is read.

        Otherwise what another site's page posts would be taken for further requests, with headers of its choice.
        """
        self.close_connection = True
        _, is_origin, asking = self.headers.get("Origin", "").partition("://")
        if not self.server.writes:
            self._refuse_method()
        elif not is_origin or asking != self.headers.get("Host"):
            self._refuse(HTTPStatus.FORBIDDEN, "only a page of this server may ask for that")
        else:
            self._find(self.server.writes)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:  # noqa: ARG002
        """Refuse what the library finds at fault, such as another method, as everything is refused here: in JSON."""
        self.close_connection = True
        if code == HTTPStatus.NOT_IMPLEMENTED:
            self._refuse_method()
        else:
            self._refuse(status := HTTPStatus(code), message or status.phrase)

    def _find(self, routes: Routes) -> None:
        if not self._is_asked_by_name():
            self._refuse(HTTPStatus.FORBIDDEN, "this server answers only to its own name")
            return
        try:
            path = urlsplit(self.path).path
        except ValueError:
            path = ""
        if path != "/" and self.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            self._refuse(HTTPStatus.FORBIDDEN, "only a page of this server may ask for that")
            return
        for pattern, stays, make in routes:
            if match := pattern.fullmatch(path):
                self._answer(make, match.groups(), stays)
                return
        self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")

    def _answer(self, make: Callable[..., Answer], groups: tuple[str, ...], stays: bool) -> None:
        try:
            kind, content = make(*groups)
        except (NotThereError, IndexError) as error:
            self._refuse(HTTPStatus.NOT_FOUND, str(error))
        except WrongRequestError as error:
            self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        except NotAllowedError as error:
            self._refuse(HTTPStatus.FORBIDDEN, str(error))
        except (PhotonfarmError, OSError) as error:
            self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, str(error))
        except Exception:
            log.exception("%s failed", self.path)
            self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, "this failed here; the server's log says why")
        else:
            self._send(HTTPStatus.OK, kind, content, "private, max-age=86400" if stays else "no-store")

    def _refuse_method(self) -> None:
        allowed = "GET, HEAD, POST" if self.server.writes else "GET, HEAD"
        self._refuse(HTTPStatus.METHOD_NOT_ALLOWED, f"{self.command}: this server answers {allowed} alone", allowed)

    def _refuse(self, status: HTTPStatus, sentence: str, allowed: str = "") -> None:
        self._send(status, JSON, json.dumps({"error": sentence}).encode(), "no-store", allowed)

    def _send(self, status: HTTPStatus, kind: str, content: bytes, keep: str, allowed: str = "") -> None:
        self.send_response(status)
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", keep)
        if allowed:
            self.send_header("Allow", allowed)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def _is_asked_by_name(self) -> bool:
        name = self.headers.get("Host", "")
        bare = name.rpartition(":")[0] if re.search(r":[0-9]+$", name) else name
        return bare.lower() in self.server.names

    def log_message(self, template: str, *values: Any) -> None:
        """Log a request, for those who debug."""
        log.debug(template, *values)


class PageServer(ThreadingHTTPServer):
    """Serves what its routes have until `shutdown`."""

    daemon_threads = True

    def __init__(
        self, routes: Routes, host: str, port: int, names: tuple[str, ...] = (), *, writes: Routes = ()
    ) -> None:
        """Listen; raises OSError if that is impossible. It answers to `names` besides its host's and this machine's."""
        self.routes, self.writes, self.asked_host = routes, writes, host
        self.names = {*LOCAL_NAMES, host.lower(), *(name.lower() for name in names)}
        super().__init__((host, port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002
        """Log a connection that broke off."""
        log.debug("a connection broke off", exc_info=True)


def listen(
    host: str, port: int | None, names: tuple[str, ...], *, usual: int, warn: Callable[[str], None]
) -> PageServer:
    """A server that listens and serves nothing yet: on a port, by default the `usual` one.

    Where that is taken, and no other was asked for, a free one is taken, and `warn` is told. Raises StoreError if
    nothing can listen there.
    """
    wanted = usual if port is None else port
    try:
        return PageServer((), host, wanted, names)
    except OSError as error:
        if port is not None or error.errno != errno.EADDRINUSE:
            raise StoreError(f"--host {host} --port {wanted}: cannot listen there: {error.strerror}") from error
    warn(f"port {usual} is taken, and a free one is used instead; --port names another")
    return PageServer((), host, 0, names)


def serve(server: PageServer, routes: Routes, say: Callable[[str], None], *, writes: Routes = ()) -> None:
    """Serve until Ctrl-C, once the address was said."""
    logging.basicConfig(format="%(asctime)s %(name)s: %(message)s", stream=sys.stderr)
    signal.signal(signal.SIGTERM, _end)
    server.routes, server.writes = routes, writes
    with server:
        say(f"http://{server.asked_host}:{server.server_address[1]}/")
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return


def _end(number: int, _: object) -> None:
    """End the process; a second signal would break off what runs at its exit."""
    signal.signal(number, signal.SIG_IGN)
    sys.exit(0)
