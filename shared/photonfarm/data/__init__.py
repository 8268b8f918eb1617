"""Samples in Python: a scene of a store, its samples as arrays, and the same as a torch dataset.

    from photonfarm.data import open_scene

    scene = open_scene("store", "room")
    scene[7].radiance, scene[7].albedo, scene[7].modification
    dataset = scene.torch(split="train")

Nothing here needs Mitsuba, and only `Scene.torch` needs torch.
"""

from photonfarm.data.scene import Scene, open_scene
from photonfarm.store.read.batch import PointCloud, Sample

__all__ = ["PointCloud", "Sample", "Scene", "open_scene"]
