"""The render service: workers that turn planned samples into committed ones.

`load_mitsuba` makes Mitsuba ready to render with the integrator `bdpt`, without the rest of the service:

    from photonfarm.renderer import load_mitsuba

    mi = load_mitsuba()
    image = mi.render(scene, integrator=mi.load_dict({"type": "bdpt"}), spp=16)
"""

from photonfarm.renderer.scene.backend import load as load_mitsuba

__all__ = ["load_mitsuba"]
