"""Machines whose clocks are wrong: processes whose C library tells another time.

Time namespaces leave the time of day alone, so that a few lines of C are loaded before it, which Python, Redis' client,
RQ and Zarr all ask, and not only those that call `time.time`. Files are stamped by the file system, whose clock is
right, as a file server's would be.
"""

from collections.abc import Callable
from pathlib import Path

import pytest

from photonfarm.store import SceneReader, SceneStore

YEAR_S = 365 * 86400
ENDED_S = 60.0  # for a process to end that nobody talks to any more
SKEWS = pytest.mark.parametrize("skew_s", [YEAR_S, -YEAR_S], ids=["a year ahead", "a year behind"])

CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>

static long skew(void) { const char *told = getenv("CLOCK_SKEW_S"); return told ? atol(told) : 0; }

int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*plain)(clockid_t, struct timespec *);
    if (!plain) plain = dlsym(RTLD_NEXT, "clock_gettime");
    int result = plain(clock, now);
    if (!result && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) now->tv_sec += skew();
    return result;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec precise;
    int result = clock_gettime(CLOCK_REALTIME, &precise);
    now->tv_sec = precise.tv_sec;
    now->tv_usec = precise.tv_nsec / 1000;
    return result;
}

time_t time(time_t *now) {
    struct timespec precise;
    clock_gettime(CLOCK_REALTIME, &precise);
    if (now) *now = precise.tv_sec;
    return precise.tv_sec;
}
"""

MACHINE = """
import contextlib, io, json, sys, traceback
from pathlib import Path
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.plan.request import Request
from photonfarm.queue import WorkerReport, connect, queue_status, reconcile
from photonfarm.store import Store
from photonfarm.store.check.check import check_store
from photonfarm.plan.top_up import TopUp
sys.path.append(sys.argv[1])
sys.path.append(sys.argv[1] + "/../shared")
import analytic_scene as analytic
from queue_samples import taken, told

names = dict(globals())
for line in sys.stdin:
    code, root, url = json.loads(line)
    said, error = io.StringIO(), ""
    try:
        with contextlib.redirect_stdout(said):
            exec(code, {**names, "root": root, "url": url, "store": Store(root)})
    except Exception:
        error = traceback.format_exc()
    print(json.dumps([said.getvalue().strip(), error]), flush=True)
"""


Machine = Callable[..., str]


def root_of(scene: SceneStore) -> Path:
    return scene.folder.parent.parent


def rows_read(scene: SceneStore) -> list[int]:
    reader = SceneReader(root_of(scene), scene.scene_id)
    return [reader.read(row).row for row in reader.refresh().tolist()]
