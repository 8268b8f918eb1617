"""What is served under which path: the pages with what they show, and the metrics."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from photonfarm.web.server import JSON, Answer, Routes

if TYPE_CHECKING:
    from photonfarm.shared.farm.watch import FarmView
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


def page_routes(pages: FarmPages) -> Routes:
    """The pages, what they show, and the metrics."""

    def document(make: Callable[..., Any]) -> Callable[..., Answer]:
        return lambda *groups: (JSON, json.dumps(make(*groups), allow_nan=False, default=str).encode())

    def file(path: Path) -> Callable[[], Answer]:
        return lambda: (KINDS[path.suffix], path.read_bytes())

    table: list[tuple[str, bool, Callable[..., Answer]]] = [
        ("/", False, file(STATIC / "index.html")),
        *((f"/{path.name}", False, file(path)) for path in sorted(STATIC.iterdir()) if path.suffix in KINDS),
        ("/api/state", False, document(pages.state)),
        ("/api/curves", False, document(pages.curves)),
        (f"/api/wall/{_SCENE}", False, document(pages.wall)),
        (f"/api/sample/{_SCENE}/{_ROW}", False, document(lambda scene, row: pages.about(scene, int(row)))),
        (f"/sample/{_SCENE}/{_ROW}/thumbnail.jpg", True, lambda s, row: (JPEG, pages.samples(s).thumbnail(int(row)))),
        (f"/sample/{_SCENE}/{_ROW}/points", True, lambda s, row: (BYTES, pages.samples(s).points(int(row)))),
        (f"/sample/{_SCENE}/{_ROW}/photons", True, lambda s, row: (BYTES, pages.samples(s).photons(int(row)))),
        (f"/sample/{_SCENE}/{_ROW}/reference.png", False,
         lambda s, row: (PNG, pages.samples(s).picture(int(row), "reference"))),
        (f"/sample/{_SCENE}/{_ROW}/([a-z_]{{1,20}}).png", True,
         lambda s, row, name: (PNG, pages.samples(s).picture(int(row), name))),
        ("/run/([0-9]{1,3})/([0-9]{1,8}).png", True, lambda run, step: (PNG, pages.prediction(int(run), int(step)))),
    ]  # fmt: skip
    found = [(re.compile(pattern.replace(".", r"\.")), stays, make) for pattern, stays, make in table]
    return found + metric_routes(pages.view)


def metric_routes(look: Callable[[], FarmView]) -> Routes:
    """The metrics of a farm, by a function that gives it as it is now."""

    @cache
    def metrics() -> FarmMetrics:
        from photonfarm.web.metrics import FarmMetrics  # whoever only looks at the pages needs no client of Prometheus

        return FarmMetrics(look)

    return [(re.compile("/metrics"), False, lambda: metrics().answer())]
