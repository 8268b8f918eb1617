"""How many samples a job has, unless a user says so: some seconds of work, and several jobs for every worker.

The number is fixed for a scene by its first plan. Jobs of many seconds keep workers idle at the end, and show nothing
for long; jobs of less than a second cost more than they render, in files and markers.
"""

from __future__ import annotations

from photonfarm.shared.plan.request import SHARD_ROWS, Request
from photonfarm.shared.scene.spec import SceneSpec

WORKERS = 8
"""The workers that a plan is made for where their number is not known."""

JOBS_EACH = 4
"""The least jobs of each worker, so that none idles for long while others render the last ones."""

MOST_S = 10.0
"""The longest that a job should take."""

LEAST_S = 2.0
"""The shortest: a small first plan may be followed by large ones, whose jobs are as small."""

SAMPLE_S = 0.1
"""The estimated core-seconds of a sample, whatever its size: its buffers, its photons and its files."""

PATHS_PER_S = 250_000.0
"""The estimated eye paths that a core traces in a second, of DEPTH segments."""

DEPTH = 8


def sample_seconds(spec: SceneSpec) -> float:
    """The estimated core-seconds of a sample; rooms differ from it by a factor of three either way."""
    film, transport = spec.film, spec.transport
    paths = film.width * film.height * 2 * transport.half_spp
    return SAMPLE_S + paths * max(transport.max_depth, 1) / DEPTH / PATHS_PER_S


def rows_per_job(spec: SceneSpec, request: Request, workers: int = WORKERS) -> int:
    """The samples of a job for a scene whose first request this is."""
    each = sample_seconds(spec)
    shared_out = max(request.samples // (workers * JOBS_EACH), round(LEAST_S / each))
    rows = max(1, min(shared_out, round(MOST_S / each), SHARD_ROWS))
    of_configuration = request.views_per_modification * request.passes
    return rows - rows % of_configuration if rows > of_configuration else rows  # others render its photons again
