"""What the names of shapes, materials and objects say: whether they belong to the room or stand in it."""

from __future__ import annotations

import re
import unicodedata

_SHELL = re.compile(
    "wall|floor|ceil|window|door|skirting|baseboard|curtain|drape|blind|roof|ground|beam|column|pillar|stair|radiator|"
    "carpet|rug|room|shell|pane|sill|moulding|molding|socket|switch"
)

_FURNITURE = re.compile(
    "sofa|couch|chair|table|lamp|plant|bed|cabinet|desk|shelf|bookcase|wardrobe|stool|bench|tv|television|speaker|vase|"
    "pot|ottoman|piano|basket|ball|bear|dresser|drawer|fridge|pouf|cactus|bottle|bowl|cushion"
)

_NUMBERS_AT_END = re.compile(r"([\W_]*\d+)+$")


def is_shell(name: str) -> bool:
    """Whether a name is of the room itself, such as a wall, and of nothing that stands in it."""
    return _SHELL.search(name.lower()) is not None and not is_furniture(name)


def is_furniture(name: str) -> bool:
    """Whether a name is of a piece of furniture."""
    return _FURNITURE.search(name.lower()) is not None


def stem(name: str) -> str:
    """A name without the numbers at its end, which things of one kind share."""
    return _NUMBERS_AT_END.sub("", name).lower()


def group_name(name: str) -> str:
    """A name as it is, as far as a spec allows it: without accents, and with hyphens for other signs."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", plain).strip("-_.")[:60] or "object"
