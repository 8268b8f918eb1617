"""Instances of Mitsuba scenes, each made a shape of its own, as only those can be moved and sampled as lights."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree.ElementTree import Element

from photonfarm.renderer.importing import elements

MOST = 5000
"""The most shapes that instances are expanded into; more are a forest, which no memory holds."""


def expand(root: Element) -> list[str]:
    """Put copies of its group's shapes in the place of each instance."""
    groups = {group.get("id", ""): group for group in root.findall("shape[@type='shapegroup']")}
    instances = root.findall("shape[@type='instance']")
    made = 0
    left_out = 0
    for number, instance in enumerate(instances):
        place = list(root).index(instance)
        root.remove(instance)
        copies = list(_copies(instance, groups, number)) if made < MOST else []
        left_out += not copies
        made += len(copies)
        for shape in reversed(copies):
            root.insert(place, shape)
    for group in groups.values():
        root.remove(group)
    notes = [f"{len(instances)} instances became {made} shapes of their own"] if made else []
    return [*notes, f"{left_out} instances are left out, beyond {MOST} shapes"] if left_out else notes


def _copies(instance: Element, groups: dict[str, Element], number: int) -> Iterator[Element]:
    ref = next((part for part in instance if part.tag == "ref"), None)
    group = groups.get(ref.get("id", "") if ref is not None else "", instance.find("shape"))
    placed = elements.child(instance, "to_world")
    for shape in group.findall("shape") if group is not None else ():
        copy = elements.copied(shape)
        name = shape.get("id") or group.get("id") if group is not None else None
        copy.set("id", f"{name or 'instance'}_{number + 1}")
        if placed is not None:
            _place(copy, placed)
        yield copy


def _place(shape: Element, placed: Element) -> None:
    """Let a shape be moved by the instance's transform, after its own."""
    own = elements.child(shape, "to_world")
    if own is None:
        shape.append(elements.copied(placed))
    else:
        own.extend(elements.copied(step) for step in placed)
