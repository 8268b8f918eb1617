"""What the names of shapes, materials and objects say: whether they belong to the room or stand in it."""

from __future__ import annotations

import re

_SHELL = re.compile(
    "wall|floor|ceil|window|door|skirting|baseboard|curtain|drape|blind|roof|ground|beam|column|pillar|stair|radiator|"
    "carpet|rug|room|shell|pane|sill|moulding|molding|socket|switch"
)

_FURNITURE = re.compile(
    "sofa|couch|chair|table|lamp|plant|bed|cabinet|desk|shelf|bookcase|wardrobe|stool|bench|tv|television|speaker|vase|"
    "pot|ottoman|piano|basket|ball|bear|dresser|drawer|fridge|pouf|cactus|bottle|bowl|cushion"
)

_NUMBERS_AT_END = re.compile(r"([\W_]*\d+)+$")
_NOT_OF_A_NAME = re.compile(r"[^0-9a-z]+")


def is_shell(name: str) -> bool:
    """Whether a name is of the room itself, such as a wall, and of nothing that stands in it."""
    return _SHELL.search(name.lower()) is not None and not is_furniture(name)


def is_furniture(name: str) -> bool:
    """Whether a name is of a piece of furniture."""
    return _FURNITURE.search(name.lower()) is not None


def group_name(name: str) -> str:
    """A name for a group: small letters and hyphens, without numbers at its end."""
    small = _NUMBERS_AT_END.sub("", re.sub(r"(?<=[a-z])(?=[A-Z])", "-", name)).lower()
    return _NOT_OF_A_NAME.sub("-", small).strip("-")[:40] or "object"
