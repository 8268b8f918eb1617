"""The metrics of a farm: what a scrape says, how few values labels take, and the verbs that serve it."""

import http.client
import json
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import queue_samples
import redis
import store_samples as samples
from prometheus_client.parser import text_string_to_metric_families

from photonfarm.cli.main import main
from photonfarm.core.errors import StoreError
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.farm.watch import FarmWatch
from photonfarm.plan.request import Request
from photonfarm.queue.failures import keep_failure
from photonfarm.queue.job import job_name
from photonfarm.queue.reconciliation import reconcile
from photonfarm.store import SceneStore, Store
from photonfarm.web.metrics import MOST_ERRORS, OTHER, FarmMetrics

ROOT = Path(__file__).parents[2]

Series = dict[tuple[str, frozenset[tuple[str, str]]], float]


def scraped(metrics: FarmMetrics) -> Series:
    """The values of a scrape by name and labels."""
    _, content = metrics.answer()
    families = text_string_to_metric_families(content.decode())
    return {(s.name, frozenset(s.labels.items())): s.value for family in families for s in family.samples}


def of(found: Series, name: str, **labels: str) -> float:
    """The sum of the series with a name and these labels; fails if there is none."""
    values = [value for (each, has), value in found.items() if each == f"photonfarm_{name}" and labels.items() <= has]
    assert values, (name, labels)
    return sum(values)


def test_a_scrape_says_what_store_queue_workers_and_run_hold(farm: FarmWatch, scene: SceneStore) -> None:
    found = scraped(FarmMetrics(farm.look))
    names = {"scene": "small", "scene_id": scene.scene_id}
    assert of(found, "samples_committed_total", **names, **{"pass": "first"}) == 4
    assert of(found, "samples_planned", **names, **{"pass": "first"}) == 8
    assert of(found, "samples_in_hand", **names) == 1
    assert (of(found, "jobs_committed_total", **names), of(found, "jobs_planned", **names)) == (2, 4)
    assert of(found, "render_core_seconds_total", **names) == 2 * samples.FIGURES.core_s
    markers = [json.loads(file.read_text()) for file in (scene.folder / "committed").iterdir()]
    sizes = [about["size"] for marker in markers for about in marker["files"].values()]
    assert of(found, "committed_bytes_total", **names) == sum(sizes)
    assert {state: of(found, "workers", state=state) for state in ("rendering", "paused", "idle")} == {
        "rendering": 1,
        "paused": 1,
        "idle": 1,
    }
    jobs = {state: of(found, "queue_jobs", state=state) for state in ("waiting", "started", "failed")}
    assert jobs == {"waiting": 0, "started": 1, "failed": 1}
    assert of(found, "failed_jobs", error="ValueError", state="failed") == 1
    assert (of(found, "trainer_step", run="run"), of(found, "trainer_steps_planned", run="run")) == (50, 200)
    assert of(found, "trainer_loss", run="run") == 0.25
    assert of(found, "trainer_heldout_error", run="run") == 0.5
    assert of(found, "trainer_heldout_standard_error", run="run") == 0.125
    assert of(found, "trainer_heldout_samples", run="run") == 3
    assert of(found, "trainer_seconds_total", run="run", activity="wait_data") == 4
    assert (of(found, "trainer_state", run="run"), of(found, "trainer_state", state="absent")) == (1, 1)
    waits = {"scene_left": 1, "worker_paused": 1, "job_failed": 1, "no_worker": 0, "trainer_waits": 0}
    assert {kind: of(found, "waits", kind=kind) for kind in waits} == waits
    assert of(found, "queue_up") == 1


def test_without_a_redis_the_store_is_told_and_failures_that_it_has_kept(
    scene: SceneStore, store: Store, tmp_path: Path
) -> None:
    keep_failure(store, job_name(scene.scene_id, 3), "ValueError: 7", worker="ada")
    found = scraped(FarmMetrics(FarmWatch(store, f"unix://{tmp_path}/none").look))
    assert of(found, "samples_committed_total") == 4
    assert of(found, "queue_up") == 0
    assert of(found, "failed_jobs", error="ValueError", state="kept") == 1
    assert not any(name in ("photonfarm_queue_jobs", "photonfarm_workers") for name, _ in found)


def test_a_scene_that_cannot_be_read_is_counted_and_the_others_are_told(scene: SceneStore, store: Store) -> None:
    other = store.scene(store.plan(samples.small_spec(points=17), Request(modifications=1)).scene_id)
    (other.folder / "spec.json").write_text("{")
    found = scraped(FarmMetrics(FarmWatch(Store(store.root), "unix:///none").look))
    assert of(found, "scenes_unreadable") == 1
    assert of(found, "samples_planned", scene_id=scene.scene_id) == 8
    assert not any(("scene_id", other.scene_id) in labels for _, labels in found)


def test_failures_take_few_labels_whatever_their_messages_are(
    farm: FarmWatch, connection: redis.Redis, store: Store
) -> None:
    more = Request(modifications=200)
    store.plan(samples.small_spec(points=18), more, shard_rows=1)
    reconcile(store, connection)
    for job in range(200):
        reason = f"Error{'abcdefghij'[job % 10]}{'klmno'[job // 10 % 5]}: {job}" if job % 2 else f"\x1b[2J{job} <\"'\n>"
        queue_samples.failed(connection, reason)
    found = scraped(FarmMetrics(farm.look))
    labels = {dict(has)["error"] for name, has in found if name == "photonfarm_failed_jobs"}
    assert OTHER in labels
    assert len(labels) <= MOST_ERRORS + 1
    assert all(re.fullmatch(r"\w+", label) for label in labels)
    assert of(found, "failed_jobs") == 201


def test_runs_whose_folders_are_called_alike_have_a_label_each(farm: FarmWatch) -> None:
    view = farm.look()
    (training,) = view.trainings
    strange = replace(training, run="run \udcff", step=7)
    several = replace(view, trainings=[training, replace(training, step=60), strange])
    found = scraped(FarmMetrics(lambda: several))
    steps = {dict(labels)["run"]: step for (name, labels), step in found.items() if name == "photonfarm_trainer_step"}
    assert steps == {"run": 50, "run 2": 60, "run ?": 7}


def test_the_page_lists_every_metric_with_its_type_and_labels(farm: FarmWatch) -> None:
    page = (ROOT / "docs/metrics.md").read_text()
    listed = {
        name: (kind, set(re.findall(r"`(\w+)`", labels)))
        for name, kind, labels in re.findall(r"^\| `(photonfarm_\w+)` \| (\w+) \|([^|]*)\|", page, re.MULTILINE)
    }
    families = text_string_to_metric_families(FarmMetrics(farm.look).answer()[1].decode())
    assert listed == {
        family.name + "_total" * (family.type == "counter"): (
            family.type,
            {label for sample in family.samples for label in sample.labels},
        )
        for family in families
    }


# ------------------------------------------------------------------------------------------------------------ the verb


@contextmanager
def serving(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A verb that serves, and what it prints first."""
    command = [sys.executable, "-m", "photonfarm.cli", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process, process.stdout.readline()
        finally:
            process.kill()


def asked(port: int, path: str, **headers: str) -> tuple[int, str, str]:
    """The status, type and content of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    content = answer.read().decode()
    connection.close()
    return answer.status, answer.headers["Content-Type"], content


@pytest.mark.usefixtures("hears_ctrl_c")
@pytest.mark.parametrize("verb", ["serve-metrics", "web"])
def test_the_verbs_serve_the_metrics_to_their_own_names_and_end_on_ctrl_c(
    farm: FarmWatch, store: Store, common_redis: EmbeddedRedis, run: Path, verb: str
) -> None:
    where = ["--store", str(store.root), "--redis", common_redis.url, "--run", str(run), "--port", "0"]
    with serving(verb, *where, "--name", "farm.example") as (process, line):
        address = re.fullmatch(r"http://localhost:(\d+)/(metrics)?\n", line)
        assert address
        assert (address[2] == "metrics") == (verb == "serve-metrics")
        status, kind, content = asked(int(address[1]), "/metrics")
        assert (status, kind) == (200, "text/plain; version=0.0.4; charset=utf-8")
        names = {family.name for family in text_string_to_metric_families(content)}
        assert names == {family.name for family in FarmMetrics(farm.look).collect()}
        assert asked(int(address[1]), "/metrics", Host="farm.example")[0] == 200
        assert asked(int(address[1]), "/metrics", Host="evil.example")[0] == 403
        assert asked(int(address[1]), "/")[0] == (404 if verb == "serve-metrics" else 200)
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0


def refused(words: list[str]) -> int:
    """The exit code of a verb that does not serve."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.mark.parametrize("verb", ["serve-metrics", "web"])
def test_a_port_that_is_asked_for_and_taken_is_an_error(scene: SceneStore, store: Store, verb: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        where = ["--host", "127.0.0.1", "--port", str(taken.getsockname()[1])]
        assert refused([verb, "--store", str(store.root), *where]) == StoreError.exit_code


def test_a_store_that_is_gone_is_an_answer_of_503(scene: SceneStore, store: Store) -> None:
    with serving("serve-metrics", "--store", str(store.root), "--redis", "unix:///none", "--port", "0") as (_, line):
        port = int(line.rpartition(":")[2].partition("/")[0])
        Path(store.root).rename(f"{store.root}-away")
        assert asked(port, "/metrics")[0] == 503
