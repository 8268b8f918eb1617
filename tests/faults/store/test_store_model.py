"""A store under random use by several processes is what a dictionary would be: sample key → what was committed of it.

A machine of hypothesis plans, renders, dies, damages, repairs and reads at random, and compares the store with its
model after each step. It takes the same steps each time; for others, and as many as wanted:

    PHOTONFARM_MODEL_EXAMPLES=500 PHOTONFARM_MODEL_STEPS=60 pytest -q tests/faults/store/test_store_model.py --timeout=0

A step that fails is printed with those before it, shrunk to a few, as a program that can be pasted.
"""

import itertools
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import invariant, precondition, rule, run_state_machine_as_test
from store_machine import SPECS, WritingMachine, any_index, processes, scene_numbers
from store_model import Reader, Writer, compare

from photonfarm.core.errors import CorruptError, IncompleteError
from photonfarm.store import SceneReader, Store
from photonfarm.store.check.check import check_store
from photonfarm.store.format.schema import output_arrays

EXAMPLES = int(os.environ.get("PHOTONFARM_MODEL_EXAMPLES", "0"))
STEPS = int(os.environ.get("PHOTONFARM_MODEL_STEPS", "30"))


class StoreMachine(WritingMachine):
    """Several processes at one store, readers that follow it, damage and repairs."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.readers: list[Reader] = []
        self.watchers = [SceneReader(root, spec.scene_id) for spec in SPECS]
        self.quarantined: dict[str, bytes] = {}
        self.steps = 0

    # ---------------------------------------------------------------------------------------------------------- reading

    @precondition(lambda self: len(self.readers) < 3)
    @rule(number=scene_numbers)
    def open_reader(self, number: int) -> None:
        self.readers.append(Reader(number, SceneReader(self.root, SPECS[number].scene_id)))

    @precondition(lambda self: self.readers)
    @rule(which=any_index)
    def refresh(self, which: int) -> None:
        following = self.readers[which % len(self.readers)]
        complete = set(self.models[following.number].complete())
        new = set(following.reader.refresh().tolist())
        assert new == complete - following.seen
        assert set(following.reader.rows.tolist()) == complete
        following.seen, following.disturbed = complete, set()

    @precondition(lambda self: any(reader.seen for reader in self.readers))
    @rule(which=any_index, row=any_index)
    def read(self, which: int, row: int) -> None:
        """The sample may have been taken back, and this reader may not have heard of it yet."""
        readers = [reader for reader in self.readers if reader.seen]
        following = readers[which % len(readers)]
        rows = sorted(following.seen)
        self._read(following, rows[row % len(rows)])

    @precondition(lambda self: self.readers)
    @rule(which=any_index, row=any_index)
    def read_what_is_not_complete(self, which: int, row: int) -> None:
        following = self.readers[which % len(self.readers)]
        model = self.models[following.number]
        others = sorted(set(range(model.jobs * model.shard_rows + 2)) - following.seen)
        with pytest.raises(IncompleteError):
            following.reader.read(others[row % len(others)])

    def _read(self, following: Reader, row: int) -> None:
        model = self.models[following.number]
        sample = next(s for s in model.planned.values() if s.row == row)
        try:
            compare(following.reader, row, model)
        except (CorruptError, IncompleteError):
            assert model.jobs_of(sample) & following.disturbed, "what nobody has touched reads whole"

    # --------------------------------------------------------------------------------------------------------- damage

    @precondition(lambda self: any(model.committed for model in self.models))
    @rule(
        number=scene_numbers,
        process=processes,
        which=any_index,
        file=any_index,
        at=st.floats(0, 1),
        harm=st.sampled_from(["flip", "flip", "cut", "cut", "delete", "cut marker", "delete marker"]),
    )
    def damage_and_repair(self, number: int, process: int, which: int, file: int, at: float, harm: str) -> None:
        """One file of a committed job; the repair takes back this job alone, and loses nothing that is left.

        It has the scene for itself: nobody is in the middle of a job of it.
        """
        model = self.models[number]
        if not model.committed or any(writer.number == number for writer in self.writers):
            return
        scene = self.scene(number, process)
        job = sorted(model.committed)[which % len(model.committed)]
        marker = f"{scene.name}/committed/{job:012d}.json"
        files = sorted(f"{scene.name}/{name}" for name in scene.marker(job)["files"])
        _harm(self.root / (marker if "marker" in harm else files[file % len(files)]), harm.split()[0], at)
        self._disturb(number, job)
        fresh = Reader(number, SceneReader(self.root, SPECS[number].scene_id), disturbed={job})
        for row in fresh.reader.refresh().tolist():
            self._read(fresh, row)

        left = {name: (self.root / name).read_bytes() for name in [marker, *files] if (self.root / name).exists()}
        report = check_store(self.stores[process], when="now", repair=True)
        model.committed.discard(job)
        aside = {each.scene_id: each.set_aside for each in report.scenes}
        without_marker = harm == "delete marker"  # nobody knows that it was there
        assert aside.pop(model.spec.scene_id) == (() if without_marker else (f"job {job}",))
        assert set(aside.values()) <= {()}
        assert report.exit_code == (0 if without_marker else 7)
        moved = {name: content for name, content in left.items() if not (self.root / name).exists()}
        assert moved == ({} if without_marker else left)
        for name, content in moved.items():
            place = f"{report.quarantine}/{name}"
            assert place not in self.quarantined
            assert (self.root / place).read_bytes() == content, "what is quarantined is what was there"
        for path in (p for p in (self.root / "quarantine").rglob("*") if p.is_file()):
            self.quarantined.setdefault(str(path), path.read_bytes())

    @precondition(lambda self: self.dead)
    @rule(number=scene_numbers, which=any_index, at=st.floats(0, 1), harm=st.sampled_from(["flip", "cut", "delete"]))
    def damage_what_a_dead_writer_left(self, number: int, which: int, at: float, harm: str) -> None:
        """The file has its final name, and no marker: whoever commits the job next must not announce it."""
        model = self.models[number]
        scene = Store(self.root).scene(model.spec.scene_id)
        left = [
            path
            for plan in scene.plans()
            for path in sorted((self.root / plan.folder).glob("*/c.*"))
            if path.parent.name in output_arrays(model.spec)
            if plan.first_job + int(path.name.split(".")[1]) not in model.committed
        ]
        if left:
            path = left[which % len(left)]
            _harm(path, harm, at)

    def _disturb(self, number: int, job: int) -> None:
        for following in self.readers:
            if following.number == number:
                following.disturbed.add(job)

    # -------------------------------------------------------------------------------------------------- what must hold

    @invariant()
    def all_holds(self) -> None:
        self.what_is_committed_is_what_the_model_says()
        self.who_looks_after_each_step_sees_every_complete_sample_bit_for_bit()
        self.what_is_quarantined_stays()
        self.the_parts_of_living_writers_stay()

    def what_is_committed_is_what_the_model_says(self) -> None:
        for model in self.models:
            scene = Store(self.root).scene(model.spec.scene_id)
            assert scene.committed_jobs() == model.committed
            assert scene.missing_jobs() == model.missing()
            assert scene.progress().committed_samples == len(model.complete())

    def who_looks_after_each_step_sees_every_complete_sample_bit_for_bit(self) -> None:
        self.steps += 1
        for model, watcher in zip(self.models, self.watchers, strict=True):
            complete = model.complete()
            watcher.refresh()
            assert watcher.rows.tolist() == sorted(complete)
            assert watcher.planned == len(model.planned)
            for i in range(min(2, len(complete))):
                compare(watcher, sorted(complete)[(self.steps * 2 + i) % len(complete)], model)

    def what_is_quarantined_stays(self) -> None:
        for path, content in self.quarantined.items():
            assert Path(path).read_bytes() == content

    def the_parts_of_living_writers_stay(self) -> None:
        for writer in self.writers:
            assert all(shard.part.exists() for shard in list(writer.out._shards.values()))

    def teardown(self) -> None:
        """Render what is missing; then everything is there, once, and nothing is wrong."""
        try:
            while self.writers:
                self.give_up(0)
            for number, model in enumerate(self.models):
                for job in model.missing():
                    self.writers.append(Writer(number, self.scene(number, 0), job))
                    self.commit(0)
                reader = SceneReader(self.root, model.spec.scene_id)
                assert len(reader.refresh()) == len(model.planned)
                rows = reader.rows.tolist()
                assert {compare(reader, row, model) for row in rows} == model.planned.keys()
            for following in self.readers:
                self.refresh(self.readers.index(following))
                for row in sorted(following.seen):
                    self._read(following, row)
            report = check_store(Store(self.root), when="now")
            assert report.exit_code == 0
            assert self.stores[0].sweep(stray_age_s=0) <= 25 * len(self.dead)  # 24 arrays and the marker
            assert self._parts() == set()
        finally:
            for writer in self.writers:
                with writer.out:
                    pass


def _harm(path: Path, harm: str, at: float) -> None:
    """Flip a bit somewhere, cut the file there, or remove it."""
    content = path.read_bytes()
    place = max(min(int(at * len(content)), len(content) - 2), 0)
    if harm == "delete" or not content:
        path.unlink()
    elif harm == "cut":
        os.truncate(path, place)
    else:
        with path.open("r+b") as file:
            file.seek(place)
            file.write(bytes([content[place] ^ 1 << place % 8]))


def test_a_reader_that_did_not_look_while_a_job_was_repaired_and_rendered_again_reads_what_is_there_now(
    tmp_path: Path,
) -> None:
    """The committed jobs are the same as before, and the shard that it has kept open is the damaged one."""
    machine = StoreMachine(tmp_path / "store")
    machine.plan(number=0, process=0, sizes=(2, 1, 1), seed=0)
    machine.render(number=0, process=0, which=0)
    machine.open_reader(number=0)
    machine.refresh(which=0)
    rows = len(machine.readers[0].seen)
    for row in range(rows):
        machine.read(which=0, row=row)
    for file in range(len(machine.scene(0, 0).marker(0)["files"])):
        machine.damage_and_repair(number=0, process=0, which=0, file=file, at=0.3, harm="flip")
        machine.render(number=0, process=0, which=0)
        machine.refresh(which=0)
        for row in range(rows):
            machine.read(which=0, row=row)
    machine.teardown()


@pytest.mark.slow
def test_a_store_under_random_use_is_what_a_dictionary_would_be(tmp_path: Path) -> None:
    number = itertools.count()
    run_state_machine_as_test(
        lambda: StoreMachine(tmp_path / str(next(number))),
        settings=settings(
            max_examples=EXAMPLES or 8,
            stateful_step_count=STEPS,
            derandomize=not EXAMPLES,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )
