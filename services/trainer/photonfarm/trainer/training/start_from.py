"""A run that begins with the weights of another one, of this scene or a similar one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from photonfarm.core.errors import SpecError
from photonfarm.core.models import differing
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import CHECKPOINT, read_settings, read_shares
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training.learner import Learner

SAME = ("architecture", "width", "descriptor", "octaves", "maxima", "emission", "demodulation")
"""The settings that say what a network's weights are, and what they are for."""

OF_INPUTS = (
    "points",
    "occlusion",
    "occlusion_tolerance",
    "lit_points",
    "filter",
    "reflectance",
    "least_specular",
)
"""The settings that say what a network's inputs are."""

OF_POINTS = "descriptor"
"""The weights that belong to the points of one scene's cloud, and say nothing of those of another."""


def check_same_network(run: Path, settings: TrainSettings) -> str:
    """Raise SpecError, with each setting that differs, if a run's weights are of another network than the settings say.

    Returns which inputs they know otherwise than they will be given them, in a sentence; "" if none. Raises StoreError
    if there is no such run.
    """
    read_settings(run)  # which says what lacks
    state = checkpoint.load(run / CHECKPOINT)
    _name_differences(run, state, settings, SAME)
    changed = differing(state["settings"]["network"], settings.network.model_dump(mode="json"))
    known = "; ".join(
        f"{key} = {changed[key][0]!r}, and not {changed[key][1]!r}" for key in OF_INPUTS if key in changed
    )
    return known and f"start_from = {str(run)!r}: its weights know inputs with {known}"


def _name_differences(run: Path, state: Mapping[str, Any], settings: TrainSettings, keys: Iterable[str]) -> None:
    """Raise SpecError if the network of a run's state differs in one of these settings."""
    changed = differing(state["settings"]["network"], settings.network.model_dump(mode="json"))
    if named := [key for key in changed if key in keys]:
        values = "; ".join(f"{key} = {changed[key][0]!r} there, and {changed[key][1]!r} is asked for" for key in named)
        raise SpecError(
            f"start_from = {str(run)!r}: its weights are of another network: {values}; give the same values"
        )


def start_from(
    learner: Learner, scene_id: str, settings: TrainSettings, warn: Callable[[str], object] = str
) -> dict[str, Any]:
    """Give an untrained learner the weights by which the run `settings.start_from` predicts; all else begins anew.

    Descriptors of points begin anew too, unless the run is of this scene and has as many points. `warn` is told if they
    were trained on what is held out now. Returns what the log says of it. Raises StoreError if there is no such run;
    SpecError, with each setting that differs, if its weights are of another network.
    """
    run = Path(str(settings.start_from))
    state, own = checkpoint.load(run / CHECKPOINT), learner.network.state_dict()
    weights = dict(average["weights"] if (average := state.get("average")) else state["network"])
    changed = differing(state["settings"]["network"], settings.network.model_dump(mode="json"))
    is_same_cloud = state["scene_id"] == scene_id and "points" not in changed
    _name_differences(run, state, settings, SAME)
    anew = [] if is_same_cloud else sorted({OF_POINTS} & own.keys() & weights.keys())
    weights |= {name: own[name] for name in anew}
    shapes, needed = ({name: tuple(each.shape) for name, each in of.items()} for of in (weights, own))
    if shapes != needed:
        _name_differences(run, state, settings, changed)
        raise SpecError(f"start_from = {str(run)!r}: its weights do not fit the network as its code is now")
    learner.begin_with(weights)
    before, of_scene = read_shares(run), state["scene_id"]
    shares = {**before, of_scene: min(state["settings"]["hold_out"], before.get(of_scene, 1))}
    if knows := (share := shares.get(scene_id, 1)) < settings.hold_out:
        warn(
            f"warning: the weights of run {run} were trained with hold_out = {share:g}, and so on a part of the "
            f"{settings.hold_out:g} that is held out now: the held-out error is not one of unseen views; with "
            f"hold_out = {share:g} it is"
        )
    about = {"run": str(run), "of_step": state["step"], "of_scene": of_scene, "anew": anew}
    return {**about, "hold_out": shares, "knows_held_out": knows}
