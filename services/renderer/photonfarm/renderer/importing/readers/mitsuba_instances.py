"""Instances of Mitsuba scenes, each made a shape of its own, as only those can be moved and sampled as lights."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree.ElementTree import Element

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import Changes

MOST = 5000
"""The most shapes that instances are expanded into; more are a forest, which no memory holds."""


def expand(root: Element, changes: Changes) -> None:
    """Put copies of its group's shapes in the place of each instance."""
    groups = {group.get("id", ""): group for group in root.findall("shape[@type='shapegroup']")}
    instances = root.findall("shape[@type='instance']")
    made = left_out = 0
    for number, instance in enumerate(instances):
        place = list(root).index(instance)
        copies = list(_copies(instance, groups, number)) if made < MOST else []
        root[place : place + 1] = copies
        left_out += not copies
        made += len(copies)
    for group in groups.values():
        root.remove(group)
    if made:
        changes.note(f"{len(instances)} instances became {made} shapes of their own")
    if left_out:
        meaning = f"{left_out} of {len(instances)} are missing, of empty groups or beyond {MOST} shapes"
        changes.lose("geometry", "instance", meaning)


def _copies(instance: Element, groups: dict[str, Element], number: int) -> Iterator[Element]:
    ref = next((part for part in instance if part.tag == "ref"), None)
    group = groups.get(ref.get("id", "") if ref is not None else "", instance.find("shape"))
    placed = elements.child(instance, "to_world")
    for shape in group.findall("shape") if group is not None else ():
        copy = elements.copied(shape)
        name = shape.get("id") or group.get("id") if group is not None else None
        copy.set("id", f"{name or 'instance'}_{number + 1}")
        own = elements.child(copy, "to_world")
        if placed is not None and own is not None:
            own.extend(elements.copied(step) for step in placed)  # after its own
        elif placed is not None:
            copy.append(elements.copied(placed))
        yield copy
