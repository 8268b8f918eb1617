"""A store under random use is what a dictionary would be: sample key → what was committed of it.

A machine of hypothesis plans, renders, gives up, damages, repairs and reads at random, in several processes' views of
one store, and compares the store with its model after each step. It takes the same steps each time; for others, and as
many as wanted:

    PHOTONFARM_MODEL_EXAMPLES=500 PHOTONFARM_MODEL_STEPS=60 pytest -q tests/faults/store/test_store_model.py --timeout=0

A step that fails is printed with those before it, shrunk to a few, as a program that can be pasted.
"""

import itertools
import os
from pathlib import Path

import numpy as np
import pytest
import store_samples as samples
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from photonfarm.core.errors import CorruptError, IncompleteError
from photonfarm.core.records import arrays_of
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.store import JobWriter, SceneReader, SceneStore, Store
from photonfarm.store.check.check import check_store
from photonfarm.store.format.shards import NOISY_GUIDES, round_to_8_bits

EXAMPLES = int(os.environ.get("PHOTONFARM_MODEL_EXAMPLES", "0"))
STEPS = int(os.environ.get("PHOTONFARM_MODEL_STEPS", "30"))

SPEC = samples.small_spec()
SHARD_ROWS = 3
PLANNED_AT_MOST = 40  # samples
PROCESSES = 3

any_index = st.integers(0, 10_000)
processes = st.integers(0, PROCESSES - 1)
counts = st.integers(1, 3)


class StoreMachine(RuleBasedStateMachine):
    """Several processes at one store, a reader that follows it, damage and repairs."""

    def __init__(self, root: Path) -> None:
        super().__init__()
        self.root = root
        self.stores = [Store(root, create=True) for _ in range(PROCESSES)]
        self.stores[0].add(SPEC).write_base(*samples.base())
        self.planned: dict[int, bytes] = {}  # the key of each sample, by row
        self.needs: dict[int, set[int]] = {}  # the jobs that must be committed for it to be complete
        self.committed: set[int] = set()
        self.open: list[JobWriter] = []
        self.watcher = SceneReader(root, SPEC.scene_id)
        self.follower = SceneReader(root, SPEC.scene_id)  # refreshed now and then
        self.seen: set[int] = set()  # rows that it was shown
        self.disturbed: set[int] = set()  # jobs that were damaged since

    def scene(self, process: int) -> SceneStore:
        return self.stores[process].scene(SPEC.scene_id)

    def complete(self) -> list[int]:
        return [row for row, jobs in sorted(self.needs.items()) if jobs <= self.committed]

    def missing(self) -> list[int]:
        return [job for job in range(self.scene(0).jobs()) if job not in self.committed]

    # ------------------------------------------------------------------------------------------------ plans and writing

    @initialize(sizes=st.tuples(counts, counts, counts), jobs=st.integers(0, 3))
    def begin(self, sizes: tuple[int, int, int], jobs: int) -> None:
        """A plan, and some of its jobs."""
        self.plan(process=0, sizes=sizes, seed=0)
        for _ in range(min(jobs, len(self.missing()))):
            self.render(process=1, which=0)

    @rule(process=processes, sizes=st.tuples(counts, counts, counts), seed=st.integers(0, 1))
    def plan(self, process: int, sizes: tuple[int, int, int], seed: int) -> None:
        """Sizes of the same seed overlap."""
        request = Request(modifications=sizes[0], views_per_modification=sizes[1], passes=sizes[2], seed=seed)
        if len(self.planned) < PLANNED_AT_MOST:
            self._take_up(self.stores[process].plan(SPEC, request, shard_rows=SHARD_ROWS).new)

    @rule(process=processes, views=counts)
    def top_up(self, process: int, views: int) -> None:
        if len(self.planned) < PLANNED_AT_MOST:
            self._take_up(self.scene(process).plan(TopUp.of("+8", [f"views=first:{views}"])).new)

    def _take_up(self, new: int) -> None:
        """The model takes up what was planned: rows that it did not have, and keys that nobody had."""
        scene, before = Store(self.root).scene(SPEC.scene_id), len(self.planned)
        for job in range(scene.jobs()):
            for sample in scene.job_rows(job).samples:
                if sample.row not in self.planned:
                    assert sample.key not in self.planned.values(), "a key is planned once"
                    self.planned[sample.row] = sample.key
                    rows = (sample.row, sample.view_row, sample.modification_row)
                    self.needs[sample.row] = {row // SHARD_ROWS for row in rows}
        assert len(self.planned) == before + new

    @precondition(lambda self: self.missing())
    @rule(process=processes, which=any_index)
    def render(self, process: int, which: int) -> None:
        """A missing job from beginning to end, as workers do."""
        jobs = self.missing()
        job = jobs[which % len(jobs)]
        assert samples.commit(self.scene(process), job, samples.outputs(self.scene(process), job))
        self.committed.add(job)

    @precondition(lambda self: self.committed)
    @rule(process=processes, which=any_index)
    def render_what_is_committed(self, process: int, which: int) -> None:
        job = sorted(self.committed)[which % len(self.committed)]
        assert not samples.commit(self.scene(process), job, samples.outputs(self.scene(process), job))

    @precondition(lambda self: len(self.open) < 3 and self.missing())
    @rule(process=processes, which=any_index)
    def begin_a_job(self, process: int, which: int) -> None:
        """It is given its samples and nothing else, so it cannot be committed."""
        scene, jobs = self.scene(process), self.missing()
        job = jobs[which % len(jobs)]
        out = JobWriter(scene, scene.job_rows(job))
        self.open.append(out)
        for row, halves in samples.outputs(scene, job).radiance.items():
            out.radiance(row, halves)
        if scene.job_rows(job).new_views:
            with pytest.raises(IncompleteError):
                out.commit(samples.FIGURES)

    @precondition(lambda self: self.open)
    @rule(which=any_index)
    def give_up(self, which: int) -> None:
        with self.open.pop(which % len(self.open)):
            pass

    @rule(process=processes)
    def open_again(self, process: int) -> None:
        """Open the store as another process does, which has seen nothing yet."""
        self.stores[process] = Store(self.root)

    # ---------------------------------------------------------------------------------------------- reading and damage

    @rule()
    def refresh(self) -> None:
        new = set(self.follower.refresh().tolist())
        assert new == set(self.complete()) - self.seen
        self.seen, self.disturbed = set(self.complete()), set()

    @precondition(lambda self: self.seen)
    @rule(which=any_index)
    def read(self, which: int) -> None:
        """The sample may have been taken back, and this reader may not have heard of it yet."""
        row = sorted(self.seen)[which % len(self.seen)]
        try:
            compare(self.follower, row)
        except (CorruptError, IncompleteError):
            assert self.needs[row] & self.disturbed, "what nobody has touched reads whole"

    @precondition(lambda self: self.committed and not self.open)
    @rule(
        process=processes,
        which=any_index,
        file=any_index,
        at=st.floats(0, 1),
        harm=st.sampled_from(["flip", "cut", "delete", "cut marker"]),
    )
    def damage_and_repair(self, process: int, which: int, file: int, at: float, harm: str) -> None:
        """One file of a committed job; the repair takes back this job alone, and loses nothing that is left."""
        scene = self.scene(process)
        job = sorted(self.committed)[which % len(self.committed)]
        marker = f"{scene.name}/committed/{job:012d}.json"
        files = sorted(f"{scene.name}/{name}" for name in scene.marker(job)["files"])
        _harm(self.root / (marker if "marker" in harm else files[file % len(files)]), harm.split()[0], at)
        self.disturbed.add(job)
        left = {name: (self.root / name).read_bytes() for name in [marker, *files] if (self.root / name).exists()}
        report = check_store(self.stores[process], when="now", repair=True)
        self.committed.discard(job)
        assert (report.scenes[0].set_aside, report.exit_code) == ((f"job {job}",), 7)
        for name, content in left.items():
            assert not (self.root / name).exists()
            assert (self.root / f"{report.quarantine}/{name}").read_bytes() == content

    # -------------------------------------------------------------------------------------------------- what must hold

    @invariant()
    def what_is_there_is_what_the_model_says(self) -> None:
        scene, complete = Store(self.root).scene(SPEC.scene_id), self.complete()
        assert scene.committed_jobs() == self.committed
        assert scene.progress().committed_samples == len(complete)
        self.watcher.refresh()
        assert (self.watcher.rows.tolist(), self.watcher.planned) == (complete, len(self.planned))
        for row in complete[-2:]:
            assert compare(self.watcher, row) == self.planned[row]
        for writer in self.open:
            assert all(shard.part.exists() for shard in list(writer._shards.values())), "parts of the living stay"

    def teardown(self) -> None:
        """Render what is missing; then everything is there, once, and nothing is wrong."""
        while self.open:
            self.give_up(0)
        while self.missing():
            self.render(process=0, which=0)
        self.refresh()
        assert {row: compare(self.follower, row) for row in self.seen} == self.planned
        assert check_store(Store(self.root), when="now").exit_code == 0
        assert self.stores[0].storage.names("tmp") == []
        del self.watcher, self.follower  # hypothesis keeps the machine, and with it their open files


def compare(reader: SceneReader, row: int) -> bytes:
    """Read a row, and compare it bit for bit with what was rendered, a function of the row; its key."""
    sample, size = reader.read(row, guides=True), (8, 8)
    np.testing.assert_array_equal(sample.radiance, samples.values(row, (2, *size, 3)))
    view = reader.view_row(row)
    np.testing.assert_array_equal(sample.buffers.depth, samples.values(view, size))
    for name, values in arrays_of(samples.guides(SPEC, view)).items():
        expected = round_to_8_bits(values) if name in NOISY_GUIDES else values
        np.testing.assert_array_equal(getattr(sample.guides, name), expected, name)
    expected = samples.photons(SPEC, reader.modification_row(row))
    np.testing.assert_array_equal(reader.read_photons(row).power, expected.power)
    return sample.key


def _harm(path: Path, harm: str, at: float) -> None:
    """Flip a bit somewhere, cut the file there, or remove it."""
    content = path.read_bytes()
    place = max(min(int(at * len(content)), len(content) - 2), 0)
    if harm == "delete":
        path.unlink()
    elif harm == "cut":
        os.truncate(path, place)
    else:
        path.write_bytes(content[:place] + bytes([content[place] ^ 1 << place % 8]) + content[place + 1 :])


def test_a_reader_that_did_not_look_while_a_job_was_repaired_and_rendered_again_reads_what_is_there_now(
    tmp_path: Path,
) -> None:
    """The committed jobs are the same as before, and the shard that it has kept open is the damaged one."""
    machine = StoreMachine(tmp_path / "store")
    machine.begin(sizes=(2, 1, 1), jobs=1)
    machine.refresh()
    rows = sorted(machine.seen)
    for file in range(0, len(machine.scene(0).marker(0)["files"]), 6):
        for place in range(len(rows)):
            machine.read(place)
        machine.damage_and_repair(process=0, which=0, file=file, at=0.3, harm="flip")
        machine.render(process=0, which=0)
        for row in rows:
            compare(machine.follower, row)
    machine.teardown()


@pytest.mark.slow
def test_a_store_under_random_use_is_what_a_dictionary_would_be(tmp_path: Path) -> None:
    number = itertools.count()
    run_state_machine_as_test(
        lambda: StoreMachine(tmp_path / str(next(number))),
        settings=settings(
            max_examples=EXAMPLES or 6,
            stateful_step_count=STEPS,
            derandomize=not EXAMPLES,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )
