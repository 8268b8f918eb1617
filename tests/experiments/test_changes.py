"""One kind of change at a time, and how much of it is explained."""

import numpy as np

from experiments.changes import explain, list_changes
from photonfarm.scene.groups import Power, Turn
from photonfarm.scene.modification import sample_modification
from photonfarm.scene.spec_loading import load_spec


def test_each_change_is_of_its_groups_and_columns_alone() -> None:
    room = load_spec("room")
    sofa = next(g for g, group in enumerate(room.groups) if group.name == "sofa")
    turning = room.objects[sofa].model_copy(update={"turn": Turn(min=-90, max=90), "removal_probability": 0.0})
    objects = (*room.objects[:sofa], turning, *room.objects[sofa + 1 :])
    lights = tuple(light.model_copy(update={"power": Power(min=0, max=2)}) for light in room.lights)
    spec = room.model_copy(update={"objects": objects, "lights": lights})
    before, other = (sample_modification(spec, 1, number) for number in (0, 1))
    lamps, found = {*range(len(objects), len(spec.groups))}, []
    for _, after in list_changes(spec, before, other):
        rows, columns = np.nonzero(after.vector != before.vector)
        found.append(({*rows.tolist()}, {*columns.tolist()}))
    across = {0, 2}  # boxes are flat in y
    assert found == [({sofa}, across), ({sofa}, {4}), (lamps, across), (lamps, {5}), (set(), set())]


def test_what_is_explained_is_the_share_of_the_squared_change() -> None:
    assert explain(np.array([[1.0, 4.0], [1.0, 4.0]])) == "0.750 (0.750 … 0.750)"
    assert explain(np.array([[4.0, 4.0], [0.0, 4.0]])).startswith("0.500 (0.000 … 1.000)")
