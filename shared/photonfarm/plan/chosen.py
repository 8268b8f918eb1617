"""Samples that a person chose: views of configurations by names, which no distribution was asked for.

Shape letters: M configurations, V views.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field

from photonfarm.core.errors import SpecError
from photonfarm.core.models import Frozen
from photonfarm.plan.request import MAX_SAMPLES, Expansion, PlannedContent, SampleCount, contents, expand_views
from photonfarm.scene.arrangement import Shot, list_shot
from photonfarm.scene.modification import Modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View


class Chosen(Frozen):
    """What to plan: passes of views, each with its configuration; what a shot does not name is at rest."""

    kind: Literal["chosen"] = "chosen"
    shots: Annotated[tuple[Shot, ...], Field(min_length=1)]
    passes: Annotated[int, Field(ge=1, le=65536)] = 1

    @classmethod
    def of(cls, spec: SceneSpec, configuration: Modification, view: View, passes: int = 1) -> Self:
        """The request for passes of one view of a configuration, which comes out of the names to the bit."""
        return cls.of_all(spec, [(configuration, view)], passes)

    @classmethod
    def of_all(cls, spec: SceneSpec, views: Iterable[tuple[Modification, View]], passes: int = 1) -> Self:
        """The request for passes of several views, each with its configuration; SpecError for too many."""
        said = [list_shot(spec, configuration, view) for configuration, view in views]
        if spec.view.fov is None:
            _check_fov(spec, [each.pop("fov") for each in said])
        shots = tuple(Shot.of(**each) for each in said)
        if len(shots) * passes > MAX_SAMPLES:
            raise SpecError(f"names {len(shots) * passes} samples; at most {MAX_SAMPLES} fit one request")
        return cls(shots=shots, passes=passes)

    @property
    def samples(self) -> SampleCount:
        """The number of samples it names, planned already or not."""
        return len(self.shots) * self.passes

    @property
    def views_per_modification(self) -> int:
        """The views that each configuration has at least."""
        return 1


def _check_fov(spec: SceneSpec, asked: Iterable[float]) -> None:
    """Raise SpecError for a field of view that views of a spec cannot have."""
    for fov_deg in asked:
        if fov_deg != spec.view.fov_deg:
            raise SpecError(
                f"fov = {fov_deg:g}: samples of this spec have {spec.view.fov_deg:g}; a range, view.fov, allows more"
            )


def expand_chosen(
    spec: SceneSpec, request: Chosen, known: PlannedContent, *, first_job: int, shard_rows: int
) -> Expansion:
    """The rows of a request's new samples; see `request.expand`. Raises SpecError for what is impossible."""
    vectors = np.stack([shot.apply(spec).vector for shot in request.shots])
    place = {content: m for m, content in enumerate(dict.fromkeys(contents(vectors)))}
    of_view = np.array([place[content] for content in contents(vectors)], np.int64)
    _, first = np.unique(of_view, return_index=True)
    order = np.argsort(of_view, kind="stable")
    views = np.stack([shot.view(spec).vector for shot in request.shots])[order]
    numbers = {"first_job": first_job, "shard_rows": shard_rows}
    return expand_views(spec, vectors[first], of_view[order], views, request.passes, known, density=np.nan, **numbers)
