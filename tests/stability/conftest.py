"""The variant, set before the tests' modules import what needs it."""

from __future__ import annotations

from photonfarm.renderer.scene import backend

backend.load(threads=1)
