"""Processes that plan, render, die and sweep at one store at random: the writing half of `test_store_model`."""

import itertools
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import store_samples as samples
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule
from store_model import Model, Planned, Writer, base_of

from photonfarm.core.errors import IncompleteError
from photonfarm.plan.request import UNUSED, Request
from photonfarm.plan.top_up import TopUp, spp_per_pass
from photonfarm.store import SceneStore, Store

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


class WritingMachine(RuleBasedStateMachine):
    """Several processes at one store, and what they should have made of it."""

    def __init__(self, root: Path) -> None:
        super().__init__()
        self.root = root
        self.stores = [Store(root, create=True) for _ in range(PROCESSES)]
        self.models = [Model(spec, rows) for spec, rows in zip(SPECS, SHARD_ROWS, strict=True)]
        for spec in SPECS:
            self.stores[0].add(spec).write_base(*base_of(spec))
        self.writers: list[Writer] = []
        self.dead: list[int] = []  # numbers of processes

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

    # ---------------------------------------------------------------------------------------------------------- writing

    def _some_job(self, number: int, which: int) -> int | None:
        """A missing job; now and then any job."""
        model = self.models[number]
        missing = model.missing()
        jobs = missing if missing and which % 8 else range(model.jobs)
        return jobs[which // 8 % len(jobs)] if jobs else None

    @precondition(lambda self: any(model.jobs for model in self.models) and len(self.writers) < 4)
    @rule(number=scene_numbers, process=processes, which=any_index, count=st.integers(0, 12))
    def open_writer(self, number: int, process: int, which: int, count: int) -> None:
        """The job may be one that another writer is at, or that is committed."""
        if (job := self._some_job(number, which)) is not None:
            writer = Writer(number, self.scene(number, process), job)
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
        committed = self.models[writer.number].committed
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
        """A missing job from beginning to end, as workers do."""
        if jobs := self.models[number].missing():
            self.writers.append(Writer(number, self.scene(number, process), jobs[which % len(jobs)]))
            self.commit(len(self.writers) - 1)

    @precondition(lambda self: any(model.missing() for model in self.models))
    @rule(
        number=scene_numbers,
        process=processes,
        which=any_index,
        given=st.one_of(st.integers(0, 12), st.just(1000)),
        links=st.integers(1, 25),
        after=st.booleans(),
    )
    def die(self, number: int, process: int, which: int, given: int, links: int, after: bool) -> None:
        """A process of its own, which is killed: in the middle of its rows, or before or after a link of its commit."""
        if (job := self._some_job(number, which)) is None:
            return
        scene = self.scene(number, process)
        scene.job_rows(job)  # the plans are loaded here: a fork shall not have to
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
            self.models[number].committed.add(job)
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


def _doomed(scene: SceneStore, job: int, given: int, links: int, after: bool, tell: int) -> None:
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

        writer = Writer(0, scene, job)
        writer.give(given)
        if not writer.left:
            os.link = dying
            writer.out.commit(samples.FIGURES)
    except BaseException as error:
        os.write(tell, repr(error).encode())
