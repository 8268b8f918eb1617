"""A store under random use by several processes is what a dictionary would be: sample key → what was committed of it.

A machine of hypothesis plans, renders, dies, damages, repairs and reads at random, and compares the store with its
model after each step. It takes the same steps each time; for others, and as many as wanted:

    PHOTONFARM_MODEL_EXAMPLES=500 PHOTONFARM_MODEL_STEPS=60 pytest -q tests/faults/store/test_store_model.py --timeout=0

A step that fails is printed with those before it, shrunk to a few, as a program that can be pasted.
"""

import itertools
import os
import signal
from pathlib import Path
from typing import Any

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
from store_model import Model, Planned, Reader, Writer, base_of, compare

from photonfarm.shared.core.errors import CorruptError, IncompleteError, SpecError, StoreError
from photonfarm.shared.plan.request import UNUSED, Request
from photonfarm.shared.plan.top_up import TopUp, spp_per_pass
from photonfarm.shared.scene.spec import GuideSpec
from photonfarm.shared.store import SceneReader, SceneStore, Store
from photonfarm.shared.store.check.check import check_store
from photonfarm.shared.store.write.guides import beside

EXAMPLES = int(os.environ.get("PHOTONFARM_MODEL_EXAMPLES", "0"))
STEPS = int(os.environ.get("PHOTONFARM_MODEL_STEPS", "30"))

SPECS = (
    samples.small_spec(),
    samples.small_spec(name="static", objects=[], photons={"paths": 0, "depth": 2}),  # other arrays, one modification
)
SHARD_ROWS = (3, 2)
PLANNED_AT_MOST = 40  # samples of a scene
PROCESSES = 3

any_index = st.integers(0, 10_000)
scene_numbers = st.integers(0, len(SPECS) - 1)
processes = st.integers(0, PROCESSES - 1)
counts = st.integers(1, 3)


# ---------------------------------------------------------------------------------------------------------- the machine


class StoreMachine(RuleBasedStateMachine):
    """Several processes at one store."""

    def __init__(self, root: Path) -> None:
        super().__init__()
        self.root = root
        self.stores = [Store(root, create=True) for _ in range(PROCESSES)]
        self.models = [Model(spec, rows) for spec, rows in zip(SPECS, SHARD_ROWS, strict=True)]
        for spec in SPECS:
            self.stores[0].add(spec).write_base(*base_of(spec))
        self.ask_for_guides(number=0, process=0, light_samples=1)  # as `submit` does; of the other scene in its time
        self.writers: list[Writer] = []
        self.readers: list[Reader] = []
        self.watchers = [(n, g, SceneReader(root, SPECS[n].scene_id, guides=g)) for n in (0, 1) for g in (False, True)]
        self.quarantined: dict[str, bytes] = {}
        self.dead: list[int] = []  # numbers of processes
        self.steps = 0

    def scene(self, number: int, process: int) -> SceneStore:
        return self.stores[process].scene(SPECS[number].scene_id)

    @initialize(sizes=st.tuples(counts, counts, counts), jobs=st.integers(0, 3))
    def begin(self, sizes: tuple[int, int, int], jobs: int) -> None:
        """A plan, and some of its jobs."""
        self.plan(number=0, process=0, sizes=sizes, seed=0)
        for _ in range(jobs):
            self.render(number=0, process=1, which=0)

    # ------------------------------------------------------------------------------------------------------------ plans

    @rule(number=scene_numbers, process=processes, sizes=st.tuples(counts, counts, counts), seed=st.integers(0, 1))
    def plan(self, number: int, process: int, sizes: tuple[int, int, int], seed: int) -> None:
        """Sizes of the same seed overlap."""
        model = self.models[number]
        request = Request(modifications=sizes[0], views_per_modification=sizes[1], passes=sizes[2], seed=seed)
        named = model.named(request)
        if len(model.planned.keys() | named) > PLANNED_AT_MOST:
            return
        result = self.stores[process].plan(model.spec, request, shard_rows=model.shard_rows)
        new = named - model.planned.keys()
        assert (result.new, result.known) == (len(new), len(named) - len(new))
        self._take_plan(number, new, result)

    @precondition(lambda self: any(model.planned for model in self.models))
    @rule(number=scene_numbers, process=processes, passes=counts, adds=st.booleans(), first=st.integers(0, 4))
    def top_up(self, number: int, process: int, passes: int, adds: bool, first: int) -> None:
        model = self.models[number]
        chosen = list(model.views().items())[: first or None]
        new, known = set(), 0
        for (modification, view), shown in chosen:
            have = 0 if adds else min(len(shown), passes)
            after = max(s.pass_ for s in shown) + 1
            new |= {model.key(modification, view, after + i) for i in range(passes - have)}
            known += have
        if not chosen or len(model.planned) + len(new) > PLANNED_AT_MOST:
            return
        spp = f"{'+' if adds else ''}{passes * spp_per_pass(model.spec)}"
        request = TopUp.of(spp, [f"views=first:{first}"] if first else [])
        result = self.scene(number, process).plan(request)
        assert (result.new, result.known) == (len(new), known)
        self._take_plan(number, new, result)

    def _take_plan(self, number: int, new: set[bytes], result: Any) -> None:
        """Take over a plan that must hold these keys, each once, and begin where the one before ended."""
        model = self.models[number]
        plans = Store(self.root).scene(model.spec.scene_id).plans()
        assert len(plans) == model.plans + bool(new)
        assert result.plan == (model.plans if new else None)
        if not new:
            return
        plan = plans[-1]
        assert plan.first_job == model.jobs
        model.plans, model.jobs = len(plans), plan.end_job
        rows = plan.rows
        found = {}
        for i in np.flatnonzero(rows.sample_modification != UNUSED).tolist():
            view_row, modification_row = int(rows.sample_view[i]), int(rows.sample_modification[i])
            of_view, of_modification = (self._plan_of(plans, row) for row in (view_row, modification_row))
            sample = Planned(
                of_modification.rows.modification[modification_row - of_modification.first_row].tobytes(),
                of_view.rows.view[view_row - of_view.first_row].tobytes(),
                int(rows.sample_pass[i]),
                plan.first_row + i,
                view_row,
                modification_row,
            )
            key = rows.sample_key[i].tobytes()
            assert key == model.key(sample.modification, sample.view, sample.pass_), "a row says what its key is of"
            assert key not in found, "a key is planned once"
            assert key not in model.planned, "a key is planned once"
            found[key] = sample
        assert found.keys() == new
        model.planned |= found

    @staticmethod
    def _plan_of(plans: list[Any], row: int) -> Any:
        return next(plan for plan in plans if plan.first_row <= row < plan.end_row)

    @rule(number=scene_numbers, process=processes, light_samples=st.sampled_from([1, 1, 1, 2]))
    def ask_for_guides(self, number: int, process: int, light_samples: int) -> None:
        """Guides may be asked for at any time; the settings that come first stay."""
        model, wanted = self.models[number], GuideSpec(light_samples=light_samples)
        guides = self.scene(number, process).guides
        if model.wanted not in (None, wanted):
            with pytest.raises(SpecError):
                guides.want(wanted)
            return
        assert guides.want(wanted) is (model.wanted is None)
        model.wanted = wanted

    # ---------------------------------------------------------------------------------------------------------- writing

    def _some_job(self, number: int, which: int, guides: bool) -> tuple[int, bool] | None:
        """A missing job, and whether it is of guides, once these are asked for; now and then any job."""
        model = self.models[number]
        guides &= model.wanted is not None
        missing = sorted(model.every(guides) - model.done(guides))
        jobs = missing if missing and which % 8 else sorted(model.every(guides))
        return (jobs[which // 8 % len(jobs)], guides) if jobs else None

    @precondition(lambda self: any(model.jobs for model in self.models) and len(self.writers) < 4)
    @rule(number=scene_numbers, process=processes, which=any_index, count=st.integers(0, 12), guides=st.booleans())
    def open_writer(self, number: int, process: int, which: int, count: int, guides: bool) -> None:
        """The job may be one that another writer is at, or that is committed."""
        if (job := self._some_job(number, which, guides)) is not None:
            writer = Writer(number, self.scene(number, process), *job)
            self.writers.append(writer)
            writer.give(count, which)

    @precondition(lambda self: self.writers)
    @rule(which=any_index, count=counts)
    def give_rows(self, which: int, count: int) -> None:
        self.writers[which % len(self.writers)].give(count, which)

    @precondition(lambda self: self.writers)
    @rule(which=any_index)
    def commit(self, which: int) -> None:
        writer = self.writers.pop(which % len(self.writers))
        committed = self.models[writer.number].done(writer.guides)
        with writer.out:
            writer.give(len(writer.left))
            assert writer.out.commit(samples.FIGURES) is (writer.job not in committed)
        committed.add(writer.job)

    @precondition(lambda self: any(writer.left for writer in self.writers))
    @rule(which=any_index)
    def commit_too_early(self, which: int) -> None:
        begun = [writer for writer in self.writers if writer.left]
        with pytest.raises(IncompleteError):
            begun[which % len(begun)].out.commit(samples.FIGURES)

    @precondition(lambda self: self.writers)
    @rule(which=any_index)
    def give_up(self, which: int) -> None:
        with self.writers.pop(which % len(self.writers)).out:
            pass

    @precondition(lambda self: any(model.missing() for model in self.models))
    @rule(number=scene_numbers, process=processes, which=any_index)
    def render(self, number: int, process: int, which: int) -> None:
        """A missing job from beginning to end, as workers do: its guides first."""
        model = self.models[number]
        if jobs := model.missing():
            job = jobs[which % len(jobs)]
            for guides in (True, False):
                if job in model.every(guides) - model.done(guides):
                    self.writers.append(Writer(number, self.scene(number, process), job, guides))
                    self.commit(len(self.writers) - 1)

    @precondition(lambda self: any(model.missing() for model in self.models))
    @rule(
        number=scene_numbers, process=processes, which=any_index, guides=st.booleans(),
        given=st.one_of(st.integers(0, 12), st.just(1000)), links=st.integers(1, 13), after=st.booleans(),
    )  # fmt: skip
    def die(self, number: int, process: int, which: int, guides: bool, given: int, links: int, after: bool) -> None:
        """A process of its own, which is killed: in the middle of its rows, or before or after a link of its commit."""
        if (job := self._some_job(number, which, guides)) is None:
            return
        scene = self.scene(number, process)
        scene.job_rows(job[0])  # the plans are loaded here: a fork shall not have to
        told, tell = os.pipe()
        if (pid := os.fork()) == 0:
            try:
                os.close(told)
                _doomed(scene, job, given, links, after, tell)
            finally:
                os.kill(os.getpid(), signal.SIGKILL)
        os.close(tell)
        assert os.WTERMSIG(os.waitpid(pid, 0)[1]) == signal.SIGKILL
        with os.fdopen(told, "rb") as told_of:
            said = told_of.read()
        assert said in (b"", b"marker"), said.decode()
        if said == b"marker":
            self.models[number].done(job[1]).add(job[0])
        self.dead.append(pid)

    # --------------------------------------------------------------------------------------------- processes and sweeps

    @rule(process=processes)
    def open_again(self, process: int) -> None:
        """Open the store as another process does, which has seen nothing yet."""
        self.stores[process] = Store(self.root)

    @rule(process=processes, at_once=st.booleans())
    def sweep(self, process: int, at_once: bool) -> None:
        parts = self._parts()
        of_the_dead = {name for name in parts if any(f"-{pid}-" in name for pid in self.dead)}
        swept = self.stores[process].sweep(stray_age_s=0 if at_once else 3600)
        assert swept == (len(of_the_dead) if at_once else 0)  # none is an hour old
        left = self._parts()
        assert parts - of_the_dead <= left  # the threads of open writers may have begun more
        assert left & of_the_dead == (set() if at_once else of_the_dead)

    def _parts(self) -> set[str]:
        return set(self.stores[0].storage.names("tmp"))

    # ---------------------------------------------------------------------------------------------------------- reading

    @precondition(lambda self: len(self.readers) < 3)
    @rule(number=scene_numbers, guides=st.booleans())
    def open_reader(self, number: int, guides: bool = False) -> None:
        self.readers.append(Reader(number, SceneReader(self.root, SPECS[number].scene_id, guides=guides), guides))

    @precondition(lambda self: self.readers)
    @rule(which=any_index)
    def follow_guides(self, which: int) -> None:
        """A reader follows guides from now on, if its scene is to have some."""
        following = self.readers[which % len(self.readers)]
        if self.models[following.number].wanted is None:
            with pytest.raises(SpecError):
                following.reader.follow_guides()
            return
        following.reader.follow_guides()
        if not following.guides:
            following.guides, following.seen = True, set()

    @precondition(lambda self: self.readers)
    @rule(which=any_index)
    def refresh(self, which: int) -> None:
        following = self.readers[which % len(self.readers)]
        complete = set(self.models[following.number].complete(following.guides))
        new = set(following.reader.refresh().tolist())
        assert new == complete - following.seen
        assert set(following.reader.taken_back.tolist()) == following.seen - complete
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
        with pytest.raises(StoreError) as refused:
            following.reader.read(others[row % len(others)])
        assert not isinstance(refused.value, CorruptError)

    def _read(self, following: Reader, row: int) -> None:
        model = self.models[following.number]
        sample = next(s for s in model.planned.values() if s.row == row)
        try:
            compare(following.reader, row, model, guides=following.guides)
        except CorruptError:
            assert model.jobs_of(sample) & following.disturbed, "what nobody has touched reads whole"

    # --------------------------------------------------------------------------------------------------------- damage

    @precondition(lambda self: any(model.committed for model in self.models))
    @rule(
        number=scene_numbers, process=processes, which=any_index, file=any_index, at=st.floats(0, 1),
        guides=st.booleans(),
        harm=st.sampled_from(["flip", "flip", "cut", "cut", "delete", "cut marker", "delete marker"]),
    )  # fmt: skip
    def damage_and_repair(
        self, number: int, process: int, which: int, file: int, at: float, harm: str, guides: bool = False
    ) -> None:
        """One file of a committed job; the repair takes back this job alone, and loses nothing that is left.

        Of a job's guides it leaves the samples where they are, and the other way round.
        """
        model = self.models[number]
        done = model.done(guides := guides and bool(model.guided))
        if not done:
            return
        scene = self.scene(number, process)
        part, called = (scene.guides, "guides of job") if guides else (scene, "job")
        job = sorted(done)[which % len(done)]
        marker = f"{part.name}/committed/{job:012d}.json"
        files = sorted(f"{part.name}/{name}" for name in part.marker(job)["files"])
        _harm(self.root / (marker if "marker" in harm else files[file % len(files)]), harm.split()[0], at)
        self._disturb(number, job)
        fresh = Reader(number, SceneReader(self.root, SPECS[number].scene_id, guides=guides), guides, disturbed={job})
        for row in fresh.reader.refresh().tolist():
            self._read(fresh, row)

        left = {name: (self.root / name).read_bytes() for name in [marker, *files] if (self.root / name).exists()}
        report = check_store(self.stores[process], when="now", repair=True)
        done.discard(job)
        aside = {each.scene_id: each.set_aside for each in report.scenes}
        without_marker = harm == "delete marker"  # nobody knows that it was there
        assert aside.pop(model.spec.scene_id) == (() if without_marker else (f"{called} {job}",))
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
            for guides, folder in ((False, plan.folder), (True, beside(plan, scene.guides.name).folder))
            for path in sorted((self.root / folder).glob("*/c.*"))
            if guides or path.parent.name in WRITTEN
            if plan.first_job + int(path.name.split(".")[1]) not in model.done(guides)
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
            assert scene.guides.committed_jobs() == model.guided
            assert scene.guides.settings() == model.wanted
            assert scene.missing_jobs() == model.missing()
            usable = model.complete(guides=model.wanted is not None)
            assert scene.progress().usable_samples == len(usable)

    def who_looks_after_each_step_sees_every_complete_sample_bit_for_bit(self) -> None:
        self.steps += 1
        for number, guides, watcher in self.watchers:
            model = self.models[number]
            complete = model.complete(guides)
            watcher.refresh()
            assert watcher.rows.tolist() == sorted(complete)
            assert watcher.planned == len(model.planned)
            for i in range(min(2, len(complete))):
                compare(watcher, sorted(complete)[(self.steps * 2 + i) % len(complete)], model, guides=guides)

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
                for guides in (False, True):
                    for job in sorted(model.every(guides) - model.done(guides)):
                        self.writers.append(Writer(number, self.scene(number, 0), job, guides))
                        self.commit(0)
                guides = model.wanted is not None
                reader = SceneReader(self.root, model.spec.scene_id, guides=guides)
                assert len(reader.refresh()) == len(model.planned)
                rows = reader.rows.tolist()
                assert {compare(reader, row, model, guides=guides) for row in rows} == model.planned.keys()
            for following in self.readers:
                self.refresh(self.readers.index(following))
                for row in sorted(following.seen):
                    self._read(following, row)
            report = check_store(Store(self.root), when="now")
            assert report.exit_code == 0
            assert self.stores[0].sweep(stray_age_s=0) <= 14 * len(self.dead)  # 12 guides, their folder and marker
            assert self._parts() == set()
        finally:
            for writer in self.writers:
                with writer.out:
                    pass


WRITTEN = {"radiance", "radiance_wide", "depth", "albedo", "normal"} | {
    f"photon_{name}" for name in ("position", "direction", "normal", "power", "bounce")
}


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


def _doomed(scene: SceneStore, job: tuple[int, bool], given: int, links: int, after: bool, tell: int) -> None:
    """Write in a process of its own, and be killed; says whether the marker was placed before that."""
    try:
        plain, left = os.link, itertools.count(1)

        def dying(source: Any, target: Any) -> None:
            last = next(left) == links
            if last and not after:
                os.kill(os.getpid(), signal.SIGKILL)
            plain(source, target)
            if "committed" in str(target):
                os.write(tell, b"marker")
            if last:
                os.kill(os.getpid(), signal.SIGKILL)

        writer = Writer(0, scene, *job)
        writer.give(given)
        if not writer.left:
            os.link = dying
            writer.out.commit(samples.FIGURES)
    except BaseException as error:
        os.write(tell, repr(error).encode())


@pytest.mark.parametrize("guides", [False, True], ids=["samples", "guides"])
def test_a_reader_that_did_not_look_while_a_job_was_repaired_and_rendered_again_reads_what_is_there_now(
    tmp_path: Path, guides: bool
) -> None:
    """The committed jobs are the same as before, and the shard that it has kept open is the damaged one."""
    machine = StoreMachine(tmp_path / "store")
    machine.plan(number=0, process=0, sizes=(2, 1, 1), seed=0)
    machine.render(number=0, process=0, which=0)
    machine.open_reader(number=0, guides=guides)
    machine.refresh(which=0)
    rows = len(machine.readers[0].seen)
    for row in range(rows):
        machine.read(which=0, row=row)
    part = machine.scene(0, 0).guides if guides else machine.scene(0, 0)
    for file in range(len(part.marker(0)["files"])):
        machine.damage_and_repair(number=0, process=0, which=0, file=file, at=0.3, harm="flip", guides=guides)
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
