"""A store that was made before there were guides: what was asked of it, and every file that is none of them."""

from photonfarm.shared.plan.request import Request
from photonfarm.shared.store import SceneStore

REQUEST = Request(modifications=5, views_per_modification=2)
"""What an older store was asked for."""


def files(scene: SceneStore) -> dict[str, tuple[bytes, int, int]]:
    """Every file of a scene but its guides': its bytes, and which file it is, and since when."""
    found = [path for path in scene.folder.rglob("*") if path.is_file()]
    below = {str(path.relative_to(scene.folder)): path for path in found}
    return {
        name: (path.read_bytes(), path.stat().st_ino, path.stat().st_mtime_ns)
        for name, path in below.items()
        if not name.startswith("guides/")
    }
