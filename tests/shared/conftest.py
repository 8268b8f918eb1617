import pytest

from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import parse_spec

DESCRIBED = {
    "name": "test-room",
    "scene": {"builtin": "cornell"},
    "view": {
        "origin": {"min": [0.1, 0.2, 0.3], "max": [1.1, 2.2, 3.3]},
        "look_at": {"min": [0.0, 0.0, 0.0], "max": [1.0, 1.0, 1.0]},
    },
}


def described(**changes: object) -> dict[str, object]:
    return {**DESCRIBED, **changes}


@pytest.fixture
def static_spec() -> SceneSpec:
    return parse_spec(described(), where="test")


@pytest.fixture
def dynamic_spec(static_spec: SceneSpec) -> SceneSpec:
    """Three objects (one on a line, one on a plane, one in a volume) and a light on a ceiling of zero height."""
    boxes = [((0, 0, 0), (2, 0, 0)), ((-1, 0.5, -1), (1, 0.5, 1)), ((0, 0, 0), (1, 2, 3))]
    objects = [
        {"name": f"object-{i}", "shapes": [f"shape-{i}"], "at": [0.5, 0.5, 0.5], "box": {"min": low, "max": high}}
        for i, (low, high) in enumerate(boxes)
    ]
    light = {
        "name": "light",
        "at": [0, 2.5, 0],
        "box": {"min": [-1, 2.5, -1], "max": [1, 2.5, 1]},
        "rectangle": {"size": [1, 0.5], "radiance": [5, 5, 5]},
    }
    return SceneSpec.model_validate(
        {**static_spec.model_dump(), "content": "test", "objects": objects, "lights": [light]}
    )
